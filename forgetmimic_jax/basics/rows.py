"""Rows of pytrees of arrays."""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array

T = TypeVar("T")


def select_rows(mask: Array, chosen: T, others: T) -> T:
    """Rows of `chosen` where mask [row] holds, of `others` elsewhere; both are pytrees of arrays [row, ...]."""
    return jax.tree.map(lambda a, b: jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b), chosen, others)
