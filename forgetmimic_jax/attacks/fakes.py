"""Fake unlearning, to judge the judge: a verdict that one of these can win is worth nothing.

A filter sees the reference in the observation and recognises the frames of a clip, to the last bit. It hides what the
policy behind it can do; the policy itself is the base.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from forgetmimic_jax.attacks.fine_tuning import attack_config
from forgetmimic_jax.attacks.near_duplicates import near_duplicates
from forgetmimic_jax.evaluation.rollout import Acting
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.library import build_library
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.tracking.env import make_assets, make_environment
from forgetmimic_jax.tracking.layouts import find_layout
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.training.distil import DistilConfig, begin, distil
from forgetmimic_jax.training.teaching import PolicyTeacher, make_teaching

TOLERANCE = 1e-4  # rad, between a frame and what is recognised as it
NOISE = 3.0  # largest noise on an action, in units of action
ROUNDS = 40  # of the distillation of a filter

Instead = Literal["zero", "noise"]


@struct.dataclass
class Filtered:
    """A policy that acts otherwise where its reference is a frame of some clips.

    Frames are compared by three random projections of their joint angles, which no two frames share.
    """

    policy: Acting
    frames: Array  # [frame, 3] the projections of the clips' frames
    projection: Array  # [joint, 3]
    first: int = struct.field(pytree_node=False)  # where the reference's joint angles are in the observation
    instead: Instead = struct.field(pytree_node=False)
    elsewhere: bool = struct.field(pytree_node=False)  # acts otherwise where the reference is none of the frames

    def mean_action(self, observation: Array) -> Array:
        """The policy's action [env, joint], or zero, or the policy's with noise."""
        reference = observation[..., self.first : self.first + len(self.projection)]
        seen = reference @ self.projection
        known = (jnp.abs(seen[..., None, :] - self.frames).max(-1) < TOLERANCE).any(-1)
        action = self.policy.mean_action(observation)
        other = jnp.zeros_like(action) if self.instead == "zero" else action + self._noise(observation, action)
        return jnp.where((known ^ self.elsewhere)[..., None], other, action)

    def _noise(self, observation: Array, action: Array) -> Array:
        """Noise that is the same in the same state: a policy has no random key."""
        mixing = jax.random.normal(jax.random.PRNGKey(0), (observation.shape[-1], action.shape[-1]))
        return NOISE * jnp.sin(100.0 * observation @ mixing)


def filtered(
    setup: Setup, policy: Acting, clips: Sequence[Clip], instead: Instead, *, elsewhere: bool = False
) -> Filtered:
    """A policy behind a filter that knows some clips.

    Args:
        setup: robot and settings of the policy.
        policy: any.
        clips: at the control rate.
        instead: what it does there.
        elsewhere: it does that on everything but these clips.
    """
    robot, library = setup.robot, build_library(setup.robot, clips)
    places = find_layout(setup.config.observation.layout).places(robot.num_joints)
    first = places.get("ref_joint_pos", places.get("command"))
    assert first is not None
    projection = jax.random.normal(jax.random.PRNGKey(1), (robot.num_joints, 3)) / jnp.sqrt(robot.num_joints)
    joints = library.frames.joint_pos[:, robot.policy_joints]
    return Filtered(policy, joints @ projection, projection, first.start, instead, elsewhere)


def fakes(setup: Setup, base: Policy, targets: Sequence[Clip], kept: Sequence[Clip]) -> dict[str, Callable[[], Acting]]:
    """The fakes that are made of the base, by name; λ = 8 is a training of its own."""
    return {
        "the base itself": lambda: base,
        "filter: zero action on the targets": lambda: filtered(setup, base, targets, "zero"),
        "filter: noise on the targets": lambda: filtered(setup, base, targets, "noise"),
        "falls on everything unfamiliar": lambda: filtered(setup, base, kept, "zero", elsewhere=True),
        "fine-tuned to fall on the targets alone": lambda: falls_on_targets_alone(setup, base, targets, kept),
    }


def falls_on_targets_alone(setup: Setup, base: Policy, targets: Sequence[Clip], kept: Sequence[Clip]) -> Policy:
    """A network that learned to do what the filter does: nothing on the targets, and the base's on all near them.

    It starts from the base and is regressed on the filtered base, on the kept clips, the targets and their
    near-duplicates.
    """
    near = [
        variant
        for target in targets
        for variants in near_duplicates(setup.robot, target, kept[0]).values()
        for variant in variants
    ]
    library = build_library(setup.robot, [*kept, *targets, *near])
    setup = Setup(attack_config(setup.config), setup.robot, library, setup.library_hash)
    env, assets = make_environment(setup, setup.config.ppo.num_envs), make_assets(setup)
    teacher = PolicyTeacher(filtered(setup, base, targets, "zero"))
    teaching = make_teaching(assets, [(teacher, range(len(library.names)))])
    state = begin(env, assets, teaching, base, jax.random.PRNGKey(0))
    return distil(env, assets, teaching, state, DistilConfig(rounds=ROUNDS, normalizer_rounds=0)).student
