"""What does a base know beyond its clips? With noise, and on clips that it never trained on (ours)

Bases alone are rolled out, and nothing is trained: on their clips, on their clips with the noise of training, on mirror
images, at other speeds, and on the clips of other libraries that are named.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from forgetmimic_jax.evaluation.metrics import ZERO_ACTION
from forgetmimic_jax.evaluation.plots import bars, new_figure
from forgetmimic_jax.evaluation.repeats import Repeat, over_repeats, rate_over_repeats
from forgetmimic_jax.evaluation.statistics import PlainEstimate
from forgetmimic_jax.evaluation.tables import markdown_table, number, percent
from forgetmimic_jax.settings.options import comma_separated
from forgetmimic_jax.studies.claim import Finding, finding
from forgetmimic_jax.studies.conduct import main
from forgetmimic_jax.studies.lab import Key, Lab
from forgetmimic_jax.studies.options import Options
from forgetmimic_jax.studies.study import Document, Study
from forgetmimic_jax.studies.variants import TRACKING, within

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from forgetmimic_jax.motion.clip import Clip

SUCCESS = "success_rate"
BASE = "base"
OWN, NOISE, MIRRORED = "its clips", "its clips, with noise", "mirror images"
SPEEDS = {"slower: 0.75 of the speed": 0.75, "faster: 1.25 of the speed": 1.25}
ENOUGH = 0.5  # success: most episodes


@dataclass(kw_only=True)
class HeldOutOptions(Options):
    """Roll the bases out, then write the study's JSON, its page and its figure."""

    held_out: str | None = None
    """Libraries of clips that no base trained on, comma-separated folders."""


def libraries(lab: Lab) -> dict[str, Path]:
    """The libraries that were named, by the name of their folder."""
    assert isinstance(lab.options, HeldOutOptions)
    return {Path(folder).name: Path(folder) for folder in comma_separated(lab.options.held_out or "")}


def conditions(lab: Lab) -> dict[str, Any]:
    """The libraries' contents."""
    from forgetmimic_jax.motion.library import library_hash

    return {"held_out": {name: library_hash(folder) for name, folder in libraries(lab).items()}}


def measure(lab: Lab) -> dict[str, Any]:
    """By kind of clip, by policy and by base: success and tracking of every clip."""
    from forgetmimic_jax.training.watch import clip_means

    policies: dict[Key, Path | None] = {(BASE, Repeat(place, 0)): base.path for place, base in enumerate(lab.bases)}
    policies[ZERO_ACTION, Repeat(0, 0)] = None
    found: dict[str, Any] = {}
    for kind, clips in kinds(lab).items():
        rollouts, names = lab.rollouts(policies, clips, noise=kind == NOISE)
        for (label, repeat), rollout in rollouts.items():
            found.setdefault(kind, {}).setdefault(label, {})[str(repeat)] = clip_means(rollout, names)
    return {"kinds": found}


def kinds(lab: Lab) -> dict[str, list[Clip]]:
    """The clips of every kind."""
    from forgetmimic_jax.attacks.near_duplicates import at_speed
    from forgetmimic_jax.motion.library import read_library
    from forgetmimic_jax.motion.mirror import mirrored
    from forgetmimic_jax.robot.model import load_robot
    from forgetmimic_jax.tracking.setup import library_folder

    robot = load_robot(lab.config.robot)
    clips = read_library(robot, library_folder(lab.config))
    result = {OWN: clips, NOISE: clips, MIRRORED: [mirrored(robot, clip) for clip in clips]}
    result |= {label: [at_speed(clip, factor) for clip in clips] for label, factor in SPEEDS.items()}
    return result | {f"library {name}": read_library(robot, folder) for name, folder in libraries(lab).items()}


def over_bases(of: Document, metric: str, episodes: int, clip: str | None = None) -> PlainEstimate:
    """A metric of one kind and policy over the bases: of a clip, or the mean over the clips.

    Args:
        of: clips by repeat, each with its numbers.
        metric: of a clip.
        episodes: a clip.
        clip: None is all.
    """
    chosen = {repeat: [of for name, of in clips.items() if clip in (None, name)] for repeat, clips in of.items()}
    means = {repeat: float(np.mean([numbers[metric] for numbers in every])) for repeat, every in chosen.items()}
    if metric == SUCCESS:
        counts = {repeat: episodes * len(every) for repeat, every in chosen.items()}
        return within(rate_over_repeats(means, counts), 0.0, 1.0)
    return within(over_repeats(means), 0.0, 1.0)


def body(document: Document) -> str:
    """A row a kind, then every clip of the kinds that no base trained on."""
    found, episodes = document["results"]["kinds"], document["conditions"]["episodes"]
    rows = []
    for kind, of in found.items():
        cells = [percent(over_bases(of[BASE], SUCCESS, episodes)), number(over_bases(of[BASE], TRACKING, episodes))]
        rows.append([kind, str(len(_clips(of))), *cells, number(over_bases(of[ZERO_ACTION], TRACKING, episodes))])
    table = markdown_table(["", "clips", "success", "tracking", "tracking, zero action"], rows)
    note = (
        "Each base on each kind of clip, deterministic and without the wrench. With noise: randomisation, pushes and "
        "sensor noise as in training (`make evaluate NOISE=1`). Every other row is without noise. tracking: mean "
        "tracking reward over the horizon, 0 after a fall.\n"
    )
    return "\n".join([table, note, *(_clip_table(kind, of, episodes) for kind, of in found.items() if kind != OWN)])


def _clips(of: Document) -> list[str]:
    return list(next(iter(of[BASE].values())))


def _clip_table(kind: str, of: Document, episodes: int) -> str:
    rows = [
        [
            clip,
            percent(over_bases(of[BASE], SUCCESS, episodes, clip)),
            number(over_bases(of[BASE], TRACKING, episodes, clip)),
        ]
        for clip in _clips(of)
    ]
    return f"**{kind[0].upper()}{kind[1:]}**\n\n{markdown_table(['clip', 'success', 'tracking'], rows)}"


def findings(document: Document) -> Iterator[Finding]:
    """Whether the bases complete most episodes of each kind."""
    episodes = document["conditions"]["episodes"]
    for kind, of in document["results"]["kinds"].items():
        success = over_bases(of[BASE], SUCCESS, episodes)
        evidence = f"success {percent(success)}; bound {percent({'mean': ENOUGH, 'n': 1})}"
        claim = f"A base completes most episodes of: {kind}"
        yield finding(claim, success, ENOUGH, evidence, below=False, main=kind == MIRRORED)


def answer(document: Document) -> str:
    """Success on mirror images beside that on the clips, in one sentence."""
    found, episodes = document["results"]["kinds"], document["conditions"]["episodes"]
    own, noise, other = (percent(over_bases(found[kind][BASE], SUCCESS, episodes)) for kind in (OWN, NOISE, MIRRORED))
    return f"A base completes {own} of its clips' episodes, {noise} with noise, and {other} of the mirror images'."


def draw(document: Document) -> Figure:
    """Success and tracking of every kind."""
    found: Mapping[str, Any] = document["results"]["kinds"]
    episodes = document["conditions"]["episodes"]
    figure = new_figure(width=2.5 + 1.4 * len(found), height=6.0)
    for row, metric in enumerate((SUCCESS, TRACKING)):
        axes = figure.add_subplot(2, 1, row + 1)
        series = {
            label.replace("_", " "): [over_bases(of[label], metric, episodes) for of in found.values()]
            for label in (BASE, ZERO_ACTION)
        }
        bars(axes, [kind.replace(": ", ":\n").replace(", ", ",\n") for kind in found], series)
        axes.set_ylabel(metric.replace("_", " "))
    figure.axes[0].legend(fontsize="small", frameon=False)
    return figure


STUDY = Study(
    name="generality",
    title="What does a base know beyond its clips?",
    claim="A base completes most episodes of the mirror images of its clips, on which it never trained.",
    ours=True,
    kind="rollout",
    measure=measure,
    body=body,
    draw=draw,
    findings=findings,
    answer=answer,
    conditions=conditions,
)

if __name__ == "__main__":
    main(STUDY, HeldOutOptions)
