"""The running mean and variance of an observation, and what they make of it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from forgetmimic_jax.basics.shards import moments, shards

VARIANCE_FLOOR = 1e-6  # added to an observation's variance before the division by its root
OBSERVATION_LIMIT = 10.0  # standard deviations
MAX_COUNT = 1e8  # past it the statistics forget slowly instead of freezing


@struct.dataclass
class Normalizer:
    """Mean and variance of an observation over the batches seen so far."""

    mean: Array  # [features]
    variance: Array  # [features]
    count: Array  # [] observations seen

    @classmethod
    def create(cls, size: int) -> Normalizer:
        """Mean 0, variance 1, nothing seen."""
        return cls(
            mean=jnp.zeros((size,), jnp.float32),
            variance=jnp.ones((size,), jnp.float32),
            count=jnp.zeros((), jnp.float32),
        )

    def __call__(self, observation: Array) -> Array:
        """Observation [..., features] with mean 0 and variance 1, clipped to ±10."""
        scaled = (observation - self.mean) * jax.lax.rsqrt(self.variance + VARIANCE_FLOOR)
        return jnp.clip(scaled, -OBSERVATION_LIMIT, OBSERVATION_LIMIT)

    def updated(self, observation: Array) -> Normalizer:
        """The statistics after a batch [..., features] of every shard (Chan et al. 1983, parallel variance).

        A feature that never varied, such as the wrench of a training without one, starts anew when it first varies.
        """
        flat = observation.reshape(-1, observation.shape[-1])
        count = jnp.float32(shards() * flat.shape[0])
        mean, variance = moments(flat, axis=0)
        before = jnp.where(self.variance > 0.0, self.count, 0.0)
        total = before + count
        shift = mean - self.mean
        merged = self.variance * before + variance * count + shift**2 * before * count / total
        return Normalizer(
            mean=self.mean + shift * count / total,
            variance=merged / total,
            count=jnp.minimum(self.count + count, MAX_COUNT),
        )
