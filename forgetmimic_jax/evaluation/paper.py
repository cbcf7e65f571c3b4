"""The paper's own numbers, beside which tables put ours: another library of clips, another base, another budget.

`tracking_reward` is its mean over the steps alive; it has no survival-weighted one. Source: the tables named.
"""

from __future__ import annotations

from typing import Any


def _row(target: tuple[float, float, float], kept: tuple[float, float, float]) -> dict[str, dict[str, float]]:
    """Tracking reward, success rate and episode length of targets and of kept clips."""
    names = ("tracking_reward", "success_rate", "episode_length")
    return {group: dict(zip(names, row, strict=True)) for group, row in (("target", target), ("kept", kept))}


# Table 'Comparison between our method, ablation study of RSI and AW, and four baselines'.
COMPARISON = {
    "base": _row((0.8716, 0.95, 475.9), (0.8435, 0.74, 400.6)),
    "retraining": _row((0.6086, 0.0, 4.9), (0.8812, 0.76, 450.1)),
    "random reward": _row((0.6754, 0.0, 168.3), (0.6773, 0.12, 128.4)),
    "Ye et al. 2023": _row((0.5027, 0.0, 3.0), (0.6906, 0.06, 48.2)),
    "Gong et al. 2024": _row((0.7268, 0.0, 138.8), (0.7093, 0.23, 164.8)),
    "ARFT with RSI": _row((0.7330, 0.0, 6.5), (0.8484, 0.73, 413.8)),
    "ARFT with AW": _row((0.7054, 0.0, 5.3), (0.7926, 0.43, 249.8)),
    "λ = 8": _row((0.6653, 0.0, 6.1), (0.8469, 0.72, 413.6)),
    "λ = 16": _row((0.5972, 0.0, 4.4), (0.8305, 0.68, 391.1)),
}
VALIDITY = {name: COMPARISON[name] for name in ("base", "λ = 8", "λ = 16")}
ABLATION = {name: COMPARISON[name] for name in ("base", "ARFT with RSI", "ARFT with AW", "λ = 16")}

# Table 'Sensitivity analysis of the penalty weight λ'. It prints "1 %" where its text says that the targets succeed.
LAMBDA: dict[str, dict[str, Any]] = {
    f"λ = {penalty}": {
        "target": {"tracking_reward": target, "success_rate": success},
        "kept": {"tracking_reward": kept},
        "degradation_ratio": ratio,
    }
    for penalty, target, kept, ratio, success in (
        (0.5, 0.884, 0.890, 0.994, 1.0),
        (1, 0.872, 0.884, 0.987, 1.0),
        (4, 0.865, 0.889, 0.972, 1.0),
        (8, 0.652, 0.862, 0.756, 0.0),
        (16, 0.538, 0.856, 0.628, 0.0),
    )
}

# 'Relearning-based Forgetting Evaluation': iterations until 95 % of the base's tracking reward.
RELEARNING = {"fight": 4250, "fightAndSports1": 5500, "both": 7500}

# 'Membership Inference Analysis': accuracy of the attack.
MEMBERSHIP = {"base": 0.60, "retrained": 0.54, "λ = 16": 0.53}
