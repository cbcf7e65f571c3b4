"""What an unlearning run logs of its rewards, target and kept steps apart, and the threshold λ_crit."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.reward import total_tracking_weight

GROUPS = ("target", "kept")


def threshold_metrics(
    config: Config, is_target: Array, steps: Array, tracking: Array, regularisation: Array, normalized: Array
) -> dict[str, Array]:
    """R̄_track, R̄_reg and λ_crit = W (1 + R̄_reg / R̄_track), apart for target and kept steps; with a penalty also R̄_anti.

    λ_crit is where the mean reward of a target step changes its sign; W alone leaves R_reg out. Where no step of a
    group was simulated, its means and its λ_crit are NaN, and its row of the log leaves them out.

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
    for group, mask in zip(GROUPS, (is_target, ~is_target), strict=True):
        count = (steps * mask).sum()
        mean_tracking, mean_regularisation = _mean(tracking, mask, count), _mean(regularisation, mask, count)
        metrics |= {
            f"{group}/step_share": count / steps.sum(),
            f"{group}/R_track": mean_tracking,
            f"{group}/R_reg": mean_regularisation,
            f"{group}/tracking_reward": _mean(normalized, mask, count),
            f"{group}/lambda_crit": weight * (1.0 + mean_regularisation / jnp.maximum(mean_tracking, 1e-6)),
        }
        if penalty := config.unlearn.settings.get("penalty"):
            on_target = group == "target"
            metrics[f"{group}/R_anti"] = -penalty * metrics[f"{group}/tracking_reward"] * on_target
    return metrics


def _mean(sums: Array, mask: Array, count: Array) -> Array:
    """Sums [clip] of the clips in `mask` over `count` steps; NaN where there is no step."""
    return jnp.where(count > 0, (sums * mask).sum() / jnp.maximum(count, 1), jnp.nan)
