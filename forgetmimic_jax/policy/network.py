"""Actor and critic (ELU multi-layer perceptrons), the Gaussian policy, and the running observation normaliser."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

LOG_2PI = 1.8378770664093453
MIN_STD, MAX_STD = 0.05, 2.0
VARIANCE_FLOOR = 1e-6  # added to an observation's variance before dividing by its root
OBSERVATION_LIMIT = 10.0  # standard deviations


class MLP(nn.Module):
    """ELU perceptron; the last layer is linear."""

    layers: tuple[int, ...]
    outputs: int
    output_scale: float

    @nn.compact
    def __call__(self, x: Array) -> Array:
        for width in self.layers:
            x = nn.elu(nn.Dense(width, kernel_init=nn.initializers.orthogonal(2**0.5))(x))
        return nn.Dense(self.outputs, kernel_init=nn.initializers.orthogonal(self.output_scale))(x)


class Actor(nn.Module):
    """Mean action [..., joint] and one learnable log standard deviation per action dimension [joint]."""

    layers: tuple[int, ...]
    actions: int
    initial_std: float

    @nn.compact
    def __call__(self, observation: Array) -> tuple[Array, Array]:
        mean = MLP(self.layers, self.actions, output_scale=0.01)(observation)
        log_std = self.param("log_std", nn.initializers.constant(jnp.log(self.initial_std)), (self.actions,))
        return mean, log_std


def bound_std(parameters: Any) -> Any:
    """Actor parameters with the standard deviation in [MIN_STD, MAX_STD].

    After a gradient step, not inside the network: there a clip would leave what lies outside without a gradient back.
    """
    log_std = jnp.clip(parameters["params"]["log_std"], jnp.log(MIN_STD), jnp.log(MAX_STD))
    return {**parameters, "params": {**parameters["params"], "log_std": log_std}}


class Critic(nn.Module):
    """Value [...] of a privileged observation."""

    layers: tuple[int, ...]

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        return MLP(self.layers, 1, output_scale=1.0)(observation)[..., 0]


def distribution(actor: Actor, parameters: Any, observation: Array) -> tuple[Array, Array]:
    """Mean action [..., joint] and log standard deviation [joint] at a normalised observation [..., features]."""
    mean_and_log_std: Any = actor.apply(parameters, observation)
    return mean_and_log_std


def value(critic: Critic, parameters: Any, observation: Array) -> Array:
    """V [...] at a normalised privileged observation [..., features]."""
    result: Any = critic.apply(parameters, observation)
    return result


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


@struct.dataclass
class Normalizer:
    """Running mean and variance of an observation, merged batch by batch (Chan et al.)."""

    mean: Array  # [features]
    variance: Array  # [features]
    count: Array  # [] observations seen


def init_normalizer(size: int) -> Normalizer:
    """Mean 0, variance 1, nothing seen."""
    return Normalizer(
        mean=jnp.zeros((size,), jnp.float32), variance=jnp.ones((size,), jnp.float32), count=jnp.zeros((), jnp.float32)
    )


def normalize(normalizer: Normalizer, observation: Array) -> Array:
    """Observation [..., features] with mean 0 and variance 1, clipped to ±10."""
    scaled = (observation - normalizer.mean) * jax.lax.rsqrt(normalizer.variance + VARIANCE_FLOOR)
    return jnp.clip(scaled, -OBSERVATION_LIMIT, OBSERVATION_LIMIT)


def update_normalizer(normalizer: Normalizer, observation: Array, max_count: float = 1e8) -> Normalizer:
    """Merge a batch [..., features]. Past `max_count` the statistics forget slowly instead of freezing.

    A feature that never varied, such as the wrench of a training without one, starts anew when it first does.
    """
    flat = observation.reshape(-1, observation.shape[-1])
    count = jnp.float32(flat.shape[0])
    mean, variance = flat.mean(0), flat.var(0)
    before = jnp.where(normalizer.variance > 0.0, normalizer.count, 0.0)
    total = before + count
    shift = mean - normalizer.mean
    merged = normalizer.variance * before + variance * count + shift**2 * before * count / total
    return Normalizer(
        mean=normalizer.mean + shift * count / total,
        variance=merged / total,
        count=jnp.minimum(normalizer.count + count, max_count),
    )
