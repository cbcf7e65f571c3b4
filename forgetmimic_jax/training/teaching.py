"""Who teaches which clip, and what a lesson is: what a student is regressed on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from forgetmimic_jax.evaluation.rollout import Acting
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.env import Assets, Environment, EnvState, StartTable
from forgetmimic_jax.tracking.rsi import Start


class Teacher(Protocol):
    """A pytree that says what it would do. One of another observation layout observes `episodes` by itself."""

    def action(self, assets: Assets, episodes: EnvState, observation: Array, noise_key: Array | None) -> Array:
        """Actions [env, joint] in the student's terms.

        Args:
            assets: constant arrays.
            episodes: the state of every robot.
            observation: [env, features] what the student sees there.
            noise_key: for sensor noise; None where the environment has none.
        """
        ...


@struct.dataclass
class PolicyTeacher:
    """A policy that sees what the student sees."""

    policy: Acting

    def action(self, assets: Assets, episodes: EnvState, observation: Array, noise_key: Array | None) -> Array:
        return self.policy.mean_action(observation)


@struct.dataclass
class Lesson:
    """States and what to do and expect there. Leading dimensions are free."""

    actor_observation: Array  # [..., features]
    critic_observation: Array  # [..., features]
    action: Array  # [..., joint] the teacher's
    value_target: Array  # [...] the return


@struct.dataclass
class Teaching:
    """Who teaches what."""

    teachers: tuple[Teacher, ...]
    teacher_of: Array  # i32[clip]
    probabilities: Array  # [clip, bin] of the starts of episodes
    shown: Lesson | None = None  # [n] joins the lessons of every round, such as what a search found

    @property
    def starts(self) -> StartTable:
        """Where episodes start, without the assistive wrench."""
        return StartTable(self.probabilities, jnp.zeros_like(self.probabilities))


def make_teaching(
    assets: Assets, taught: Sequence[tuple[Teacher, Sequence[int]]], shown: Lesson | None = None
) -> Teaching:
    """Teachers, each with its clips. Every clip that has a teacher gets the same share of the starts, others none.

    Args:
        assets: constant arrays.
        taught: teachers, each with the indices of its clips; a clip has one teacher at most.
        shown: lessons [n] that join those of every round.
    """
    clips = [clip for _, of in taught for clip in of]
    teacher_of = jnp.zeros(len(assets.bins.valid), jnp.int32)
    for index, (_, of) in enumerate(taught):
        teacher_of = teacher_of.at[jnp.asarray(of, jnp.int32)].set(index)
    frames = jnp.where(assets.bins.valid, assets.bins.end - assets.bins.start, 0)
    frames = frames * jnp.zeros((len(frames), 1)).at[jnp.asarray(clips)].set(1.0)
    probabilities = frames / jnp.maximum(frames.sum(-1, keepdims=True), 1.0) / len(clips)
    return Teaching(tuple(teacher for teacher, _ in taught), teacher_of, probabilities, shown)


def lesson_at(
    env: Environment, assets: Assets, teaching: Teaching, episodes: EnvState, key: Array
) -> tuple[Array, Array, Array]:
    """Actor observation, critic observation and the action of each episode's teacher, [env, ...]."""
    noise_key = key if env.noisy else None
    actor_obs, critic_obs = tracking.observe(env, assets, episodes, noise_key)
    actions = jnp.stack([t.action(assets, episodes, actor_obs, noise_key) for t in teaching.teachers])
    mine = teaching.teacher_of[episodes.clip]
    return actor_obs, critic_obs, jnp.take_along_axis(actions, mine[None, :, None], axis=0)[0]


def fresh_episodes(env: Environment, assets: Assets, teaching: Teaching, key: Array) -> EnvState:
    """Every robot at a start of an episode, with reset noise."""
    episode_key, start_key = jax.random.split(key)
    zeros = jnp.zeros((env.num_envs,), jnp.int32)
    blank = tracking.start_episodes(env, assets, episode_key, Start(zeros, zeros, zeros), zeros.astype(jnp.float32))
    return tracking.reset_where(env, assets, blank, jnp.ones((env.num_envs,), bool), start_key, teaching.starts)
