"""Policy editing without a simulator, after PERU ("Policy Editing for Reinforcement Unlearning", its continuous form).

KL(π ‖ a random target) on states to forget plus KL(π ‖ π_base) on states to keep; the critic is left alone. PERU has
stored states, a random action in [−1, 1] for each, and keeps σ. Here the states are frames of the reference clips with
reset noise, drawn anew each iteration, so the random action is one for each clip, and the target's σ is the base's.
States that only a moving robot reaches are not among them; the evaluation shows what the edit does there.
"""

from __future__ import annotations

import jax
from jax import Array

from forgetmimic_jax.policy.gaussian import entropy, kl_divergence
from forgetmimic_jax.ppo.loss import Batch, Prediction, mean
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.unlearning.method import Method


def edit(config: Config, batch: Batch, now: Prediction, iteration: Array) -> tuple[Array, dict[str, Array]]:
    """Towards a random action on target states, towards the base on kept ones."""
    base = batch.base
    assert base is not None
    key = jax.random.PRNGKey(config.seed)
    action = jax.vmap(lambda clip: jax.random.uniform(jax.random.fold_in(key, clip), now.mean.shape[-1:], minval=-1.0))
    forget = kl_divergence(now.mean, now.log_std, action(batch.transition.clip), base.log_std)
    keep = kl_divergence(now.mean, now.log_std, base.mean, base.log_std)
    loss = mean(forget, batch.is_target) + mean(keep, ~batch.is_target)
    return loss, {"policy_loss": loss, "entropy": entropy(now.log_std)}


METHOD = Method(loss=edit, simulate=False)
