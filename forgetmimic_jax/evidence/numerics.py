"""Weights with less precision, or with noise: what unlearning hid in small differences comes back.

Four-bit weights brought back what language models had unlearned (Zhang et al. 2024, "Catastrophic Failure of LLM
Unlearning via Quantization"). Only the actor is changed, since the critic does not act.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from forgetmimic_jax.policy.policy import Policy

Change = Callable[[Array, Array], Array]  # a layer's weights [input, output] and a random key → the new weights


def quantised(weights: Array, bits: int) -> Array:
    """Weights [input, output] as integers of `bits` bits, times a scale for each output.

    The scale is the output's largest weight over 2^(bits − 1) − 1. Rounding is to the nearest, ties to even.
    """
    largest = 2 ** (bits - 1) - 1
    scale = jnp.abs(weights).max(axis=0) / largest
    return jnp.round(weights / jnp.where(scale > 0.0, scale, 1.0)) * scale


def half_precision(weights: Array) -> Array:
    """Weights rounded to bfloat16, in float32 again."""
    return weights.astype(jnp.bfloat16).astype(jnp.float32)


def noisy(share: float, weights: Array, key: Array) -> Array:
    """Weights with Gaussian noise of `share` of their own standard deviation."""
    return weights + share * weights.std() * jax.random.normal(key, weights.shape)


NOISES = (0.01, 0.03, 0.1)
CHANGES: Mapping[str, Change] = {
    "bf16": lambda weights, key: half_precision(weights),
    "int8": lambda weights, key: quantised(weights, 8),
    "int4": lambda weights, key: quantised(weights, 4),
    **{f"noise {share:.0%}": functools.partial(noisy, share) for share in NOISES},
}


def changed(policy: Policy, change: Change, seed: int = 0) -> Policy:
    """The policy with every layer of its actor changed; biases and exploration noise stay.

    Args:
        policy: any.
        change: of `CHANGES`.
        seed: of the noise.
    """
    keys = iter(jax.random.split(jax.random.PRNGKey(seed), len(jax.tree.leaves(policy.actor))))

    def layer(path: Any, weights: Array) -> Array:
        key = next(keys)
        return change(weights, key) if jax.tree_util.keystr(path[-1:], simple=True) == "kernel" else weights

    return dataclasses.replace(policy, actor=jax.tree_util.tree_map_with_path(layer, policy.actor))
