"""What a run writes while it trains: metrics.jsonl and TensorBoard events."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.proto.summary_pb2 import Summary

from forgetmimic_jax.basics.files import drop_rows_after
from forgetmimic_jax.ppo.threshold import GROUPS

Metrics = Mapping[str, np.ndarray]


class Log:
    """Rows of means over the iterations since the last row, with the seconds that they took."""

    def __init__(self, directory: Path, iteration: int, environment_steps: int):
        # TensorboardX's SummaryWriter writes from a thread, for which a run would wait forever when the disk is full.
        path = directory / "metrics.jsonl"
        drop_rows_after(path, iteration)
        self._file = path.open("a")
        (directory / "events").mkdir(exist_ok=True)
        self._events = EventsWriter(str(directory / "events" / "events"))
        # TensorBoard hides the rows after this one that an earlier, killed process may have written.
        self._write_event(environment_steps + 1, session_log=SessionLog(status=SessionLog.START))
        self._rows: list[Metrics] = []
        self._last_row = time.monotonic()

    def __enter__(self) -> Log:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._events.close()

    def add(self, metrics: Metrics) -> None:
        """Count an iteration's metrics into the next row."""
        self._rows.append(metrics)

    def write(
        self, iteration: int, environment_steps: int, clips: tuple[str, ...], note: Mapping[str, Any] | None = None
    ) -> None:
        """Write the row of the iterations since the last one, if there are any.

        Args:
            iteration: of the run.
            environment_steps: of the run.
            clips: names.
            note: more of the row's fields; what stands under `clips` joins the clips' parts.
        """
        note = dict(note or {})
        rows, self._rows = self._rows, []
        if not rows:
            return
        mean = {name: _mean(name, [row[name] for row in rows]) for name in rows[0]}
        out: dict[str, Any] = {"iteration": iteration, "environment_steps": environment_steps}
        absent = {name for name, value in mean.items() if _of_group(name) and np.isnan(value)}
        out |= {name: float(value) for name, value in mean.items() if np.ndim(value) == 0 and name not in absent}
        now = time.monotonic()
        out["seconds"], self._last_row = round(now - self._last_row, 2), now
        of_clips = note.pop("clips", {})
        out |= note
        out["clips"] = {clip: of_clips.get(clip, {}) | row for clip, row in clip_rows(mean, clips).items()}
        self._file.write(json.dumps(out) + "\n")
        self._file.flush()
        scalars = {name: value for name, value in out.items() if isinstance(value, float)}
        for clip, values in out["clips"].items():
            scalars |= {f"{clip}/{name}": value for name, value in values.items() if isinstance(value, float)}
        summary = Summary(value=[Summary.Value(tag=name, simple_value=value) for name, value in scalars.items()])
        self._write_event(environment_steps, summary=summary)

    def _write_event(self, step: int, **content: Any) -> None:
        self._events.write_event(Event(wall_time=time.time(), step=step, **content))
        self._events.flush()


def _of_group(name: str) -> bool:
    """Whether a metric is of the target or of the kept steps, and so NaN in an iteration without such a step."""
    return name.partition("/")[0] in GROUPS


def _mean(name: str, values: Sequence[np.ndarray]) -> np.ndarray:
    """Mean over iterations; of a group's metric over those that have it, NaN where none has."""
    measured = [value for value in values if not np.isnan(value)] if _of_group(name) else values
    return np.mean(measured, axis=0) if measured else np.array(np.nan)


def clip_rows(mean: Mapping[str, Any], clips: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Each clip's part of a row, from the iterations' mean `clip/...` metrics [clip]."""
    steps = np.maximum(mean["clip/steps"], 1e-9)
    per_clip = {"probability": mean["clip/probability"], "step_share": steps / steps.sum()}
    if "clip/episodes" in mean:  # episodes were simulated
        episodes = np.maximum(mean["clip/episodes"], 1e-9)
        per_clip |= {
            "success": mean["clip/completed"] / episodes,
            "survival_weighted_tracking": mean["clip/survival_weighted_sum"] / episodes,
            "episode_length": mean["clip/episode_length_sum"] / episodes,
            "tracking_reward": mean["clip/tracking_sum"] / steps,
        }
    return {
        clip: {name: round(float(values[i]), 5) for name, values in per_clip.items()} for i, clip in enumerate(clips)
    }
