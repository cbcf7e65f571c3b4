"""Generalised advantage estimation with truncation."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array


def generalized_advantages(
    reward: Array,
    value: Array,
    next_value: Array,
    terminated: Array,
    truncated: Array,
    discount: float,
    gae_lambda: Array | float,
) -> tuple[Array, Array]:
    """Advantages and value targets, each [time, env] (Schulman et al. 2016, equation 16).

    Args:
        reward: [time, env].
        value: [time, env] V(s_t).
        next_value: [time, env] V of the state that followed s_t before any reset.
        terminated: bool[time, env] no value follows.
        truncated: bool[time, env] the episode ends here but the value of its last state follows.
        discount: γ.
        gae_lambda: λ.
    """
    delta = reward + discount * jnp.where(terminated, 0.0, next_value) - value
    carry_on = 1.0 - (terminated | truncated).astype(reward.dtype)

    def backward(advantage: Array, inputs: tuple[Array, Array]) -> tuple[Array, Array]:
        delta, carry_on = inputs
        advantage = delta + discount * gae_lambda * carry_on * advantage
        return advantage, advantage

    _, advantage = jax.lax.scan(backward, jnp.zeros_like(delta[0]), (delta, carry_on), reverse=True)
    return advantage, advantage + value


def centre_branches(advantage: Array, done: Array, branches: int) -> Array:
    """Advantages [time, env] less the mean of the other branches' at the same time: the critic's common error cancels.

    Branches are consecutive environments that were in the same state at time 0, as in the vine of TRPO (Schulman et al.
    2015). A branch whose episode has ended has left the others, and is neither compared nor a baseline any more. The
    baseline depends on no action of its own branch, which leaves the policy gradient unbiased.

    Args:
        advantage: [time, env].
        done: bool[time, env] the episode ends here.
        branches: how many share a state; divides the number of environments.
    """
    together = ((jnp.cumsum(done, axis=0) - done) == 0).reshape(len(done), -1, branches)
    grouped = advantage.reshape(together.shape)
    others = together.sum(-1, keepdims=True) - 1
    mean = (jnp.where(together, grouped, 0.0).sum(-1, keepdims=True) - grouped) / jnp.maximum(others, 1)
    return jnp.where(together & (others > 0), grouped - mean, grouped).reshape(advantage.shape)
