"""Decremental reinforcement learning (Ye et al. 2023, "Reinforcement Unlearning", the first of their two methods).

On states of the environment to forget the agent's values go to 0. On all other states they stay the same. No
reward is used. Theirs is a Q-network on grid worlds: max_a |Q'(s)| there, max_a |Q'(s) − Q(s)| elsewhere, on states
that a random policy visits. Here, for actor and critic with Gaussian actions: on target states KL(π ‖ N(0, σ0² I)) and
V²; on kept states KL(π ‖ π_base) and (V − V_base)². The states are those that the policy visits. All states share one
σ, so the loss on target states changes it for kept states too.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from forgetmimic_jax.policy.gaussian import entropy, kl_divergence
from forgetmimic_jax.ppo.loss import Batch, Prediction, mean
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.unlearning.method import Method


def decrement(config: Config, batch: Batch, now: Prediction, iteration: Array) -> tuple[Array, dict[str, Array]]:
    """Towards N(0, σ0² I) and value 0 on target states, towards the base on kept ones."""
    base, log_std0 = batch.base, jnp.full_like(batch.transition.mean, jnp.log(config.ppo.initial_std))
    assert base is not None
    forget = kl_divergence(now.mean, now.log_std, jnp.zeros_like(batch.transition.mean), log_std0)
    keep = kl_divergence(now.mean, now.log_std, base.mean, base.log_std)
    policy_term = mean(forget, batch.is_target) + mean(keep, ~batch.is_target)
    value_term = mean(now.value**2, batch.is_target) + mean((now.value - base.value) ** 2, ~batch.is_target)
    loss = policy_term + config.ppo.value_cost * value_term
    return loss, {"policy_loss": policy_term, "value_loss": value_term, "entropy": entropy(now.log_std)}


METHOD = Method(loss=decrement)
