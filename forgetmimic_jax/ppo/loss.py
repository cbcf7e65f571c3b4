"""The PPO losses (Schulman et al. 2017, equations 7 and 9)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array


def policy_loss(log_ratio: Array, advantage: Array, clip: float) -> Array:
    """Clipped surrogate, to be minimised; arguments [batch], result []."""
    ratio = jnp.exp(log_ratio)
    return -jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - clip, 1.0 + clip) * advantage).mean()


def value_loss(value: Array, old_value: Array, target: Array, clip: float | None) -> Array:
    """Mean squared error to the target [batch]; with `clip` the worse of it and of the value kept within old ± clip."""
    loss = (value - target) ** 2
    if clip is not None:
        clipped = old_value + jnp.clip(value - old_value, -clip, clip)
        loss = jnp.maximum(loss, (clipped - target) ** 2)
    return loss.mean()


def adapt_learning_rate(
    learning_rate: Array, kl: Array, target_kl: float, min_learning_rate: float, max_learning_rate: float
) -> Array:
    """÷1.5 above twice the target KL, ×1.5 below half of it, inside the bounds."""
    factor = jnp.where(kl > 2.0 * target_kl, 1.0 / 1.5, jnp.where((kl < 0.5 * target_kl) & (kl > 0.0), 1.5, 1.0))
    return jnp.clip(learning_rate * factor, min_learning_rate, max_learning_rate)
