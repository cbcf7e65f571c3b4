"""Anti-reward fine-tuning (paper, equation of R_anti): unlearning is training with one more reward term."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jax import Array

from forgetmimic_jax.config import Config, UnlearnConfig
from forgetmimic_jax.tracking.reward import Reward, total_tracking_weight


def unlearning_config(base: Config, unlearn: UnlearnConfig) -> Config:
    """The base's run as an unlearning run: the anti-reward on, the sampler uniform, the wrench off. Nothing else."""
    return dataclasses.replace(
        base,
        unlearn=unlearn,
        sampling=dataclasses.replace(base.sampling, rule="uniform_clips"),
        wrench=dataclasses.replace(base.wrench, max_gain=0.0),
    )


def training_reward(config: Config, reward: Reward, is_target: Array) -> Array:
    """R' [env] = R_track + R_reg − λ r̄ on steps whose clip is a target; R_track + R_reg elsewhere.

    Args:
        config: λ, and whether there are targets at all.
        reward: the step's parts [env].
        is_target: bool[env] the step's clip is to be forgotten.
    """
    total = reward.tracking + reward.regularisation
    if config.unlearn.targets:
        total -= config.unlearn.penalty * reward.normalized_tracking * is_target
    return total


def threshold_metrics(
    config: Config, is_target: Array, steps: Array, tracking: Array, regularisation: Array, normalized: Array
) -> dict[str, Array]:
    """R̄_track, R̄_reg and λ_crit = W (1 + R̄_reg / R̄_track), apart for target and kept steps.

    λ_crit is where the mean reward of a target step changes its sign; W alone leaves R_reg out.

    Args:
        config: weights, λ.
        is_target: bool[clip].
        steps: [clip] steps seen.
        tracking: [clip] Σ R_track over them.
        regularisation: [clip] Σ R_reg.
        normalized: [clip] Σ r̄.
    """
    if not config.unlearn.targets:
        return {}
    weight = total_tracking_weight(config.reward)
    metrics: dict[str, Array] = {}
    for group, mask in (("target", is_target), ("kept", ~is_target)):
        count = jnp.maximum((steps * mask).sum(), 1)
        mean_tracking, mean_regularisation = (tracking * mask).sum() / count, (regularisation * mask).sum() / count
        metrics |= {
            f"{group}/step_share": (steps * mask).sum() / steps.sum(),
            f"{group}/R_track": mean_tracking,
            f"{group}/R_reg": mean_regularisation,
            f"{group}/R_anti": -config.unlearn.penalty * (normalized * mask).sum() / count * (group == "target"),
            f"{group}/tracking_reward": (normalized * mask).sum() / count,
            f"{group}/lambda_crit": weight * (1.0 + mean_regularisation / jnp.maximum(mean_tracking, 1e-6)),
        }
    return metrics
