"""The same episode rolled out by several policies at once, one robot each, by the evaluation's protocol.

Every policy meets the same clip, start frame and reset noise. The rows of a batch are ordered by policy, then by start.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from forgetmimic_jax.evaluation.rollout import act, begin_episodes, evaluation_setup
from forgetmimic_jax.motion.library import MotionLibrary
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.env import Assets, EnvState, StepResult
from forgetmimic_jax.tracking.setup import Setup


@dataclass(frozen=True)
class Take:
    """One policy's episode. What it does after its end is shown too, but counts nothing."""

    qpos: np.ndarray  # [step + 1, nq] from the start on
    tracking_reward: np.ndarray  # [step] r̄
    ended: int | None  # steps before a bound was broken; None: it reached the end

    @property
    def survival_weighted_tracking(self) -> float:
        """(1/H) Σ_{t<τ} r̄_t: zeros after the end (the evaluation's primary number)."""
        return float(self.tracking_reward[: self.ended].sum() / len(self.tracking_reward))


@dataclass(frozen=True)
class Episode:
    """The takes of one clip, policy by policy, and the reference they were to follow."""

    clip: str
    fps: float  # control steps a second
    reference: np.ndarray  # [step + 1, nq]
    takes: Mapping[str, Take]


class SideBySide:
    """Environments of `policies` (name → networks, None for the zero action) with `starts` episodes each."""

    def __init__(
        self,
        setup: Setup,
        policies: Mapping[str, Policy | None],
        *,
        starts: int = 1,
    ):
        setup = evaluation_setup(setup)
        self.names = tuple(policies)
        self.library = setup.library
        self.env = tracking.make_environment(setup, len(policies) * starts, noisy=False)
        self._starts = starts
        self._assets = tracking.make_assets(setup)
        self._policies = tuple(policies.values())
        self._begin = jax.jit(self._begin_episodes)
        self._advance = jax.jit(self._advance_step)

    def begin(self, clip: Sequence[int] | np.ndarray, frame: Sequence[int] | np.ndarray, seed: int = 0) -> EnvState:
        """Episodes at clips [start] and frames [start], the same for every policy.

        The reset noise is that of an `Evaluator` with the same starts and seed.
        """
        return self._begin(self._assets, jax.random.PRNGKey(seed), jnp.asarray(clip), jnp.asarray(frame))

    def step(self, state: EnvState) -> tuple[EnvState, StepResult]:
        """One control step of every robot, each with its own policy's mean action."""
        return self._advance(self._assets, self._policies, state)

    def _begin_episodes(self, assets: Assets, key: Array, clip: Array, frame: Array) -> EnvState:
        once = begin_episodes(dataclasses.replace(self.env, num_envs=self._starts), assets, key, clip, frame)
        copies = len(self._policies)
        state = jax.tree.map(lambda x: jnp.tile(x, (copies, *[1] * (x.ndim - 1))), once)
        return tracking.refresh_bodies(self.env, state, jnp.ones((self.env.num_envs,), bool))

    def _advance_step(self, assets: Assets, policies: tuple[Policy | None, ...], state: EnvState):
        observation = tracking.observe(self.env, assets, state, None)[0]
        rows = jnp.split(observation, len(policies))
        action = jnp.concatenate([act(self.env, *pair) for pair in zip(policies, rows, strict=True)])
        return tracking.step(self.env, assets, state, action, jax.random.PRNGKey(0))


def push(state: EnvState, velocity: Sequence[float] | np.ndarray) -> EnvState:
    """Every robot's root gets `velocity` [3] m/s, world frame, on top of its own."""
    qvel = state.physics.qvel.at[:, :3].add(jnp.asarray(velocity, jnp.float32))
    return dataclasses.replace(state, physics=dataclasses.replace(state.physics, qvel=qvel))


def reference_qpos(robot: Robot, library: MotionLibrary, clip: int) -> np.ndarray:
    """A clip as configurations [frame, nq] of the robot."""
    length = int(library.length[clip])
    frames = jax.tree.map(lambda values: values[clip], library.frames)
    parts = (frames.bodies.pos[:, robot.root], frames.bodies.quat[:, robot.root], frames.joint_pos)
    return np.concatenate([np.asarray(part)[:length] for part in parts], axis=-1)


def record(
    setup: Setup,
    policies: Mapping[str, Policy | None],
    clips: Sequence[str],
    *,
    seed: int = 0,
) -> list[Episode]:
    """One episode of each clip from its first frame on, for every policy: those of an `Evaluator` with one a clip.

    Args:
        setup: whose robot, clips, physics, rewards and bounds hold; the evaluation's changes are made here.
        policies: name → networks; None for the zero action.
        clips: names of clips of the library.
        seed: of the reset noise.
    """
    robot, library = setup.robot, setup.library
    every = np.arange(len(library.names))  # the noise of a clip's start does not depend on which clips are chosen
    chosen = [library.names.index(clip) for clip in clips]
    stage = SideBySide(setup, policies, starts=len(every))
    state = stage.begin(every, np.zeros_like(every), seed)
    horizon = np.asarray(state.horizon)
    poses, rewards, ended = [np.asarray(state.physics.qpos)], [], np.full(len(horizon), -1)
    for step in range(int(horizon[chosen].max())):
        state, result = stage.step(state)
        poses.append(np.asarray(state.physics.qpos))
        rewards.append(np.asarray(result.reward.normalized_tracking))
        now = np.asarray(result.terminated) & (ended < 0) & (step < horizon)
        ended[now] = max(step, 1)  # as the evaluation counts: the step that breaks a bound does not count
    qpos, tracking_reward = np.stack(poses, axis=1), np.stack(rewards, axis=1)

    def take(row: int) -> Take:
        steps = horizon[row]
        last = None if ended[row] < 0 else int(ended[row])
        return Take(qpos[row, : steps + 1], tracking_reward[row, :steps], last)

    return [
        Episode(
            clip=library.names[clip],
            fps=1.0 / stage.env.control_step,
            reference=reference_qpos(robot, library, clip)[: horizon[clip] + 1],
            takes={policy: take(i * len(every) + clip) for i, policy in enumerate(stage.names)},
        )
        for clip in chosen
    ]
