"""TrainState: the one pytree that holds all that a run can change.

Saved and restored, a run continues as if it had not stopped.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

from forgetmimic_jax.policy.policy import Policy, init_policy
from forgetmimic_jax.settings.config import PPOConfig
from forgetmimic_jax.tracking.env import (
    Assets,
    Environment,
    EnvState,
    observe,
    reset_where,
    start_episodes,
    start_table,
)
from forgetmimic_jax.tracking.rsi import Start, initial_failure_level


@struct.dataclass
class TrainState:
    """Everything. Every leaf has a dtype, so that the second iteration does not compile again."""

    policy: Policy
    optimizer: optax.OptState
    learning_rate: Array  # []
    env: EnvState
    failure_level: Array  # [clip, bin] L
    key: Array
    iteration: Array  # i32[]
    diverged: Array  # i32[] environments reset because of NaN or Inf, so far
    average: Any = None  # the policy's parameters averaged over iterations (Polyak and Juditsky 1992); None: not wanted

    @property
    def averaged(self) -> Policy:
        """The policy with the averaged parameters, where there are any."""
        return self.policy if self.average is None else self.policy.with_parameters(self.average)


def make_optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Adam on clipped gradients; the step size is applied by the update, where the KL rule can change it."""
    return optax.chain(optax.clip_by_global_norm(config.max_gradient_norm), optax.scale_by_adam())


def init_state(
    env: Environment, assets: Assets, key: Array, policy: Policy | None = None, failure_level: Array | None = None
) -> TrainState:
    """A fresh run. With `policy`, a warm start: networks and normalisers from it, Adam reset.

    Args:
        env: static part.
        assets: constant arrays.
        key: random key.
        policy: of an earlier run.
        failure_level: L [clip, bin] of an earlier run, for the `frozen` sampler.
    """
    config = env.config
    state_key, policy_key, start_key, episode_key = jax.random.split(key, 4)
    if failure_level is None:
        failure_level = initial_failure_level(config.sampling, assets.bins)
    zeros = jnp.zeros((env.num_envs,), jnp.int32)
    episodes = start_episodes(env, assets, episode_key, Start(zeros, zeros, zeros), zeros.astype(jnp.float32))
    starts = start_table(config, assets, failure_level)
    episodes = reset_where(env, assets, episodes, jnp.ones((env.num_envs,), bool), start_key, starts)
    if policy is None:
        actor, critic = observe(env, assets, episodes, None)
        policy = init_policy(config.ppo, env.robot.num_joints, actor.shape[1], critic.shape[1], policy_key)
    state = TrainState(
        policy=policy,
        optimizer=make_optimizer(config.ppo).init(policy.parameters),
        learning_rate=jnp.asarray(config.ppo.learning_rate, jnp.float32),
        env=episodes,
        failure_level=failure_level,
        key=state_key,
        iteration=jnp.zeros((), jnp.int32),
        diverged=jnp.zeros((), jnp.int32),
    )
    return dataclasses.replace(state, average=policy.parameters) if config.pretrain.average else state
