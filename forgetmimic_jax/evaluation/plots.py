"""Figures of evaluation.json, metrics.jsonl and studies. matplotlib is loaded only when a figure is drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from forgetmimic_jax.errors import InputError
from forgetmimic_jax.evaluation.statistics import Estimate
from forgetmimic_jax.evaluation.tables import clip_order, policy_order
from forgetmimic_jax.rows import read_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STEPS = ("iteration", "environment_steps")


def clip_bars(
    document: Mapping[str, Any], path: Path, *, metrics: Sequence[str] = ("success_rate", "survival_weighted_tracking")
) -> None:
    """Bars of every policy clip by clip, with 95 % intervals, targets first and shaded; a PNG."""
    policies, clips = policy_order(document), clip_order(document)
    targets = sum(document["policies"][policies[0]]["clips"][clip]["target"] for clip in clips)
    figure = new_figure(width=2.0 + 0.7 * len(clips), height=3.0 * len(metrics))
    for row, metric in enumerate(metrics):
        axes = figure.add_subplot(len(metrics), 1, row + 1)
        axes.axvspan(-0.5, targets - 0.5, color="0.92")
        of = {policy: document["policies"][policy]["clips"] for policy in policies}
        bars(axes, clips, {policy: [of[policy][clip].get(metric, {}) for clip in clips] for policy in policies})
        axes.set_ylabel(metric.replace("_", " "))
    figure.axes[0].legend(ncols=min(4, len(policies)), loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    save(figure, path)


def training_curves(metrics_file: Path, path: Path, *, keys: Sequence[str] | None = None) -> None:
    """One panel a key of a metrics.jsonl over environment steps; a PNG.

    Args:
        metrics_file: one JSON object a line with iteration, environment_steps and numbers.
        path: PNG to write.
        keys: which numbers to draw; all that are there by default.

    Raises:
        InputError: no line to draw, or a key that no line has.
    """
    lines = read_rows(metrics_file)
    present = sorted({key for line in lines for key, value in line.items() if isinstance(value, int | float)})
    keys = [key for key in present if key not in STEPS] if keys is None else keys
    missing = [key for key in keys if key not in present]
    if not keys or missing:
        raise InputError(f"{metrics_file}: nothing to draw: no {', '.join(missing) or 'numbers'} in its lines")
    columns = min(4, len(keys))
    rows = -(-len(keys) // columns)
    figure = new_figure(width=3.5 * columns, height=2.3 * rows)
    for panel, key in enumerate(keys):
        axes = figure.add_subplot(rows, columns, panel + 1)
        points = [(line["environment_steps"], line[key]) for line in lines if key in line]
        axes.plot(*zip(*points, strict=True))
        axes.set_title(key.replace("_", " "), fontsize="small")
        axes.set_xlabel("environment steps", fontsize="small")
    save(figure, path)


def clips_over_time(evaluations_file: Path, path: Path) -> None:
    """One panel a clip of a run's evaluations.jsonl: success and tracking over environment steps; a PNG."""
    rows = read_rows(evaluations_file)
    steps = [row["environment_steps"] / 1e6 for row in rows]
    clips = list(rows[0]["clips"])
    columns = min(4, len(clips))
    lines = -(-len(clips) // columns)
    figure = new_figure(width=3.0 * columns, height=2.0 * lines)
    for panel, clip in enumerate(clips):
        axes = figure.add_subplot(lines, columns, panel + 1)
        for metric, marker in (("success_rate", "o"), ("survival_weighted_tracking", "s")):
            values = [row["clips"][clip][metric] for row in rows]
            axes.plot(steps, values, marker=marker, markersize=3, label=metric.replace("_", " "))
        axes.set_ylim(-0.03, 1.03)
        axes.set_title(clip, fontsize="small")
    figure.axes[0].legend(fontsize="x-small")
    figure.supxlabel("environment steps (millions)", fontsize="small")
    save(figure, path)


def bars(axes: Axes, places: Sequence[str], series: Mapping[str, Sequence[Estimate]]) -> None:
    """Groups of bars with their intervals, one group a place, one bar in it a series."""
    width = 0.8 / len(series)
    for offset, (label, estimates) in enumerate(series.items()):
        positions = [place + (offset - 0.5 * (len(series) - 1)) * width for place in range(len(places))]
        means = [estimate.get("mean", 0.0) for estimate in estimates]
        axes.bar(positions, means, width, yerr=_reach(estimates), capsize=2, label=label.replace("_", " "))
    axes.set_xlim(-0.5, len(places) - 0.5)
    axes.set_xticks(range(len(places)), places, rotation=30, ha="right")


def curve(axes: Axes, x: Sequence[float], estimates: Sequence[Estimate], label: str) -> None:
    """Means over x with their intervals."""
    means = [estimate["mean"] for estimate in estimates]
    axes.errorbar(x, means, _reach(estimates), capsize=3, marker=".", label=label)


def heat_map(axes: Axes, values: Any, rows: Sequence[str], columns: Sequence[str]) -> None:
    """Numbers [row, column] from 0 to 1 as colours."""
    image = axes.imshow(values, vmin=0.0, vmax=1.0, cmap="YlGn", aspect="auto")
    axes.figure.colorbar(image, ax=axes)
    axes.set_yticks(range(len(rows)), rows)
    axes.set_xticks(range(len(columns)), columns, rotation=60, ha="right", fontsize="small")


def _reach(estimates: Sequence[Estimate]) -> list[list[float]]:
    """How far each interval goes below and above its mean; rounding may put an end on the wrong side of it."""
    pairs = [(estimate.get("mean", 0.0), estimate) for estimate in estimates]
    below = [max(0.0, mean - estimate.get("low", mean)) for mean, estimate in pairs]
    return [below, [max(0.0, estimate.get("high", mean) - mean) for mean, estimate in pairs]]


def new_figure(*, width: float, height: float) -> Figure:
    """An empty figure of a size in inches."""
    from matplotlib.figure import Figure

    # A Figure without pyplot needs no display and leaves no global state; its canvas is Agg.
    return Figure(figsize=(width, height), layout="constrained")


def save(figure: Figure, path: Path) -> None:
    """Write a figure as its path's ending says; an SVG of the same figure is the same file."""
    import matplotlib

    path.parent.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context({"svg.hashsalt": path.stem}):
        figure.savefig(path, dpi=150, metadata={"Date": None} if path.suffix == ".svg" else None)
