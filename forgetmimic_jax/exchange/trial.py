"""How an imported policy does on its clips, before anything is written: what it sees, what it does, how well it tracks.

Every clip is rolled out once from its first frame without any noise, to its end, and in episodes of the evaluation:
reset noise, 10 s at most.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from forgetmimic_jax.basics.rows import select_rows
from forgetmimic_jax.evaluation.rollout import CHUNK, act, begin_episodes, episode_starts, evaluation_setup
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.settings.config import NoiseConfig
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.env import Assets, Environment, EnvState
from forgetmimic_jax.tracking.setup import Setup

LONGEST = 3000  # control steps of the episode without noise: a minute


class Tracked(NamedTuple):
    """A clip's figures."""

    seconds: float  # that the episode without noise lasts, and
    horizon: float  # s that it could last
    reward: float  # mean normalised tracking reward of that episode while alive
    joint_error: float  # rad, mean over its steps and joints of |reference - joint|
    survival: float  # share of the episodes with reset noise that reach their end
    noisy_reward: float  # the same two of these episodes
    noisy_joint_error: float


@dataclass(frozen=True)
class Trial:
    """What a policy did."""

    observations: np.ndarray  # f32[step, features] while alive
    clips: dict[str, Tracked]


def try_out(setup: Setup, policy: Policy, *, episodes: int, seed: int) -> Trial:
    """Roll a policy out on every clip of its library.

    Args:
        setup: robot, clips and settings.
        policy: whose mean action is taken.
        episodes: with reset noise, a clip: half from frame 0, half spread over the clip.
        seed: of these.
    """
    setup = evaluation_setup(setup)
    lengths = np.asarray(setup.library.length)
    noisy_clips, noisy_frames = episode_starts(lengths, episodes, seed)
    clip = np.concatenate([np.arange(len(lengths)), noisy_clips])
    env = tracking.make_environment(setup, len(clip), noisy=False)
    assets = tracking.make_assets(setup)
    frame = np.concatenate([np.zeros(len(lengths), int), noisy_frames])
    clean = np.arange(len(clip)) < len(lengths)
    state = jax.jit(lambda assets, key: _start(env, assets, key, clip, frame, clean))(assets, jax.random.PRNGKey(seed))
    horizon = np.asarray(state.horizon)
    advance = jax.jit(lambda assets, policy, state: _advance(env, assets, policy, state))
    records = []
    alive = np.ones(len(clip), bool)
    for begin in range(0, int(horizon.max()), CHUNK):
        state, record = jax.device_get(advance(assets, policy, state))
        within = (begin + np.arange(CHUNK))[:, None] < horizon
        fallen = np.logical_or.accumulate(record.pop("terminated") & within, axis=0) | ~alive
        records.append(record | {"alive": within & ~fallen, "acted": within & ~np.vstack([~alive, fallen[:-1]])})
        alive = ~fallen[-1]
        if not (alive & (begin + CHUNK < horizon)).any():
            break
    steps = {name: np.concatenate([record[name] for record in records]) for name in records[0]}
    control_step = setup.config.physics.control_step
    clips = {
        name: _tracked(steps, alive, horizon, clip == index, clean, control_step)
        for index, name in enumerate(setup.library.names)
    }
    return Trial(steps["observation"][steps["acted"]], clips)


def _start(env: Environment, assets: Assets, key: Array, clip: np.ndarray, frame: np.ndarray, clean: np.ndarray):
    """Episodes with reset noise, and where `clean` without it, to the clip's end."""
    still = dataclasses.replace(env.config, noise=_without_resets(env.config.noise), max_episode_steps=LONGEST)
    noisy = begin_episodes(env, assets, key, jnp.asarray(clip), jnp.asarray(frame))
    exact = begin_episodes(dataclasses.replace(env, config=still), assets, key, jnp.asarray(clip), jnp.asarray(frame))
    mask = jnp.asarray(clean)
    state = select_rows(mask, exact, noisy)
    return tracking.refresh_bodies(env, state, jnp.ones_like(mask))


def _without_resets(noise: NoiseConfig) -> NoiseConfig:
    nothing = (0.0, 0.0, 0.0)
    return dataclasses.replace(
        noise,
        reset_position=nothing,
        reset_orientation=nothing,
        reset_linear_velocity=nothing,
        reset_angular_velocity=nothing,
        reset_joint_position=0.0,
    )


def _advance(env: Environment, assets: Assets, policy: Policy, state: EnvState):
    def one_step(state: EnvState, key: Array):
        observation = tracking.observe(env, assets, state, None)[0]
        state, result = tracking.step(env, assets, state, act(env, policy, observation), key)
        record = {
            "observation": observation,
            "reward": result.reward.normalized_tracking,
            "joint_error": jnp.abs(result.pair.reference.joint_pos - result.pair.joint_pos).mean(-1),
            "terminated": result.terminated,
        }
        return state, record

    return jax.lax.scan(one_step, state, jax.random.split(jax.random.PRNGKey(0), CHUNK))


def _tracked(
    steps: dict[str, np.ndarray],
    survived: np.ndarray,
    horizon: np.ndarray,
    mine: np.ndarray,
    clean: np.ndarray,
    control_step: float,
) -> Tracked:
    """The figures of the episodes `mine`."""

    def mean(name: str, members: np.ndarray) -> float:
        counted = steps["alive"] & members
        return float(steps[name][counted].mean()) if counted.any() else float("nan")

    exact, noisy = mine & clean, mine & ~clean
    return Tracked(
        seconds=float(steps["alive"][:, exact].sum() * control_step),
        horizon=float(horizon[exact].sum() * control_step),
        reward=mean("reward", exact),
        joint_error=mean("joint_error", exact),
        survival=float(survived[noisy].mean()),
        noisy_reward=mean("reward", noisy),
        noisy_joint_error=mean("joint_error", noisy),
    )
