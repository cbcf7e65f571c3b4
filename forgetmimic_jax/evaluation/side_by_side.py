"""The same episodes rolled out by several policies at once, one robot each; no termination ends them.

Every policy meets the same clip, start frame and reset noise. The rows of a batch are ordered by policy, then by start.
The robots are simulated by `physics.impact`, so a robot that lies on the floor touches it with its whole body.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from forgetmimic_jax.evaluation.metrics import HOLD_SECONDS
from forgetmimic_jax.evaluation.rollout import Acting, act, begin_episodes, evaluation_setup
from forgetmimic_jax.motion.library import Frames
from forgetmimic_jax.physics.impact import Impact, ImpactEngine
from forgetmimic_jax.robot.bodies import Values
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.env import Assets, Environment, EnvState, StepResult
from forgetmimic_jax.tracking.reference import align_to_anchor
from forgetmimic_jax.tracking.reward import Pair
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.tracking.stand import low, stand_frame, tilted_unlike_clip


@struct.dataclass
class Happened:
    """What happened to the robots in a control step, each [env]."""

    fallen: Values  # bool: the robot is low, or it is tilted where the clip is not, or the physics diverged
    impact: Values  # body weights, the floor's largest force on a body that is no foot
    impact_speed: Values  # m/s downward, of the root before such a force; 0 without
    head_contact: Values  # bool
    hand_contact: Values  # bool
    torque_saturation: Values  # share of joints beyond 95 % of their torque limit
    joint_limit_violation: Values  # share of joints beyond their soft limits
    joint_speed_violation: Values  # share of joints faster than their motors
    deviation: Values  # m², of the robot from the clip: see `distances`
    movement: Values  # m², of the stand from the clip


class SideBySide:
    """Environments of `policies` (name → networks, None for the zero action) with `starts` episodes each."""

    def __init__(
        self,
        setup: Setup,
        policies: Mapping[str, Acting | None],
        *,
        starts: int = 1,
    ):
        setup = evaluation_setup(setup)
        self.names = tuple(policies)
        self.library = setup.library
        rows = len(policies) * starts
        engine = ImpactEngine(setup.robot, setup.config.physics.substeps, rows)
        self.env = Environment(setup.config, setup.robot, engine, rows, noisy=False)
        self.hold = round(HOLD_SECONDS / self.env.control_step)  # steps
        self._starts = starts
        self._stand = stand_frame(setup.robot)
        self._assets = tracking.make_assets(setup)
        self._policies = tuple(policies.values())
        self._begin = jax.jit(self._begin_episodes)
        self._advance = jax.jit(self._advance_step)

    def begin(self, clip: Sequence[int] | np.ndarray, frame: Sequence[int] | np.ndarray, seed: int = 0) -> EnvState:
        """Episodes at clips [start] and frames [start], the same for every policy.

        The reset noise is that of an `Evaluator` with the same starts and seed.
        """
        return self._begin(self._assets, jax.random.PRNGKey(seed), jnp.asarray(clip), jnp.asarray(frame))

    def step(self, state: EnvState) -> tuple[EnvState, StepResult, Happened]:
        """One control step of every robot, each with its own policy's mean action."""
        return self._advance(self._assets, self._policies, state)

    def _begin_episodes(self, assets: Assets, key: Array, clip: Array, frame: Array) -> EnvState:
        once = begin_episodes(dataclasses.replace(self.env, num_envs=self._starts), assets, key, clip, frame)
        copies = len(self._policies)
        state = jax.tree.map(lambda x: jnp.tile(x, (copies, *[1] * (x.ndim - 1))), once)
        return tracking.refresh_bodies(self.env, state, jnp.ones((self.env.num_envs,), bool))

    def _advance_step(self, assets: Assets, policies: tuple[Acting | None, ...], state: EnvState):
        observation = tracking.observe(self.env, assets, state, None)[0]
        rows = jnp.split(observation, len(policies))
        action = jnp.concatenate([act(self.env, *pair) for pair in zip(policies, rows, strict=True)])
        state, result = tracking.step(self.env, assets, state, action, jax.random.PRNGKey(0))
        return state, result, happened(self.env.robot, self._stand, result)


def happened(robot: Robot, stand: Frames, result: StepResult) -> Happened:
    """What the result of a step of `ImpactEngine` says.

    Args:
        robot: that was simulated.
        stand: the frame of its stand, without a leading dimension.
        result: of the step.
    """
    pair, bodies = result.pair, result.pair.bodies
    assert isinstance(bodies, Impact)
    clip, joint_pos = pair.reference.bodies, pair.joint_pos
    outside = (joint_pos < robot.arrays.soft_lower) | (joint_pos > robot.arrays.soft_upper)
    return Happened(
        fallen=low(robot, bodies) | tilted_unlike_clip(robot, bodies, clip) | result.diverged,
        impact=bodies.impact_force / robot.weight,
        impact_speed=bodies.impact_speed,
        head_contact=bodies.head_contact > 0,
        hand_contact=bodies.hand_contact > 0,
        torque_saturation=bodies.torque_saturation,
        joint_limit_violation=outside.mean(-1),
        joint_speed_violation=(jnp.abs(pair.joint_vel) > robot.joint_velocity_limit).mean(-1),
        **distances(robot, stand, pair),
    )


def distances(robot: Robot, stand: Frames, pair: Pair) -> dict[str, Array]:
    """How far the robot (deviation), and how far a stand (movement), is from the reference, each [env] m².

    It is the mean over key bodies of the squared distance, where one is moved to the other's anchor.

    Args:
        robot: whose bodies they are.
        stand: the frame of its stand, without a leading dimension.
        pair: the robot and the reference.
    """
    clip, rows = pair.reference.bodies, len(pair.joint_pos)
    stands = jax.tree.map(lambda values: jnp.broadcast_to(values, (rows, *values.shape)), stand)
    stand_there = align_to_anchor(stands, robot.anchor, clip.pos[:, robot.anchor], clip.quat[:, robot.anchor])

    def apart(one: Array, other: Array) -> Array:
        return ((one - other) ** 2).sum(-1).mean(-1)

    return {"deviation": apart(pair.bodies.pos, pair.aligned.pos), "movement": apart(stand_there.pos, clip.pos)}


def push(state: EnvState, velocity: Sequence[float] | np.ndarray) -> EnvState:
    """Every robot's root gets `velocity` [3] m/s, world frame, on top of its own."""
    qvel = state.physics.qvel.at[:, :3].add(jnp.asarray(velocity, jnp.float32))
    return dataclasses.replace(state, physics=dataclasses.replace(state.physics, qvel=qvel))
