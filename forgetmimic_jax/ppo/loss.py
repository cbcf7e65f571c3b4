"""The PPO losses (Schulman et al. 2017, equations 7 and 9)."""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jax import Array

from forgetmimic_jax.basics.shards import average, shards, total
from forgetmimic_jax.policy.gaussian import entropy, kl_divergence, log_prob
from forgetmimic_jax.ppo.transition import Transition
from forgetmimic_jax.settings.config import Config, PPOConfig

WARM_UP = 0.05  # of a run


@struct.dataclass
class Prediction:
    """What a policy and its critic say at the steps of a batch."""

    mean: Array  # [batch, joint]
    log_std: Array  # [joint] or [batch, joint]
    value: Array  # [batch]


@struct.dataclass
class Batch:
    """Steps that a gradient step learns from. Leading dimension: batch."""

    transition: Transition
    value: Array  # V when the step was taken
    advantage: Array  # normalised
    value_target: Array
    is_target: Array  # bool: the step's clip is to be forgotten
    weight: Array  # in the means of the PPO losses
    base: Prediction | None  # of the frozen base policy, where there is one
    base_kl: Array | None  # weight of the KL to it at the step


def ppo_loss(
    config: Config, batch: Batch, now: Prediction, iteration: Array | None = None
) -> tuple[Array, dict[str, Array]]:
    """Clipped surrogate + value loss − entropy bonus + KL to the base [], to be minimised, and its parts.

    Args:
        config: coefficients.
        batch: the steps.
        now: of the networks that learn.
        iteration: i32[] of the run; PPO does not ask.
    """
    ppo = config.ppo
    log_ratio = log_prob(batch.transition.action, now.mean, now.log_std) - batch.transition.log_prob
    policy_term = policy_loss(log_ratio, batch.advantage, ppo.clip_range, batch.weight)
    value_term = value_loss(
        now.value, batch.value, batch.value_target, ppo.clip_range if ppo.clip_value else None, batch.weight
    )
    entropy_term = entropy(now.log_std)
    loss = policy_term + ppo.value_cost * value_term - ppo.entropy_cost * entropy_term
    metrics = {"policy_loss": policy_term, "value_loss": value_term, "entropy": entropy_term}
    if batch.base is not None and batch.base_kl is not None:
        away = kl_divergence(now.mean, now.log_std, batch.base.mean, batch.base.log_std)
        weight = batch.weight * (batch.base_kl > 0)
        metrics["base_kl"] = mean(away, weight)
        loss += mean(batch.base_kl * away, weight)
    return loss, metrics


def policy_loss(log_ratio: Array, advantage: Array, clip_range: float, weight: Array | None = None) -> Array:
    """Clipped surrogate, to be minimised; arguments [batch], result []."""
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - clip_range, 1.0 + clip_range)
    return -mean(jnp.minimum(ratio * advantage, clipped * advantage), weight)


def value_loss(
    value: Array, old_value: Array, value_target: Array, clip_range: float | None, weight: Array | None = None
) -> Array:
    """Mean squared error to the value target [batch]; with `clip_range` the larger of it and the clipped value's."""
    loss = (value - value_target) ** 2
    if clip_range is not None:
        clipped = old_value + jnp.clip(value - old_value, -clip_range, clip_range)
        loss = jnp.maximum(loss, (clipped - value_target) ** 2)
    return mean(loss, weight)


def mean(values: Array, weight: Array | None) -> Array:
    """Mean [] of values [batch] under weights or a mask [batch]; 0 where nothing has weight.

    On several shards it is this shard's part: the average of the parts is the mean over all of the steps.
    """
    if weight is None:
        return values.mean()
    return (values * weight).sum() / jnp.maximum(average(weight.sum()), 1.0 / shards())


def equal_share(group: Array, groups: int) -> Array:
    """Weights [...], 1 on average, that give every group which is there the same sum, whatever its size.

    Sizes and sums are over all shards.

    Args:
        group: i32[...] from 0.
        groups: how many there may be.
    """
    size = total(jnp.zeros(groups).at[group.reshape(-1)].add(1.0))
    return shards() * group.size / ((size > 0).sum() * size[group])


def adapt_learning_rate(
    learning_rate: Array, kl: Array, target_kl: Array | float, min_learning_rate: float, max_learning_rate: float
) -> Array:
    """÷1.5 above twice the target KL, ×1.5 below half of it, inside the bounds."""
    factor = jnp.where(kl > 2.0 * target_kl, 1.0 / 1.5, jnp.where((kl < 0.5 * target_kl) & (kl > 0.0), 1.5, 1.0))
    return jnp.clip(learning_rate * factor, min_learning_rate, max_learning_rate)


def trapezoid(config: PPOConfig, progress: Array) -> Array:
    """The step size [] at a progress [] through the run of 0 to 1.

    It rises over the run's first twentieth, for a warm start's Adam knows no scale yet and its first steps are blind;
    stays until half; and falls to `min_learning_rate`.
    """
    height = jnp.clip(jnp.minimum(progress / WARM_UP, 2.0 * (1.0 - progress)), 0.0, 1.0)
    return config.min_learning_rate + height * (config.learning_rate - config.min_learning_rate)
