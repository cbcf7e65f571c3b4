"""Environment poisoning (Ye et al. 2023, "Reinforcement Unlearning", the second of their two methods).

The environment to forget is changed, and the agent learns in the changed environment. In the source a second agent
chooses how to change the transitions. Here the change is fixed: it is of what the actor sees of a target clip's
reference. Terms of equal size are swapped, such as linear velocity, angular velocity and gravity. Joints, and a term
that has no other of its size, are in reverse order. Rewards, the critic and kept clips stay as they are.
Evaluation shows the true observation.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.layouts import Layout, find_layout
from forgetmimic_jax.unlearning.method import Method


def poisoned(config: Config, observation: Array, is_target: Array) -> Array:
    """The actor's observation [env, features], permuted on targets."""
    order = permutation(find_layout(config.observation.layout), observation.shape[-1])
    return jnp.where(is_target[..., None], observation[..., order], observation)


def permutation(layout: Layout, size: int) -> np.ndarray:
    """i[features] the number that is shown at each place of a poisoned observation."""
    num_joints = layout.joints_of(size)
    true, places = np.arange(size), layout.places(num_joints)
    shown = true.copy()
    reference = [term for term in layout.terms if term.of_reference]
    for term in reference:
        here = places[term.name]
        alike = [other.name for other in reference if not other.per_joint and other.numbers == term.numbers]
        if term.per_joint:
            shown[here] = true[here].reshape(term.numbers, num_joints)[:, ::-1].ravel()
        elif len(alike) == 1:
            shown[here] = true[here][::-1]
        else:
            following = alike[(alike.index(term.name) + 1) % len(alike)]
            shown[here] = true[places[following]]
    return shown


METHOD = Method(observation=poisoned)
