"""Does a kept clip lose more the nearer it is to a target? Targets that share their moves with kept clips (ours)

A kick while a spin kick is kept, a walk while a run is kept, and the first half of a dance while its second half is
kept. For the last one the study makes a library of its own, in which the two halves stand in the place of the dance.
The bases track the halves as they track the whole.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from forgetmimic_jax.basics.errors import InputError, nearest
from forgetmimic_jax.evaluation.metrics import MINIMUM_SKILL_RANGE
from forgetmimic_jax.evaluation.plots import new_figure
from forgetmimic_jax.evaluation.repeats import over_repeats
from forgetmimic_jax.evaluation.statistics import PlainEstimate
from forgetmimic_jax.evaluation.tables import markdown_table, number, percent
from forgetmimic_jax.studies.claim import Finding, finding
from forgetmimic_jax.studies.conduct import main
from forgetmimic_jax.studies.findings import skill_gone
from forgetmimic_jax.studies.lab import Lab
from forgetmimic_jax.studies.study import Document, Study
from forgetmimic_jax.studies.variants import variant_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from forgetmimic_jax.motion.clip import Clip
    from forgetmimic_jax.training.checkpoint import CheckpointInfo

SPLIT = "dance_a"
# By target, the kept clip that shares its moves by name; by joint angles others may be nearer.
NEIGHBOURS = {"kick": "spinkick", "walk": "run", f"{SPLIT}_first_half": f"{SPLIT}_second_half"}


def overlap_study(neighbours: Mapping[str, str] = NEIGHBOURS, split: str = SPLIT) -> Study:
    """The default run with each target, on the library with a clip in two halves.

    Args:
        neighbours: by target, the kept clip whose name says that it shares its moves.
        split: the clip that is cut in the middle.
    """
    return Study(
        name="overlap",
        title="Does a kept clip lose more the nearer it is to a target?",
        claim="What lies near a target loses more than what lies far from it.",
        ours=True,
        measure=lambda lab: measure(lab, neighbours, split),
        body=body,
        draw=draw,
        findings=findings,
        answer=answer,
        conditions=lambda lab: {"neighbours": dict(neighbours)},
    )


def measure(lab: Lab, neighbours: Mapping[str, str], split: str) -> dict[str, Any]:
    """Each target's runs, and every kept clip's distance to it."""
    clips = in_halves(lab, split)
    names = [clip.name for clip in clips]
    for name in [*neighbours, *neighbours.values()]:
        if name not in names:
            raise InputError(f"{lab.bases[0].path}: no clip '{name}' in its library; {nearest(name, names)}")
    folder = lab.options.trials / f"halves-of-{split}-{lab.bases[0].library_hash}"
    library = write_library(lab, clips, folder / "clips")
    bases = [write_base(base, library, folder) for base in lab.bases]
    variants = {
        target: {repeat: {"targets": target, "library": library, "base": bases[repeat.base]} for repeat in lab.repeats}
        for target in neighbours
    }
    distances = {target: distances_to(target, clips) for target in neighbours}
    return {**lab.over_repeats({}, "overlap", others=variants), "distances": distances}


def in_halves(lab: Lab, split: str) -> list[Clip]:
    """The library's clips, of which `split` became CLIP_first_half and CLIP_second_half."""
    from forgetmimic_jax.attacks.near_duplicates import first_half, second_half
    from forgetmimic_jax.motion.library import read_library
    from forgetmimic_jax.robot.model import load_robot
    from forgetmimic_jax.tracking.setup import library_folder

    clips: list[Clip] = []
    for clip in read_library(load_robot(lab.config.robot), library_folder(lab.config)):
        clips += [first_half(clip), second_half(clip)] if clip.name == split else [clip]
    return clips


def write_library(lab: Lab, clips: Sequence[Clip], folder: Path) -> Path:
    """The folder with a library of the clips, unless it is there already."""
    from forgetmimic_jax.motion.library import add_clip
    from forgetmimic_jax.robot.model import load_robot

    if not folder.is_dir():
        temporary = folder.with_name(f".{folder.name}.tmp")
        shutil.rmtree(temporary, ignore_errors=True)
        for clip in clips:
            add_clip(temporary, load_robot(lab.config.robot), clip, {})
        temporary.rename(folder)
    return folder


def write_base(base: CheckpointInfo, library: Path, folder: Path) -> Path:
    """The policy of a base as a checkpoint of the library in halves, unless it is there already."""
    from forgetmimic_jax.settings.options import replace_given
    from forgetmimic_jax.tracking.env import make_assets
    from forgetmimic_jax.tracking.rsi import initial_failure_level
    from forgetmimic_jax.tracking.setup import make_setup
    from forgetmimic_jax.training import checkpoint
    from forgetmimic_jax.training.checkpoint import Progress

    path = folder / f"base-{checkpoint.policy_hash(base)}"
    if not path.is_dir():
        setup = make_setup(replace_given(base.config, library=library))
        level = initial_failure_level(setup.config.sampling, make_assets(setup).bins)
        policy = checkpoint.load_policy(base, setup.robot)
        checkpoint.save_policy(path, setup, policy, level, Progress(base.iteration, base.environment_steps))
    return path


def distances_to(target: str, clips: Sequence[Clip]) -> dict[str, float]:
    """By kept clip, the mean distance of its segments of a second to the target's nearest segment, rad."""
    from forgetmimic_jax.attacks.warping import distances

    of = {clip.name: clip for clip in clips}
    found = distances([clip for clip in clips if clip.name != target], [of[target]])
    return {
        name: float(np.mean([far for segment, far in found.items() if segment.clip == name]))
        for name in of
        if name != target
    }


def retention(variant: Mapping[str, Any], target: str) -> dict[str, dict[str, float]]:
    """By kept clip and repeat, survival-weighted tracking as a share of the base's; of clips that the base tracks."""
    found: dict[str, dict[str, float]] = {}
    for repeat, run in variant["runs"].items():
        for clip, before in run["base"]["clips"].items():
            if clip != target and before >= MINIMUM_SKILL_RANGE:
                found.setdefault(clip, {})[repeat] = run["policy"]["clips"][clip] / before
    return found


def rank_correlation(one: Sequence[float], other: Sequence[float]) -> float:
    """Spearman's; 0 where either has one value alone."""
    from scipy import stats

    if np.ptp(one) == 0.0 or np.ptp(other) == 0.0:
        return 0.0
    return float(stats.spearmanr(one, other).statistic)


def correlations(results: Mapping[str, Any]) -> dict[str, float]:
    """By repeat, the rank correlation of retention with distance over the kept clips, mean over the targets."""
    found: dict[str, list[float]] = {}
    for target, variant in results["variants"].items():
        kept = retention(variant, target)
        for repeat in variant["runs"]:
            there = [clip for clip, of in kept.items() if repeat in of]
            far = [results["distances"][target][clip] for clip in there]
            found.setdefault(repeat, []).append(rank_correlation(far, [kept[clip][repeat] for clip in there]))
    targets = len(results["variants"])
    return {repeat: float(np.mean(of)) for repeat, of in found.items() if len(of) == targets}


def neighbours_loss(variant: Mapping[str, Any], target: str, neighbour: str) -> PlainEstimate | None:
    """Retention of the neighbour minus the mean of the other kept clips'; None where the base does not track it."""
    kept = retention(variant, target)
    of = {
        repeat: value - float(np.mean([kept[clip][repeat] for clip in kept if clip != neighbour]))
        for repeat, value in kept.get(neighbour, {}).items()
    }
    return over_repeats(of) if of else None


def body(document: Document) -> str:
    """Every kept clip by its distance to each target, and the usual tables."""
    results, neighbours = document["results"], document["conditions"]["neighbours"]
    rows = []
    for target, variant in results["variants"].items():
        kept = retention(variant, target)
        for clip in sorted(kept, key=lambda clip: results["distances"][target][clip]):
            name = f"**{clip}**" if clip == neighbours[target] else clip
            rows.append([target, name, f"{results['distances'][target][clip]:.2f}", percent(over_repeats(kept[clip]))])
    note = (
        "Retention: the kept clip's tracking (survival-weighted) over the base's on the same episodes. Distance: "
        "dynamic time warping of the joint angles, from each second of the kept clip to the target's nearest second, "
        "mean over the kept clip. In bold: the clip whose name says that it shares the target's moves; by joint angles "
        "others may be nearer.\n"
    )
    table = markdown_table(["target", "kept clip", "distance, rad", "retention"], rows)
    return f"{table}\n{note}\n{variant_table(results['variants'], {})}"


def findings(document: Document) -> Iterator[Finding]:
    """Retention rises with distance; each neighbour loses more than the others; each target is forgotten."""
    results, neighbours = document["results"], document["conditions"]["neighbours"]
    found = correlations(results)
    if found:
        rises = over_repeats(found)
        evidence = f"rank correlation of retention with distance, mean over the targets {number(rises, 2)}; bound 0"
        yield finding("the nearer to a target, the less is retained", rises, 0.0, evidence, below=False, main=True)
    for target, variant in results["variants"].items():
        less = neighbours_loss(variant, target, neighbours[target])
        if less:
            evidence = f"retention of {neighbours[target]} minus the other kept clips' mean {percent(less)}; bound 0 %"
            claim = f"{target} forgotten: {neighbours[target]} loses more than the other kept clips"
            yield finding(claim, less, 0.0, evidence)
        yield from skill_gone(results["variants"], target, f"{target}: the skill is gone")


def answer(document: Document) -> str:
    """The correlation, and what each neighbour lost, in one sentence."""
    results, parts = document["results"], []
    for target, neighbour in document["conditions"]["neighbours"].items():
        less = (
            neighbours_loss(results["variants"][target], target, neighbour) if target in results["variants"] else None
        )
        if less:
            parts.append(f"{percent(less)} ({neighbour}, with {target} forgotten)")
    found = correlations(results)
    rises = number(over_repeats(found), 2) if found else "unknown"
    return (
        f"The rank correlation of a kept clip's retention with its distance to the target is {rises}; retention of the "
        f"clip that shares the target's moves minus that of the others: {'; '.join(parts)}."
    )


def draw(document: Document) -> Figure:
    """Retention over distance, a panel a target; the neighbour in red."""
    results, neighbours = document["results"], document["conditions"]["neighbours"]
    figure = new_figure(width=4.0 * len(results["variants"]), height=4.0)
    for place, (target, variant) in enumerate(results["variants"].items()):
        axes = figure.add_subplot(1, len(results["variants"]), place + 1)
        for clip, runs in retention(variant, target).items():
            of, far = over_repeats(runs), results["distances"][target][clip]
            low, high = of.get("low", of["mean"]), of.get("high", of["mean"])
            colour = "tab:red" if clip == neighbours[target] else "tab:blue"
            error = [[of["mean"] - low], [high - of["mean"]]]
            axes.errorbar([far], [of["mean"]], yerr=error, fmt="o", color=colour, capsize=3)
            axes.annotate(clip, (far, of["mean"]), xytext=(4, 4), textcoords="offset points", fontsize="x-small")
        axes.axhline(1.0, color="0.6", linestyle=":")
        axes.set_title(f"{target} forgotten", fontsize="medium")
        axes.set_xlabel("distance to the target, rad")
    figure.axes[0].set_ylabel("retention of the base's tracking")
    return figure


STUDY = overlap_study()

if __name__ == "__main__":
    main(STUDY)
