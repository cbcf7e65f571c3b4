"""The evaluation protocol: deterministic actions, no wrench, no randomisation, the clip pinned, no roll-over.

With `noise`, randomisation, pushes and sensor noise are as in training. All that is random depends on the seed alone,
so that every policy meets the same episodes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from forgetmimic_jax.basics import rotation
from forgetmimic_jax.evaluation.metrics import Rollout
from forgetmimic_jax.physics.engine import CONTACT_FORCE
from forgetmimic_jax.ppo.rule import Rule
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.env import Assets, Environment, EnvState
from forgetmimic_jax.tracking.reward import Pair
from forgetmimic_jax.tracking.rsi import Start
from forgetmimic_jax.tracking.setup import Setup

CHUNK = 50  # control steps between two looks whether every episode has ended
SHORTEST_START = 25  # a start frame leaves at least so many steps, so that no episode is trivially short


class Acting(Protocol):
    """A pytree that acts, such as a `Policy`."""

    def mean_action(self, observation: Array) -> Array:
        """The action [env, joint] at an actor observation [env, features]."""
        ...


@struct.dataclass
class Switched:
    """A policy, or with `on` false the zero action. Both are one program, where compiling takes longer than acting."""

    policy: Acting
    on: Array  # bool[]

    def mean_action(self, observation: Array) -> Array:
        """The policy's action [env, joint] at an actor observation [env, features], or 0."""
        return jnp.where(self.on, self.policy.mean_action(observation), 0.0)


class Evaluator:
    """Rolls policies out on the same episodes of one library. Compiled once, used for any number of policies."""

    def __init__(self, setup: Setup, *, episodes: int, seed: int, noise: bool = False, rule: Rule | None = None):
        """With a rule, the reference of a target clip and what ends its episodes are as in training under that rule."""
        setup, rule = evaluation_setup(setup), rule or Rule()
        self.config = setup.config
        self.clip, self.start_frame = episode_starts(np.asarray(setup.library.length), episodes, seed)
        self._seed = seed
        self._env = tracking.make_environment(
            setup, len(self.clip), noisy=noise, runs_on=rule.runs_on, replace_reference=rule.replace_reference
        )
        self._assets = tracking.make_assets(setup)
        self._begin = make_begin(self._env, self.clip, self.start_frame)
        self._advance = jax.jit(self._advance_chunk)

    def start(self) -> EnvState:
        """Every episode at its start frame, reset noise included."""
        return self._begin(self._assets, jax.random.PRNGKey(self._seed))

    def rollout(self, policy: Acting | None) -> Rollout:
        """Every episode with `policy`'s mean action; None is the zero action."""
        env = self._env
        state = self.start()
        horizon = np.asarray(state.horizon)
        length = horizon.copy()
        ended = np.zeros(env.num_envs, bool)
        diverged = np.zeros(env.num_envs, bool)
        ended_by: dict[str, np.ndarray] = {}
        records = []
        for begin in range(0, int(horizon.max()), CHUNK):
            state, record = jax.device_get(self._advance(self._assets, policy, state, begin))
            terminated, blew_up, broken = record.pop("terminated"), record.pop("diverged"), record.pop("causes")
            records.append(record)
            for offset in range(CHUNK):
                now = terminated[offset] & ~ended & (begin + offset < horizon)
                length[now] = np.maximum(begin + offset, 1)
                diverged |= now & blew_up[offset]
                for bound, at in broken.items():
                    ended_by[bound] = ended_by.get(bound, False) | (now & at[offset])
                ended |= now
            if (ended | (begin + CHUNK >= horizon)).all():
                break
        steps = int(horizon.max())
        series = {}
        for name in records[0]:
            values = np.concatenate([record[name] for record in records])[:steps].T
            series[name] = np.pad(values, ((0, 0), (0, steps - values.shape[1])))
        return Rollout(
            clip=self.clip,
            start_frame=self.start_frame,
            horizon=horizon,
            length=length,
            tracking_reward=series.pop("tracking_reward"),
            errors=series,
            ended_by=ended_by,
            nan_resets=int(diverged.sum()),
        )

    def _advance_chunk(self, assets: Assets, policy: Acting | None, state: EnvState, begin: Array):
        env = self._env

        def one_step(state: EnvState, key: Array):
            sensor_key, push_key = jax.random.split(key)
            observation, _ = tracking.observe(env, assets, state, sensor_key if env.noisy else None)
            state, result = tracking.step(env, assets, state, act(env, policy, observation), push_key)
            record: dict[str, Any] = dict(step_errors(env.robot, result.pair))
            record |= {
                "tracking_reward": result.reward.normalized_tracking,
                "terminated": result.terminated,
                "diverged": result.diverged,
                "causes": result.causes,
            }
            return state, record

        key = jax.random.fold_in(jax.random.PRNGKey(self._seed), begin)
        return jax.lax.scan(one_step, state, jax.random.split(key, CHUNK))


def begin_episodes(env: Environment, assets: Assets, key: Array, clip: Array, frame: Array) -> EnvState:
    """Episodes [env] at given clips and frames, with reset noise, without the wrench. Bodies: the reference's."""
    zeros = jnp.zeros((env.num_envs,), jnp.int32)
    start = Start(clip.astype(jnp.int32), zeros, frame.astype(jnp.int32))
    return tracking.start_episodes(env, assets, key, start, zeros.astype(jnp.float32))


def make_begin(env: Environment, clip: np.ndarray, frame: np.ndarray) -> Callable[[Assets, Array], EnvState]:
    """The jitted begin(assets, key): episodes [env] at given clips and frames, with the bodies of the robots."""

    @jax.jit
    def begin(assets: Assets, key: Array) -> EnvState:
        state = begin_episodes(env, assets, key, jnp.asarray(clip), jnp.asarray(frame))
        return tracking.refresh_bodies(env, state, jnp.ones((env.num_envs,), bool))

    return begin


def act(env: Environment, policy: Acting | None, observation: Array) -> Array:
    """The mean action [env, joint] for the actor's observation [env, features]; zero without a policy."""
    if policy is None:
        return jnp.zeros((observation.shape[0], env.robot.num_joints), jnp.float32)
    return policy.mean_action(observation)


def evaluation_setup(setup: Setup) -> Setup:
    """The setup with randomisation and the wrench off and episodes of full length; reset noise stays."""
    config = dataclasses.replace(
        setup.config,
        max_episode_steps=Config.max_episode_steps,
        noise=dataclasses.replace(setup.config.noise, enabled=False),
        wrench=dataclasses.replace(setup.config.wrench, max_gain=0.0),
    )
    return dataclasses.replace(setup, config=config)


def episode_starts(lengths: np.ndarray, episodes: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Clip and start frame, i[clip · episodes]: half from frame 0, half stratified over the clip.

    Args:
        lengths: i[clip] frames.
        episodes: a clip.
        seed: of the frames inside the strata.
    """
    rng = np.random.default_rng(seed)
    stratified = episodes // 2
    starts = []
    for length in lengths:
        last = max(1, int(length) - 1 - SHORTEST_START)
        offsets = (np.arange(stratified) + rng.random(stratified)) / max(stratified, 1)
        starts.append(np.concatenate([np.zeros(episodes - stratified, int), np.floor(offsets * last).astype(int)]))
    return np.repeat(np.arange(len(lengths)), episodes), np.concatenate(starts)


def step_errors(robot: Robot, pair: Pair) -> dict[str, Array]:
    """The field's standard tracking errors and the paper's physical measures after a step, each [env].

    mpkpe and root_relative_mpkpe in m (the second after moving the reference to the robot's anchor),
    joint_position_error in rad and joint_velocity_error in rad/s (root mean squares over joints), end_effector_error
    in m (re-anchored), anchor errors in m and rad, max_key_body_position_error in m (re-anchored), the share of feet
    in contact, and the share of joints beyond their soft limits.
    """
    bodies, reference, aligned, anchor = pair.bodies, pair.reference, pair.aligned, pair.anchor
    joint_pos, joint_vel = pair.joint_pos, pair.joint_vel
    world = jnp.linalg.norm(reference.bodies.pos - bodies.pos, axis=-1)
    relative = jnp.linalg.norm(aligned.pos - bodies.pos, axis=-1)
    feet = jnp.linalg.norm(bodies.contact_force[:, robot.feet], axis=-1)
    outside = (joint_pos < robot.arrays.soft_lower) | (joint_pos > robot.arrays.soft_upper)
    return {
        "mpkpe": world.mean(-1),
        "root_relative_mpkpe": relative.mean(-1),
        "joint_position_error": jnp.sqrt(((reference.joint_pos - joint_pos) ** 2).mean(-1)),
        "joint_velocity_error": jnp.sqrt(((reference.joint_vel - joint_vel) ** 2).mean(-1)),
        "end_effector_error": relative[:, robot.end_effectors].mean(-1),
        "anchor_position_error": world[:, anchor],
        "anchor_orientation_error": rotation.angle_between(reference.bodies.quat[:, anchor], bodies.quat[:, anchor]),
        "max_key_body_position_error": relative.max(-1),
        "foot_contact": (feet > CONTACT_FORCE).mean(-1),
        "joint_limit_violation": outside.mean(-1),
    }
