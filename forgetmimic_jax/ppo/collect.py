"""The steps of an iteration: a rollout of the current policy, or reference states in its place."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from forgetmimic_jax.policy.gaussian import log_prob
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.ppo.rule import Rule
from forgetmimic_jax.ppo.state import TrainState
from forgetmimic_jax.ppo.transition import Outcome, Transition
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.env import Assets, Environment
from forgetmimic_jax.tracking.rsi import episode_failure, sample_start


def collect(env: Environment, assets: Assets, state: TrainState, rule: Rule) -> tuple[TrainState, Transition, Outcome]:
    """`num_steps` control steps of every environment with the current policy.

    With `branches`, every group of environments starts from the state of its first one.
    """
    config, policy = env.config, state.policy
    starts = tracking.start_table(config, assets, state.failure_level)
    unknown = jnp.zeros((env.num_envs,))  # the values, until the rollout is over

    def observe(episodes: tracking.EnvState, key: Array) -> tuple[Array, Array]:
        actor_obs, critic_obs = tracking.observe(env, assets, episodes, key if env.noisy else None)
        return rule.observation(config, actor_obs, assets.is_target[episodes.clip]), critic_obs

    def one_step(carry, key: Array):
        before, actor_obs, critic_obs = carry
        action_key, step_key, reset_key, observe_key = jax.random.split(key, 4)
        mean, log_std = policy.distribution(actor_obs)
        action = mean + jnp.exp(log_std) * jax.random.normal(action_key, mean.shape)
        after, result = tracking.step(env, assets, before, action, step_key)
        fresh = tracking.reset_where(env, assets, after, result.terminated | result.truncated, reset_key, starts)
        last_critic_obs = tracking.observe(env, assets, after, None)[1]
        reward_key = jax.random.fold_in(key, 4)  # none of the four above
        reward = rule.reward(config, result.reward, assets.is_target[before.clip], reward_key)
        transition = Transition(
            actor_observation=actor_obs,
            critic_observation=critic_obs,
            action=action,
            log_prob=log_prob(action, mean, log_std),
            mean=mean,
            clip=before.clip,
            taught=rule.teach(env, assets, before) if rule.teach else None,
        )
        outcome = Outcome(
            reward=reward * env.control_step,
            value=unknown,
            next_value=unknown,
            tracking=result.reward.tracking,
            regularisation=result.reward.regularisation,
            normalized_tracking=result.reward.normalized_tracking,
            terminated=result.terminated,
            truncated=result.truncated,
            diverged=result.diverged,
            start_bin=before.start_bin,
            failure=episode_failure(config.sampling, after.tracking_sum, after.step, after.horizon),
            steps=after.step,
            wrench_gain=before.wrench_gain,
            causes=result.causes,
        )
        return (fresh, *observe(fresh, observe_key)), (transition, outcome, last_critic_obs)

    key, first_key, rollout_key = jax.random.split(state.key, 3)
    keys = jax.random.split(rollout_key, config.ppo.num_steps)
    leader = jnp.arange(env.num_envs) // config.ppo.branches * config.ppo.branches
    start = jax.tree.map(lambda x: x[leader], state.env) if config.ppo.branches > 1 else state.env
    first = (start, *observe(start, first_key))
    (episodes, _, critic_obs), (transition, outcome, last_critic_obs) = jax.lax.scan(one_step, first, keys)
    # The critic is not needed to act, so it sees the whole rollout at once. That is faster.
    value = policy.value(transition.critic_observation)
    following = jnp.concatenate([value[1:], policy.value(critic_obs)[None]])
    last_value = values_where(policy, last_critic_obs, outcome.truncated, env.num_envs)
    outcome = dataclasses.replace(outcome, value=value, next_value=jnp.where(outcome.truncated, last_value, following))
    return dataclasses.replace(state, env=episodes, key=key), transition, outcome


def values_where(policy: Policy, observation: Array, mask: Array, chunk: int) -> Array:
    """V [...] at critic observations [..., features] where the mask [...] is true, and 0 elsewhere.

    Few rows are true. So the critic sees these rows alone, `chunk` rows at a time.
    """
    rows = observation.reshape(-1, observation.shape[-1])
    wanted = jnp.argsort(~mask.reshape(-1), stable=True)  # the true rows first
    count = mask.sum()

    def one_chunk(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        begin, values = carry
        chosen = jax.lax.dynamic_slice(wanted, (begin,), (chunk,))
        return begin + chunk, values.at[chosen].set(policy.value(rows[chosen]))

    start = (jnp.zeros((), count.dtype), jnp.zeros(len(rows)))
    _, values = jax.lax.while_loop(lambda carry: carry[0] < count, one_chunk, start)
    return jnp.where(mask, values.reshape(mask.shape), 0.0)


def draw_states(env: Environment, assets: Assets, state: TrainState) -> tuple[TrainState, Transition]:
    """Starts of episodes in the place of a rollout: nothing moves, nothing is rewarded and no episode ends."""
    config, policy = env.config, state.policy
    probabilities = tracking.start_probabilities(config, assets, state.failure_level)
    no_gain = jnp.zeros((env.num_envs,), jnp.float32)

    def one_batch(key: Array) -> Transition:
        start_key, episode_key = jax.random.split(key)
        start = sample_start(config.sampling, start_key, probabilities, assets.bins, env.num_envs)
        episodes = tracking.start_episodes(env, assets, episode_key, start, no_gain)
        episodes = tracking.refresh_bodies(env, episodes, jnp.ones((env.num_envs,), bool))
        actor_obs, critic_obs = tracking.observe(env, assets, episodes, None)
        mean, log_std = policy.distribution(actor_obs)
        return Transition(
            actor_obs, critic_obs, action=mean, log_prob=log_prob(mean, mean, log_std), mean=mean, clip=start.clip
        )

    key, draw_key = jax.random.split(state.key)
    transition = jax.lax.map(one_batch, jax.random.split(draw_key, config.ppo.num_steps))
    return dataclasses.replace(state, key=key), transition
