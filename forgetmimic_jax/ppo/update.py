"""One PPO iteration: collect, advantages, epochs, sampler. A pure function of the TrainState, jitted once.

A rule (`ppo.rule.Rule`), such as an unlearning method's, replaces the parts that it names; all else is the same.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jax.sharding import Mesh

from forgetmimic_jax.basics.shards import average, moments, total
from forgetmimic_jax.policy.gaussian import kl_divergence
from forgetmimic_jax.policy.policy import Policy, bound_std
from forgetmimic_jax.ppo.collect import collect, draw_states
from forgetmimic_jax.ppo.gae import centre_branches, generalized_advantages
from forgetmimic_jax.ppo.log import rollout_metrics
from forgetmimic_jax.ppo.loss import Batch, Prediction, adapt_learning_rate, equal_share, trapezoid
from forgetmimic_jax.ppo.rule import Rule
from forgetmimic_jax.ppo.sharding import on_shards
from forgetmimic_jax.ppo.state import TrainState, make_optimizer
from forgetmimic_jax.ppo.transition import Outcome, Transition
from forgetmimic_jax.settings.config import Config, PPOConfig
from forgetmimic_jax.tracking.env import Assets, Environment
from forgetmimic_jax.tracking.focus import Focus
from forgetmimic_jax.tracking.rsi import update_failure_level

Metrics = dict[str, Array]


def make_iteration(
    env: Environment, rule: Rule, mesh: Mesh | None = None
) -> Callable[[Assets, TrainState], tuple[TrainState, Metrics]]:
    """The jitted iteration(assets, state) → (state, metrics) under a training rule; the state is donated.

    With a mesh, `env` is that of one of its shards.
    """

    def on_rollout(assets: Assets, state: TrainState) -> tuple[TrainState, Metrics]:
        state, transition, outcome = collect(env, assets, state, rule)
        advantage, value_target = advantages(env.config.ppo, assets.focus.gae_lambda, outcome)
        batch = make_batch(env.config, assets, transition, outcome.value, advantage, value_target)
        state, losses = improve(env.config, assets.focus, state, batch, rule)
        state = learn_average(env.config.pretrain.average, state)
        state = learn_normalizers(state, transition)
        state = learn_sampler(env.config, state, transition.clip, outcome)
        metrics = losses | rollout_metrics(env.config, assets, state, transition.clip, outcome)
        return dataclasses.replace(state, iteration=state.iteration + 1), metrics

    def on_drawn_states(assets: Assets, state: TrainState) -> tuple[TrainState, Metrics]:
        state, transition = draw_states(env, assets, state)
        nothing = jnp.zeros(transition.clip.shape, jnp.float32)
        batch = make_batch(env.config, assets, transition, nothing, nothing, nothing)
        state, losses = improve(env.config, assets.focus, state, batch, rule)
        metrics = losses | rollout_metrics(env.config, assets, state, transition.clip, None)
        return dataclasses.replace(state, iteration=state.iteration + 1), metrics

    iteration = on_rollout if rule.simulate else on_drawn_states
    return jax.jit(iteration if mesh is None else on_shards(iteration, mesh), donate_argnums=1)


def advantages(config: PPOConfig, gae_lambda: Array, outcome: Outcome) -> tuple[Array, Array]:
    """Advantages and value targets [time, env]; with branches, less the mean of the other branches."""
    advantage, value_target = generalized_advantages(
        outcome.reward,
        outcome.value,
        outcome.next_value,
        outcome.terminated,
        outcome.truncated,
        config.discount,
        gae_lambda,
    )
    if config.branches > 1:
        advantage = centre_branches(advantage, outcome.done, config.branches)
    return advantage, value_target


def make_batch(
    config: Config, assets: Assets, transition: Transition, value: Array, advantage: Array, value_target: Array
) -> Batch:
    """The steps [time · env] that the mini-batches are drawn from, advantages normalised over those of all shards."""
    mean, variance = moments(advantage)
    weight = equal_share(transition.clip, len(assets.is_target)) if config.ppo.equal_clips else jnp.ones_like(value)
    batch = Batch(
        transition=transition,
        value=value,
        advantage=(advantage - mean) / (jnp.sqrt(variance) + 1e-8),
        value_target=value_target,
        is_target=assets.is_target[transition.clip],
        weight=weight,
        base=None if assets.base is None else _at_every_step(predict(assets.base, transition)),
        base_kl=None if assets.focus.base_kl is None else assets.focus.base_kl[transition.clip],
    )
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)


def predict(policy: Policy, transition: Transition) -> Prediction:
    """What a policy and its critic say at the steps [...]; XLA leaves out what no loss uses."""
    mean, log_std = policy.distribution(transition.actor_observation)
    return Prediction(mean, log_std, policy.value(transition.critic_observation))


def _at_every_step(prediction: Prediction) -> Prediction:
    """With the standard deviation repeated for every step, as mini-batches are drawn from it."""
    return dataclasses.replace(prediction, log_std=jnp.broadcast_to(prediction.log_std, prediction.mean.shape))


def improve(run: Config, focus: Focus, state: TrainState, batch: Batch, rule: Rule) -> tuple[TrainState, Metrics]:
    """Epochs of mini-batch gradient steps; a mini-batch is one of every shard, and its gradient their average."""
    config, policy = run.ppo, state.policy
    optimizer = make_optimizer(config)
    size = len(batch.value)

    def loss_of(parameters, data: Batch) -> tuple[Array, Metrics]:
        now = predict(policy.with_parameters(parameters), data.transition)
        loss, metrics = rule.loss(run, data, now, state.iteration)
        return loss, metrics | {"kl": kl_divergence(data.transition.mean, policy.log_std, now.mean, now.log_std).mean()}

    def adapt(learning_rate: Array, kl: Array) -> Array:
        bounds = config.min_learning_rate, config.max_learning_rate
        return adapt_learning_rate(learning_rate, kl, focus.target_kl, *bounds)

    def minibatch(carry, indices: Array):
        parameters, optimizer_state, learning_rate = carry
        data = jax.tree.map(lambda x: x[indices], batch)
        gradient, metrics = average(jax.grad(loss_of, has_aux=True)(parameters, data))
        if config.schedule == "adaptive":
            learning_rate = adapt(learning_rate, metrics["kl"])
        metrics["gradient_norm"] = optax.tree.norm(gradient)
        updates, optimizer_state = optimizer.update(gradient, optimizer_state)
        step = learning_rate if focus.settle is None else focus.settle * learning_rate
        actor, critic = jax.tree.map(lambda p, u: p - step * u, parameters, updates)
        return ((bound_std(actor), critic), optimizer_state, learning_rate), metrics

    def epoch(carry, key: Array):
        return jax.lax.scan(minibatch, carry, shuffled(key, size, config.minibatches))

    key, epoch_key = jax.random.split(state.key)
    learning_rate = state.learning_rate
    if config.schedule == "trapezoid":
        learning_rate = trapezoid(config, state.iteration / run.iterations)
    carry = (policy.parameters, state.optimizer, learning_rate)
    (parameters, optimizer_state, learning_rate), metrics = jax.lax.scan(
        epoch, carry, jax.random.split(epoch_key, config.epochs)
    )
    metrics = {name: value.mean() for name, value in metrics.items()} | {"kl_final": metrics["kl"][-1].mean()}
    if config.schedule == "adaptive_iteration":
        learning_rate = adapt(learning_rate, metrics["kl_final"])
    metrics["learning_rate"] = learning_rate
    metrics["std"] = jnp.exp(policy.log_std).mean()
    state = dataclasses.replace(
        state,
        policy=policy.with_parameters(parameters),
        optimizer=optimizer_state,
        learning_rate=learning_rate,
        key=key,
    )
    return state, metrics


def shuffled(key: Array, size: int, minibatches: int) -> Array:
    """Indices [minibatch, n] of one epoch over `size` steps in random order; a remainder is left out."""
    indices = jax.random.permutation(key, size)[: size - size % minibatches]
    return indices.reshape(minibatches, -1)


def learn_average(iterations: int, state: TrainState) -> TrainState:
    """The average, where the state has one, moves towards the new parameters by 1 / `iterations` of the distance."""
    if state.average is None:
        return state
    average = jax.tree.map(lambda old, new: old + (new - old) / iterations, state.average, state.policy.parameters)
    return dataclasses.replace(state, average=average)


def learn_normalizers(state: TrainState, transition: Transition) -> TrainState:
    """The normalisers learn the rollout; the old ones produced it, so this comes after the gradient steps."""
    policy = dataclasses.replace(
        state.policy,
        actor_normalizer=state.policy.actor_normalizer.updated(transition.actor_observation),
        critic_normalizer=state.policy.critic_normalizer.updated(transition.critic_observation),
    )
    return dataclasses.replace(state, policy=policy)


def learn_sampler(config: Config, state: TrainState, clip: Array, outcome: Outcome) -> TrainState:
    """Failure levels learn from the episodes that ended, and diverged environments are counted.

    Args:
        config: of the run.
        state: before.
        clip: i32[time, env] of each step.
        outcome: of each step.
    """
    failure_level = update_failure_level(
        config.sampling, state.failure_level, outcome.done, outcome.failure, clip, outcome.start_bin
    )
    diverged = state.diverged + total(outcome.diverged.sum().astype(jnp.int32))
    return dataclasses.replace(state, failure_level=failure_level, diverged=diverged)
