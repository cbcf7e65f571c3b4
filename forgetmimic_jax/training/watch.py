"""A short evaluation now and then during a long run: is it still getting better, clip by clip?"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from forgetmimic_jax.basics.files import drop_rows_after, read_rows
from forgetmimic_jax.evaluation.metrics import Rollout, episode_metrics
from forgetmimic_jax.evaluation.plots import clips_over_time
from forgetmimic_jax.evaluation.rollout import Evaluator
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.tracking.setup import Setup

FILE = "evaluations.jsonl"
SHOWN = ("success_rate", "survival_weighted_tracking", "tracking_reward", "episode_length")


def clip_means(rollout: Rollout, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """What a row says of every clip; `completed` is the success from the first frame."""
    metrics, from_the_first = episode_metrics(rollout), rollout.start_frame == 0

    def mean(name: str, episodes: np.ndarray) -> float:
        return round(float(metrics[name][episodes].mean()), 4)

    return {
        clip: {name: mean(name, rollout.clip == i) for name in SHOWN}
        | {"completed": mean("success_rate", (rollout.clip == i) & from_the_first)}
        for i, clip in enumerate(names)
    }


def seed_of_episodes(seed: int) -> int:
    """The seed of the episodes on which a run with `seed` is watched.

    The best of many policies is chosen by them and does better on them than on others, so `make evaluate` with the
    run's own seed has other episodes.
    """
    return seed + 1_000_000


class Watch:
    """Evaluates a run's policy on the same few episodes each time: a row of evaluations.jsonl, and its PNG."""

    def __init__(self, setup: Setup, directory: Path, iteration: int):
        config, self._names = setup.config, setup.library.names
        seed = seed_of_episodes(config.seed)
        self._evaluator = Evaluator(setup, episodes=config.evaluate_episodes, seed=seed)
        self._kept = np.isin(
            self._evaluator.clip, [self._names.index(clip) for clip in config.unlearn.targets], invert=True
        )
        self._path = directory / FILE
        rows = drop_rows_after(self._path, iteration)
        self._best = max((row["kept_tracking"] for row in rows), default=-1.0)

    def measure(self, policy: Policy, iteration: int, environment_steps: int) -> dict[str, Any]:
        """The row of a policy; its `kept_tracking` is the mean survival-weighted tracking of the clips to keep."""
        rollout = self._evaluator.rollout(policy)
        metrics = episode_metrics(rollout)
        row: dict[str, Any] = {"iteration": iteration, "environment_steps": environment_steps}
        row |= {name: float(metrics[name].mean()) for name in SHOWN}
        row["kept_tracking"] = float(metrics["survival_weighted_tracking"][self._kept].mean())
        return row | {"clips": clip_means(rollout, self._names)}

    def add(self, row: dict[str, Any]) -> bool:
        """Write a row and draw all of them again; whether its `kept_tracking` is the best so far."""
        with self._path.open("a") as file:
            file.write(json.dumps(row) + "\n")
        clips_over_time(self._path, self._path.with_suffix(".png"))
        better = row["kept_tracking"] > self._best
        self._best = max(self._best, row["kept_tracking"])
        return better

    def table(self) -> Any:
        """Success of every clip over the last evaluations, for the terminal."""
        from rich.table import Table

        rows = read_rows(self._path)[-6:]
        table = Table(
            title="success and survival-weighted tracking by environment steps", title_justify="left", box=None
        )
        for column in ("clip", "", *(f"{row['environment_steps'] / 1e6:.1f}M" for row in rows)):
            table.add_column(column, justify="right" if column.endswith("M") else "left", no_wrap=True)
        for clip in self._names:
            table.add_row(clip, rows[-1]["clips"][clip].get("state", ""), *(_cell(row, clip) for row in rows))
        return table


def _cell(row: dict[str, Any], clip: str) -> str:
    """Success and tracking of a clip; of a specialist's row, only those of its clip."""
    if row.get("specialist", clip) != clip:
        return ""
    values = row["clips"][clip]
    return f"{values['success_rate']:.0%} {values['survival_weighted_tracking']:.2f}"
