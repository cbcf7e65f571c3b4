"""Sums and means over the shards of a training.

A training on several devices gives each of them a shard: its part of the environments. The functions of an iteration
see the steps of one shard, and what they sum or average over steps goes through here. Where there is only one shard,
nothing happens, so that such a program has the same numbers as one without these calls.
"""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array

T = TypeVar("T")

AXIS = "shard"  # the mesh's only axis


def shards() -> int:
    """How many shards the function that is traced runs on; 1 outside of `jax.shard_map`."""
    try:
        return int(jax.lax.axis_size(AXIS))
    except NameError:  # no such axis
        return 1


def total(tree: T) -> T:
    """The sum over the shards of every leaf."""
    return jax.lax.psum(tree, AXIS) if shards() > 1 else tree


def average(tree: T) -> T:
    """The mean over the shards of every leaf."""
    return jax.lax.pmean(tree, AXIS) if shards() > 1 else tree


def moments(values: Array, axis: int | None = None) -> tuple[Array, Array]:
    """Mean and variance over the values of all shards; every shard has the same number of them.

    Args:
        values: [...] of this shard.
        axis: the axis to take them over; all by default.
    """
    mean = average(values.mean(axis))
    return mean, average(jnp.square(values - mean).mean(axis))
