"""The diagonal Gaussian over actions: density, entropy and divergence."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

LOG_2PI = 1.8378770664093453
MIN_STD, MAX_STD = 0.05, 2.0


def log_prob(action: Array, mean: Array, log_std: Array) -> Array:
    """Log density [...] of a diagonal Gaussian, summed over the last dimension."""
    z = (action - mean) * jnp.exp(-log_std)
    return (-0.5 * z**2 - log_std - 0.5 * LOG_2PI).sum(-1)


def entropy(log_std: Array) -> Array:
    """Entropy [...] of a diagonal Gaussian."""
    return (log_std + 0.5 * (LOG_2PI + 1.0)).sum(-1)


def kl_divergence(mean: Array, log_std: Array, new_mean: Array, new_log_std: Array) -> Array:
    """KL(old ‖ new) [...] of diagonal Gaussians."""
    variance_ratio = jnp.exp(2.0 * (log_std - new_log_std))
    shift = ((mean - new_mean) * jnp.exp(-new_log_std)) ** 2
    return (new_log_std - log_std + 0.5 * (variance_ratio + shift - 1.0)).sum(-1)
