"""One PPO iteration: collect, advantages, epochs, sampler. A pure function of the TrainState, jitted once.

An unlearning method replaces the rules that it names (`unlearning.method.Method`); all else is the same program.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

from forgetmimic_jax.policy import network
from forgetmimic_jax.policy.network import bound_std, kl_divergence, log_prob, normalize, update_normalizer
from forgetmimic_jax.ppo.gae import centre_branches, generalized_advantages
from forgetmimic_jax.ppo.loss import Batch, Prediction, adapt_learning_rate, equal_share, trapezoid
from forgetmimic_jax.ppo.state import Policy, TrainState, make_actor, make_critic, make_optimizer
from forgetmimic_jax.settings.config import PPOConfig
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.env import Assets, Environment
from forgetmimic_jax.tracking.rsi import bin_probabilities, episode_failure, sample_start, update_failure_level
from forgetmimic_jax.tracking.wrench import wrench_gain
from forgetmimic_jax.unlearning.registry import method_of
from forgetmimic_jax.unlearning.threshold import threshold_metrics


@struct.dataclass
class Trajectory:
    """A rollout. Leading dimensions: time, env."""

    actor_observation: Array
    critic_observation: Array
    action: Array
    log_prob: Array
    mean: Array
    value: Array
    next_value: Array  # V of the state reached, before any reset
    reward: Array  # R' × control step
    tracking: Array  # R_track
    regularisation: Array  # R_reg
    normalized_tracking: Array  # r̄
    terminated: Array
    truncated: Array
    diverged: Array
    clip: Array
    start_bin: Array
    failure: Array  # f_episode, meaningful where the episode ended
    steps: Array  # steps lived, meaningful where the episode ended
    wrench_gain: Array
    causes: dict[str, Array]


Metrics = dict[str, Array]


def make_iteration(env: Environment) -> Callable[[Assets, TrainState], tuple[TrainState, Metrics]]:
    """The jitted iteration(assets, state) → (state, metrics); the state is donated."""

    gather = collect if method_of(env.config).simulate else draw_states

    def iteration(assets: Assets, state: TrainState) -> tuple[TrainState, Metrics]:
        state, trajectory = gather(env, assets, state)
        advantage, target = generalized_advantages(
            trajectory.reward,
            trajectory.value,
            trajectory.next_value,
            trajectory.terminated,
            trajectory.truncated,
            env.config.ppo.discount,
            env.config.ppo.gae_lambda,
        )
        if env.config.ppo.branches > 1:
            done = trajectory.terminated | trajectory.truncated
            advantage = centre_branches(advantage, done, env.config.ppo.branches)
        state, losses = improve(env, assets, state, trajectory, advantage, target)
        return learn_sampler(env, assets, state, trajectory, losses)

    return jax.jit(iteration, donate_argnums=1)


def collect(env: Environment, assets: Assets, state: TrainState) -> tuple[TrainState, Trajectory]:
    """`num_steps` control steps of every environment with the current policy.

    With `branches`, the first of every group of environments lends the others its state to set out from.
    """
    config, policy, method = env.config, state.policy, method_of(env.config)
    actor, critic = make_actor(config, env.robot.num_joints), make_critic(config)
    probabilities = bin_probabilities(config.sampling, assets.bins, state.failure_level, assets.is_target)
    gains = wrench_gain(config.wrench, state.failure_level)

    def value_of(observation: Array) -> Array:
        return network.value(critic, policy.critic, normalize(policy.critic_normalizer, observation))

    def observe(episodes: tracking.EnvState, key: Array) -> tuple[Array, Array]:
        actor_obs, critic_obs = tracking.observe(env, assets, episodes, key if env.noisy else None)
        return method.observation(actor_obs, assets.is_target[episodes.clip]), critic_obs

    def one_step(carry, key: Array):
        before, actor_obs, critic_obs = carry
        action_key, step_key, reset_key, observe_key = jax.random.split(key, 4)
        mean, log_std = network.distribution(actor, policy.actor, normalize(policy.actor_normalizer, actor_obs))
        action = mean + jnp.exp(log_std) * jax.random.normal(action_key, mean.shape)
        after, result = tracking.step(env, assets, before, action, step_key)
        done = result.terminated | result.truncated
        fresh = tracking.reset_where(env, assets, after, done, reset_key, probabilities, gains)
        next_actor_obs, next_critic_obs = observe(fresh, observe_key)
        last_critic_obs = tracking.observe(env, assets, after, None)[1]
        is_target, reward_key = assets.is_target[before.clip], jax.random.fold_in(key, 4)  # none of the four above
        trajectory = Trajectory(
            actor_observation=actor_obs,
            critic_observation=critic_obs,
            action=action,
            log_prob=log_prob(action, mean, log_std),
            mean=mean,
            value=value_of(critic_obs),
            next_value=value_of(last_critic_obs),
            reward=method.reward(config, result.reward, is_target, reward_key) * env.control_step,
            tracking=result.reward.tracking,
            regularisation=result.reward.regularisation,
            normalized_tracking=result.reward.normalized_tracking,
            terminated=result.terminated,
            truncated=result.truncated,
            diverged=result.diverged,
            clip=before.clip,
            start_bin=before.start_bin,
            failure=episode_failure(config.sampling, after.tracking_sum, after.step, after.horizon),
            steps=after.step,
            wrench_gain=before.wrench_gain,
            causes=result.causes,
        )
        return (fresh, next_actor_obs, next_critic_obs), trajectory

    key, first_key, rollout_key = jax.random.split(state.key, 3)
    keys = jax.random.split(rollout_key, config.ppo.num_steps)
    leader = jnp.arange(env.num_envs) // config.ppo.branches * config.ppo.branches
    start = jax.tree.map(lambda x: x[leader], state.env) if config.ppo.branches > 1 else state.env
    (episodes, _, _), trajectory = jax.lax.scan(one_step, (start, *observe(start, first_key)), keys)
    return dataclasses.replace(state, env=episodes, key=key), trajectory


def draw_states(env: Environment, assets: Assets, state: TrainState) -> tuple[TrainState, Trajectory]:
    """Starts of episodes in the place of a rollout: nothing moves, nothing is rewarded and no episode ends."""
    config, policy = env.config, state.policy
    actor = make_actor(config, env.robot.num_joints)
    probabilities = bin_probabilities(config.sampling, assets.bins, state.failure_level, assets.is_target)
    nothing, never = jnp.zeros((env.num_envs,), jnp.float32), jnp.zeros((env.num_envs,), bool)

    def one_batch(key: Array) -> Trajectory:
        start_key, episode_key = jax.random.split(key)
        clip, start_bin, frame = sample_start(start_key, probabilities, assets.bins, env.num_envs)
        episodes = tracking.start_episodes(env, assets, episode_key, clip, start_bin, frame, nothing)
        actor_obs, critic_obs = tracking.observe(env, assets, episodes, None)
        mean, log_std = network.distribution(actor, policy.actor, normalize(policy.actor_normalizer, actor_obs))
        return Trajectory(
            actor_observation=actor_obs,
            critic_observation=critic_obs,
            action=mean,
            log_prob=log_prob(mean, mean, log_std),
            mean=mean,
            **dict.fromkeys(("value", "next_value", "reward", "tracking", "regularisation"), nothing),
            **dict.fromkeys(("normalized_tracking", "failure", "wrench_gain"), nothing),
            **dict.fromkeys(("terminated", "truncated", "diverged"), never),
            clip=clip,
            start_bin=start_bin,
            steps=episodes.step,
            causes={},
        )

    key, draw_key = jax.random.split(state.key)
    trajectory = jax.lax.map(one_batch, jax.random.split(draw_key, config.ppo.num_steps))
    return dataclasses.replace(state, key=key), trajectory


def improve(
    env: Environment, assets: Assets, state: TrainState, trajectory: Trajectory, advantage: Array, target: Array
) -> tuple[TrainState, Metrics]:
    """Epochs of mini-batch gradient steps, then the normalisers learn the batch (the old ones produced it)."""
    config: PPOConfig = env.config.ppo
    policy, method = state.policy, method_of(env.config)
    actor, critic = make_actor(env.config, env.robot.num_joints), make_critic(env.config)
    optimizer = make_optimizer(env.config)
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    old_log_std = network.distribution(actor, policy.actor, trajectory.actor_observation[0, :1])[1]
    batch = Batch(
        actor_observation=normalize(policy.actor_normalizer, trajectory.actor_observation),
        critic_observation=normalize(policy.critic_normalizer, trajectory.critic_observation),
        action=trajectory.action,
        log_prob=trajectory.log_prob,
        mean=trajectory.mean,
        value=trajectory.value,
        advantage=advantage,
        target=target,
        is_target=assets.is_target[trajectory.clip],
        clip=trajectory.clip,
        weight=equal_share(trajectory.clip, len(assets.is_target)) if config.equal_clips else jnp.ones_like(advantage),
        base=_base_prediction(env, assets.base, trajectory),
    )
    batch = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)
    size = batch.value.shape[0]

    def loss_of(params, data: Batch) -> tuple[Array, Metrics]:
        mean, log_std = network.distribution(actor, params[0], data.actor_observation)
        now = Prediction(mean, log_std, network.value(critic, params[1], data.critic_observation))
        loss, metrics = method.loss(env.config, data, now, state.iteration)
        return loss, metrics | {"kl": kl_divergence(data.mean, old_log_std, mean, log_std).mean()}

    def adapt(learning_rate: Array, kl: Array) -> Array:
        bounds = config.min_learning_rate, config.max_learning_rate
        return adapt_learning_rate(learning_rate, kl, config.target_kl, *bounds)

    def minibatch(carry, indices: Array):
        params, optimizer_state, learning_rate = carry
        data = jax.tree.map(lambda x: x[indices], batch)
        gradient, metrics = jax.grad(loss_of, has_aux=True)(params, data)
        if config.schedule == "adaptive":
            learning_rate = adapt(learning_rate, metrics["kl"])
        metrics["gradient_norm"] = optax.tree.norm(gradient)
        updates, optimizer_state = optimizer.update(gradient, optimizer_state)
        actor_parameters, critic_parameters = jax.tree.map(lambda p, u: p - learning_rate * u, params, updates)
        params = (bound_std(actor_parameters), critic_parameters)
        return (params, optimizer_state, learning_rate), metrics

    def epoch(carry, key: Array):
        indices = jax.random.permutation(key, size)[: size - size % config.minibatches]
        return jax.lax.scan(minibatch, carry, indices.reshape(config.minibatches, -1))

    key, epoch_key = jax.random.split(state.key)
    learning_rate = state.learning_rate
    if config.schedule == "trapezoid":
        learning_rate = trapezoid(config, state.iteration / env.config.iterations)
    carry = ((policy.actor, policy.critic), state.optimizer, learning_rate)
    (params, optimizer_state, learning_rate), metrics = jax.lax.scan(
        epoch, carry, jax.random.split(epoch_key, config.epochs)
    )
    metrics = {name: value.mean() for name, value in metrics.items()} | {"kl_final": metrics["kl"][-1].mean()}
    if config.schedule == "adaptive_iteration":
        learning_rate = adapt(learning_rate, metrics["kl_final"])
    metrics["learning_rate"] = learning_rate
    metrics["std"] = jnp.exp(old_log_std).mean()
    new_policy = dataclasses.replace(policy, actor=params[0], critic=params[1])
    if method.simulate:  # what was not lived says nothing of what will be seen
        new_policy = dataclasses.replace(
            new_policy,
            actor_normalizer=update_normalizer(policy.actor_normalizer, trajectory.actor_observation),
            critic_normalizer=update_normalizer(policy.critic_normalizer, trajectory.critic_observation),
        )
    state = dataclasses.replace(
        state, policy=new_policy, optimizer=optimizer_state, learning_rate=learning_rate, key=key
    )
    return state, metrics


def _base_prediction(env: Environment, base: Policy | None, trajectory: Trajectory) -> Prediction | None:
    """What the frozen base says at every step [time, env]; XLA leaves it out where no loss asks for it."""
    if base is None:
        return None
    actor, critic = make_actor(env.config, env.robot.num_joints), make_critic(env.config)
    seen = normalize(base.actor_normalizer, trajectory.actor_observation)
    mean, log_std = network.distribution(actor, base.actor, seen)
    privileged = normalize(base.critic_normalizer, trajectory.critic_observation)
    return Prediction(mean, jnp.broadcast_to(log_std, mean.shape), network.value(critic, base.critic, privileged))


def learn_sampler(
    env: Environment, assets: Assets, state: TrainState, trajectory: Trajectory, losses: Metrics
) -> tuple[TrainState, Metrics]:
    """Failure levels learn from the ended episodes; the metrics of the iteration."""
    config = env.config
    done = trajectory.terminated | trajectory.truncated
    failure_level = update_failure_level(
        config.sampling, state.failure_level, done, trajectory.failure, trajectory.clip, trajectory.start_bin
    )
    diverged = trajectory.diverged.sum().astype(jnp.int32)
    probabilities = bin_probabilities(config.sampling, assets.bins, failure_level, assets.is_target)
    metrics = losses | _metrics(env, assets, trajectory, done, probabilities) | {"diverged": diverged}
    metrics["top_bin_probability"] = probabilities.max()
    state = dataclasses.replace(
        state, failure_level=failure_level, iteration=state.iteration + 1, diverged=state.diverged + diverged
    )
    return state, metrics


def _metrics(env: Environment, assets: Assets, trajectory: Trajectory, done: Array, probabilities: Array) -> Metrics:
    clips = len(assets.is_target)
    flat_clip = trajectory.clip.reshape(-1)

    def per_clip(values: Array) -> Array:
        return jax.ops.segment_sum(values.reshape(-1).astype(jnp.float32), flat_clip, clips)

    steps, ended = per_clip(jnp.ones_like(trajectory.reward)), per_clip(done)
    ended_steps, completed = per_clip(trajectory.steps * done), per_clip(trajectory.truncated)
    skill = per_clip((1.0 - trajectory.failure) * done)
    tracking, regularisation = per_clip(trajectory.tracking), per_clip(trajectory.regularisation)
    normalized = per_clip(trajectory.normalized_tracking)
    metrics = {
        "reward": trajectory.reward.mean(),
        "value": trajectory.value.mean(),
        "tracking_reward": trajectory.normalized_tracking.mean(),
        "episode_length": ended_steps.sum() / jnp.maximum(ended.sum(), 1),
        "completed": completed.sum() / jnp.maximum(ended.sum(), 1),
        "wrench_gain": trajectory.wrench_gain.mean(),
        "clip/steps": steps,
        "clip/episodes": ended,
        "clip/episode_length_sum": ended_steps,
        "clip/completed": completed,
        "clip/survival_weighted_sum": skill,
        "clip/tracking_sum": normalized,
        "clip/probability": probabilities.sum(-1),
    }
    metrics |= {f"terminated/{name}": value.sum() for name, value in trajectory.causes.items()}
    return metrics | threshold_metrics(env.config, assets.is_target, steps, tracking, regularisation, normalized)
