"""Figures of evaluations, also of those while training, and of studies; matplotlib is loaded only to draw one.

`path` is where a figure goes: a PNG file, or a text buffer, which gets SVG.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import msgspec

from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.evaluation.document import Estimate, EvaluationDocument
from forgetmimic_jax.evaluation.tables import clip_order, policy_order

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

STATE_COLOURS = {"new": "0.93", "learning": "#fff3d6", "mastered": "#dcf2dc", "stuck": "#f9dcdc"}
GROUP_COLOURS = {"target": "tab:red", "kept": "tab:blue"}


def clip_bars(document: EvaluationDocument, path: Path | TextIO) -> None:
    """Bars of every policy clip by clip, with 95 % intervals, targets first and shaded."""
    policies, clips = policy_order(document), clip_order(document)
    targets = sum(document.policies[policies[0]].clips[clip].target for clip in clips)
    figure = new_figure(width=2.0 + 0.7 * len(clips), height=6.0)
    for row, metric in enumerate(("success_rate", "survival_weighted_tracking")):
        axes = figure.add_subplot(2, 1, row + 1)
        axes.axvspan(-0.5, targets - 0.5, color="0.92")
        of = {policy: document.policies[policy].clips for policy in policies}
        bars(axes, clips, {policy: [of[policy][clip].metric(metric) for clip in clips] for policy in policies})
        axes.set_ylabel(metric.replace("_", " "))
    figure.axes[0].legend(ncols=min(4, len(policies)), loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    save(figure, path)


def clips_over_time(evaluations_file: Path, path: Path) -> None:
    """One panel a clip of a run's evaluations.jsonl: success and tracking over environment steps; a PNG.

    Of pretraining also the clip's state, as the colour behind, and a specialist's evaluations as points of their own.
    """
    rows = read_rows(evaluations_file)
    clips = list(rows[0]["clips"])
    columns = min(4, len(clips))
    lines = -(-len(clips) // columns)
    figure = new_figure(width=3.0 * columns, height=2.0 * lines)
    for panel, clip in enumerate(clips):
        axes = figure.add_subplot(lines, columns, panel + 1)
        for metric, marker, colour in (("success_rate", "o", "C0"), ("survival_weighted_tracking", "s", "C1")):
            for line, own in (("-", False), ("", True)):
                shown = [row for row in rows if ("specialist" in row) == own and row.get("specialist", clip) == clip]
                points = [(row["environment_steps"] / 1e6, row["clips"][clip][metric]) for row in shown]
                axes.plot(
                    *zip(*points, strict=True) if points else ([], []),
                    linestyle=line,
                    marker=marker,
                    markersize=3,
                    color=colour,
                    markerfacecolor="white" if own else colour,
                    label=None if own else metric.replace("_", " "),
                )
        _shade_states(axes, rows, clip)
        axes.set_ylim(-0.03, 1.03)
        axes.set_title(" · ".join([clip, *_state(rows[-1], clip)]), fontsize="small")
    figure.axes[0].legend(fontsize="x-small")
    figure.supxlabel("environment steps (millions)", fontsize="small")
    save(figure, path)


def _state(row: Mapping[str, Any], clip: str) -> list[str]:
    """The state of a clip in a row of pretraining, as a list of one; none in other rows."""
    return [row["clips"][clip]["state"]] if "state" in row["clips"][clip] else []


def _shade_states(axes: Axes, rows: Sequence[Mapping[str, Any]], clip: str) -> None:
    """The state of a clip behind its curves, from each evaluation to the next."""
    ends = [row["environment_steps"] / 1e6 for row in rows]
    for begin, end, row in zip([0.0, *ends], ends, rows, strict=False):
        for state in _state(row, clip):
            axes.axvspan(begin, end, color=STATE_COLOURS[state], linewidth=0)


def unlearning_curves(rows: Sequence[Mapping[str, Any]], path: Path | TextIO, *, penalty: float | None) -> None:
    """Tracking on target and kept steps, λ_crit, and the share of the steps, over an unlearning run.

    Args:
        rows: of its metrics.jsonl.
        path: where it goes.
        penalty: λ, drawn beside λ_crit; None for a method without.
    """
    figure = new_figure(width=11.0, height=2.8)
    steps = [row["environment_steps"] / 1e6 for row in rows]
    panels = {"tracking_reward": "tracking reward while training", "lambda_crit": "λ_crit", "step_share": "step share"}
    for panel, (key, title) in enumerate(panels.items()):
        axes = figure.add_subplot(1, len(panels), panel + 1)
        for group in ("target", "kept"):
            axes.plot(steps, [row.get(f"{group}/{key}", nan) for row in rows], label=group, color=GROUP_COLOURS[group])
        if key == "lambda_crit" and penalty is not None:
            axes.axhline(penalty, color="0.4", linestyle="--", label="λ")
        axes.set_title(title, fontsize="medium")
        axes.set_xlabel("million environment steps", fontsize="small")
        axes.legend(fontsize="small", frameon=False)
    save(figure, path)


def sampling_shares(rows: Sequence[Mapping[str, Any]], path: Path | TextIO, *, targets: Sequence[str]) -> None:
    """Each clip's share of the starts and of the steps, means over the rows; targets first."""
    clips = sorted(rows[0]["clips"], key=lambda clip: (clip not in targets, clip))
    figure = new_figure(width=2.0 + 0.7 * len(clips), height=2.6)
    axes = figure.add_subplot()
    axes.axvspan(-0.5, sum(clip in targets for clip in clips) - 0.5, color="0.92")
    for offset, (key, label) in enumerate({"probability": "of the starts", "step_share": "of the steps"}.items()):
        shares = [100.0 * sum(row["clips"][clip][key] for row in rows) / len(rows) for clip in clips]
        axes.bar([clip + (offset - 0.5) * 0.4 for clip in range(len(clips))], shares, 0.4, label=label)
    axes.set_ylabel("%")
    axes.set_xlim(-0.5, len(clips) - 0.5)
    axes.set_xticks(range(len(clips)), clips, rotation=30, ha="right")
    axes.legend(ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    save(figure, path)


def bars(axes: Axes, places: Sequence[str], series: Mapping[str, Sequence[Any]]) -> None:
    """Groups of bars with their intervals, one group a place, one bar in it a series.

    Args:
        axes: to draw on.
        places: names of the groups.
        series: by name, an estimate for each place: an `Estimate`, the plain dict of one, or None.
    """
    width = 0.8 / len(series)
    for offset, (label, estimates) in enumerate(series.items()):
        positions = [place + (offset - 0.5 * (len(series) - 1)) * width for place in range(len(places))]
        means, reach = _means_and_reach(estimates)
        axes.bar(positions, means, width, yerr=reach, capsize=2, label=label.replace("_", " "))
    axes.set_xlim(-0.5, len(places) - 0.5)
    axes.set_xticks(range(len(places)), places, rotation=30, ha="right")


def curve(axes: Axes, x: Sequence[float], estimates: Sequence[Any], label: str) -> None:
    """Means over x with their intervals; estimates as for `bars`."""
    axes.errorbar(x, *_means_and_reach(estimates), capsize=3, marker=".", label=label)


def heat_map(axes: Axes, values: Any, rows: Sequence[str], columns: Sequence[str]) -> None:
    """Numbers [row, column] from 0 to 1 as colours."""
    image = axes.imshow(values, vmin=0.0, vmax=1.0, cmap="YlGn", aspect="auto")
    axes.figure.colorbar(image, ax=axes)
    axes.set_yticks(range(len(rows)), rows)
    axes.set_xticks(range(len(columns)), columns, rotation=60, ha="right", fontsize="small")


def _means_and_reach(estimates: Sequence[Any]) -> tuple[list[float], tuple[list[float], list[float]]]:
    """Means, and how far each interval goes below and above; rounding may put an end on the wrong side of its mean."""
    known = [msgspec.convert(estimate or {}, Estimate) for estimate in estimates]
    means = [estimate.mean or 0.0 for estimate in known]
    ends = [(mean, estimate.low, estimate.high) for mean, estimate in zip(means, known, strict=True)]
    below = [0.0 if low is None else max(0.0, mean - low) for mean, low, _ in ends]
    return means, (below, [0.0 if high is None else max(0.0, high - mean) for mean, _, high in ends])


def new_figure(*, width: float, height: float) -> Figure:
    """An empty figure of a size in inches."""
    from matplotlib.figure import Figure

    # A Figure without pyplot needs no display and leaves no global state; its canvas is Agg.
    return Figure(figsize=(width, height), layout="constrained")


def save(figure: Figure, path: Path | TextIO) -> None:
    """Write a figure as PNG to a path, or as SVG to a text buffer."""
    import matplotlib

    if isinstance(path, Path):
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)
        return
    # In a page: text stays text, in the page's own font.
    with matplotlib.rc_context({"svg.hashsalt": "page", "svg.fonttype": "none", "font.family": "sans-serif"}):
        figure.savefig(path, format="svg", metadata={"Date": None, "Creator": None})
