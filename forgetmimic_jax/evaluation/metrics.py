"""From the record of a rollout to one number per episode, and the ratios the method is judged by.

Everything is numpy and works after the fact: E episodes, T steps. Nothing at or past an episode's termination counts.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

BASE, UNLEARNED, FINE_TUNED, ZERO_ACTION = "base", "unlearned", "fine_tuned", "zero_action"
MINIMUM_SKILL_RANGE = 0.05  # skill is undefined where the base is less than this above the zero-action baseline
HOLD_SECONDS = 3.0  # s that an episode without terminations lasts after its horizon; a clip's last frame is held
LOWEST_CONTENT = -1.0  # motion content is not less
COMMON = "_common"  # suffix of an error averaged over the steps that every compared policy survives


@dataclass(frozen=True)
class Rollout:
    """E episodes of one policy, each pinned to one clip; T is the longest horizon (at most 500 control steps)."""

    clip: np.ndarray  # i[E] index into the library's names
    start_frame: np.ndarray  # i[E]
    horizon: np.ndarray  # i[E] H = min(500, frames left)
    length: np.ndarray  # i[E] steps until the first termination, 1 <= length <= H; H itself means success
    tracking_reward: np.ndarray  # f[E, T] in [0, 1]; anything at or past `length`
    errors: dict[str, np.ndarray] = field(default_factory=dict)  # per step [E, T], each in its own unit
    ended_by: dict[str, np.ndarray] = field(
        default_factory=dict
    )  # bool[E] by bound: it was broken as the episode ended
    nan_resets: int = 0  # how many episodes met a NaN or Inf and were ended for it

    def __post_init__(self) -> None:
        episodes, steps = self.tracking_reward.shape
        for name in ("clip", "start_frame", "horizon", "length"):
            if getattr(self, name).shape != (episodes,):
                raise ValueError(f"rollout: {name} has shape {getattr(self, name).shape}, expected ({episodes},)")
        if np.any(self.length < 1) or np.any(self.length > self.horizon) or np.any(self.horizon > steps):
            raise ValueError(f"rollout: every episode needs 1 <= length <= horizon <= {steps}")
        alive = steps_before(self.length, steps)
        for name, values in {"tracking_reward": self.tracking_reward, **self.errors}.items():
            if values.shape != (episodes, steps):
                raise ValueError(f"rollout: {name} has shape {values.shape}, expected ({episodes}, {steps})")
            if not np.all(np.isfinite(values[alive])):
                raise ValueError(f"rollout: {name} is not finite before an episode's end")


def steps_before(length: np.ndarray, steps: int) -> np.ndarray:
    """Mask bool[E, T] of the steps before `length` i[E]."""
    return np.arange(steps) < length[:, None]


def sum_before(values: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Sum f[E] of `values` f[E, T] over the steps before `length` i[E]; what stands later may be NaN."""
    return np.where(steps_before(length, values.shape[1]), values, 0.0).sum(axis=1, dtype=np.float64)


def common_length(rollouts: Iterable[Rollout]) -> np.ndarray:
    """Steps i[E] that every policy survives in the same episode.

    Raises:
        ValueError: the rollouts differ in clips, start frames or horizons, so that episodes cannot be compared.
    """
    first, *others = rollouts
    for other in others:
        for name in ("clip", "start_frame", "horizon"):
            if not np.array_equal(getattr(first, name), getattr(other, name)):
                raise ValueError(f"rollouts to compare must share their episodes; {name} differs")
    return np.min([rollout.length for rollout in (first, *others)], axis=0)


def episode_metrics(rollout: Rollout, common: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Metrics of each episode, f[E] each.

    `tracking_reward` is the mean over the steps alive (the paper's; biased by survival: the easy first steps weigh
    most when a policy falls early). `survival_weighted_tracking` is (1/H) sum over t < length, zero after termination.
    Errors are means over the steps alive and, with `common` i[E], over the steps before it as `NAME_common`.
    """
    tracked = sum_before(rollout.tracking_reward, rollout.length)
    metrics = {
        "tracking_reward": tracked / rollout.length,
        "survival_weighted_tracking": tracked / rollout.horizon,
        "success_rate": (rollout.length == rollout.horizon).astype(np.float64),
        "episode_length": rollout.length.astype(np.float64),
    }
    for name, error in rollout.errors.items():
        metrics[name] = sum_before(error, rollout.length) / rollout.length
        if common is not None:
            metrics[name + COMMON] = sum_before(error, common) / common
    return metrics


def skill(policy: np.ndarray, base: np.ndarray, zero_action: np.ndarray) -> np.ndarray:
    """Share of the base's tracking above the zero-action baseline that is retained: (SWT - SWT_0) / (SWT_b - SWT_0).

    1 is the base, 0 is replaying the clip through the PD loop without a policy. NaN where there is nothing to divide.
    """
    return ratio(np.asarray(policy) - zero_action, np.asarray(base) - zero_action)


def ratio(numerator: np.ndarray, denominator: np.ndarray) -> np.ndarray:
    """Quotient that is NaN where the denominator is 0."""
    denominator = np.asarray(denominator, dtype=np.float64)
    return np.asarray(numerator) / np.where(denominator == 0.0, np.nan, denominator)
