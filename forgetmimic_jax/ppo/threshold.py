"""What an unlearning run logs of its rewards, target and kept steps apart, and the threshold λ_crit."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.reward import total_tracking_weight


def threshold_metrics(
    config: Config, is_target: Array, steps: Array, tracking: Array, regularisation: Array, normalized: Array
) -> dict[str, Array]:
    """R̄_track, R̄_reg and λ_crit = W (1 + R̄_reg / R̄_track), apart for target and kept steps; with a penalty also R̄_anti.

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
            f"{group}/tracking_reward": (normalized * mask).sum() / count,
            f"{group}/lambda_crit": weight * (1.0 + mean_regularisation / jnp.maximum(mean_tracking, 1e-6)),
        }
        if penalty := config.unlearn.settings.get("penalty"):
            on_target = group == "target"
            metrics[f"{group}/R_anti"] = -penalty * metrics[f"{group}/tracking_reward"] * on_target
    return metrics
