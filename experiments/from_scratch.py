"""Do the assistive wrench and adaptive RSI help a training from scratch? (paper, the tracker's two mechanisms)

A fresh policy is trained by plain PPO on all clips, with the base's own settings, and is evaluated on the way.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.evaluation.plots import curve, new_figure
from forgetmimic_jax.evaluation.repeats import over_repeats, rate_over_repeats
from forgetmimic_jax.evaluation.statistics import PlainEstimate
from forgetmimic_jax.evaluation.tables import markdown_table, number, percent
from forgetmimic_jax.studies.claim import Finding, finding
from forgetmimic_jax.studies.conduct import main
from forgetmimic_jax.studies.lab import Lab, watched_episodes
from forgetmimic_jax.studies.study import Document, Study
from forgetmimic_jax.studies.variants import TRACKING, within

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CHECKPOINTS = 8
SUCCESS = "success_rate"
ADAPTIVE, WITH_WRENCH, UNIFORM = "adaptive RSI", "adaptive RSI, wrench", "uniform RSI"
FRESH = {"method": "retrain", "clips": "all"}  # no clip is left out: a training as any other
VARIANTS: Mapping[str, Mapping[str, Any]] = {
    ADAPTIVE: {"sampler": "adaptive"},
    WITH_WRENCH: {"sampler": "adaptive", "wrench": True},
    UNIFORM: {"sampler": "uniform_clips"},  # all three draw the clips evenly at first
}
PAIRS = {"The wrench": (WITH_WRENCH, ADAPTIVE), "Adaptive RSI": (ADAPTIVE, UNIFORM)}


def measure(lab: Lab) -> dict[str, Any]:
    """Success and tracking over all clips, by variant, by repeat and by evaluation; a seed each, whatever the base."""
    runs = {
        (label, repeat): {**FRESH, **variant, "set": lab.watched(CHECKPOINTS)}
        for repeat in lab.repeats
        if repeat.base == 0
        for label, variant in VARIANTS.items()
    }
    found: dict[str, dict[str, Any]] = {}
    steps: list[int] = []
    clips = 0
    for (label, repeat), folder in lab.run(runs, "from scratch").items():
        rows = read_rows(folder / "evaluations.jsonl")
        steps = [row["environment_steps"] for row in rows]
        clips = len(rows[-1]["clips"])
        found.setdefault(label, {})[str(repeat)] = [over_clips(row["clips"]) for row in rows]
    episodes = clips * watched_episodes(lab.options.episodes)
    return {"environment_steps": steps, "episodes": episodes, "trainings": found}


def over_clips(clips: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Means over all clips."""
    return {metric: float(np.mean([of[metric] for of in clips.values()])) for metric in (SUCCESS, TRACKING)}


def over_seeds(document: Document, label: str, place: int, metric: str) -> PlainEstimate:
    """A metric of a variant at one evaluation, over its trainings."""
    values = {repeat: of[place][metric] for repeat, of in document["results"]["trainings"][label].items()}
    if metric == SUCCESS:
        return within(rate_over_repeats(values, dict.fromkeys(values, document["results"]["episodes"])), 0.0, 1.0)
    return within(over_repeats(values), 0.0, 1.0)


def gained(document: Document, one: str, other: str, metric: str) -> dict[str, float]:
    """By repeat: what one variant has more than another, in the mean over all evaluations."""
    variants = document["results"]["trainings"]
    if one not in variants or other not in variants:
        return {}
    both = {
        repeat: (rows, variants[other][repeat]) for repeat, rows in variants[one].items() if repeat in variants[other]
    }
    return {
        repeat: float(np.mean([a[metric] - b[metric] for a, b in zip(*pair, strict=True)]))
        for repeat, pair in both.items()
    }


def body(document: Document) -> str:
    """Success and tracking of every variant at each evaluation."""
    steps = document["results"]["environment_steps"]
    shown = sorted({len(steps) // 4 - 1, len(steps) // 2 - 1, len(steps) - 1} - {-1})
    rows = []
    for label, runs in document["results"]["trainings"].items():
        cells = [str(len(runs))]
        for place in shown:
            success, tracking = (over_seeds(document, label, place, metric) for metric in (SUCCESS, TRACKING))
            cells += [percent(success), number(tracking)]
        rows.append([label, *cells])
    header = ["", "n"]
    for place in shown:
        header += [f"success at {steps[place] / 1e6:.1f} M steps", "tracking"]
    note = (
        "Means over all clips of the evaluations during training, deterministic, without the wrench and without noise. "
        "tracking: mean tracking reward over the horizon, 0 after a fall. Uniform RSI draws every bin with "
        "equal chance; adaptive RSI prefers those that fail.\n"
    )
    return f"{markdown_table(header, rows)}\n{note}"


def findings(document: Document) -> Iterator[Finding]:
    """What each mechanism gains, in the mean over the evaluations."""
    for name, (one, other) in PAIRS.items():
        more = {metric: gained(document, one, other, metric) for metric in (TRACKING, SUCCESS)}
        if more[TRACKING]:
            tracking, success = over_repeats(more[TRACKING]), over_repeats(more[SUCCESS])
            evidence = f"tracking with it minus without {number(tracking)}, success {percent(success)}; bound 0"
            yield finding(f"{name} helps a training from scratch", tracking, 0.0, evidence, below=False, main=True)


def draw(document: Document) -> Figure:
    """Success and tracking over the steps."""
    steps = [step / 1e6 for step in document["results"]["environment_steps"]]
    figure = new_figure(width=10.0, height=4.0)
    for place, metric in enumerate((SUCCESS, TRACKING)):
        axes = figure.add_subplot(1, 2, place + 1)
        for label in document["results"]["trainings"]:
            curve(axes, steps, [over_seeds(document, label, i, metric) for i in range(len(steps))], label)
        axes.set_ylim(0.0, 1.0)
        axes.set_xlabel("million environment steps")
        axes.set_title(f"mean {metric.replace('_', ' ')}", fontsize="medium")
    figure.axes[0].legend(frameon=False, fontsize="small")
    return figure


STUDY = Study(
    name="from_scratch",
    title="Do the assistive wrench and adaptive RSI help a training from scratch?",
    claim="Adaptive RSI and the assistive wrench make a training from scratch faster.",
    ours=True,
    kind="fresh",
    iterations={"cpu": 800, "paper": 30_000},
    watches=True,
    measure=measure,
    body=body,
    draw=draw,
    findings=findings,
)

if __name__ == "__main__":
    main(STUDY)
