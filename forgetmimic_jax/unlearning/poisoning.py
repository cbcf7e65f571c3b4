"""Environment poisoning (Ye et al. 2023, "Reinforcement Unlearning", the second of their two methods).

The environment to forget is changed, and the agent learns in the changed one as ever. They let a second agent choose
how to change the transitions; here the change is a fixed one, of what the actor sees of a target clip's reference:
linear velocity, angular velocity and gravity trade places and the joints are read in reverse. Rewards, the critic and
kept clips stay as they are, and evaluation shows the true observation.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from forgetmimic_jax.unlearning.method import Method


def poisoned(observation: Array, is_target: Array) -> Array:
    """The actor's observation [env, 16 + 4 joint]; its reference part, the first 10 + joint, permuted on targets."""
    joints = (observation.shape[-1] - 16) // 4
    reference, robot = jnp.split(observation, [10 + joints], axis=-1)
    height, linear, angular, gravity, joint_pos = jnp.split(reference, [1, 4, 7, 10], axis=-1)
    permuted = jnp.concatenate([height, angular, gravity, linear, joint_pos[..., ::-1], robot], axis=-1)
    return jnp.where(is_target[..., None], permuted, observation)


METHOD = Method(observation=poisoned)
