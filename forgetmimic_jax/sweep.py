"""Several unlearning runs that differ in one thing: `forgetmimic sweep lambda`."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.evaluation import paper, statistics
from forgetmimic_jax.evaluation.metrics import BASE
from forgetmimic_jax.evaluation.plots import curve, heat_map, new_figure
from forgetmimic_jax.evaluation.tables import FORGOTTEN, number
from forgetmimic_jax.evaluation.variants import variant_table
from forgetmimic_jax.settings.options import comma_separated, parse
from forgetmimic_jax.studies.claim import Between
from forgetmimic_jax.studies.study import ITERATIONS, Lab, Study, conduct, variants_study
from forgetmimic_jax.studies.study import Options as StudyOptions

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PENALTIES = ("0.5", "1", "4", "6", "7", "8", "9", "12", "16")  # the paper's, and the neighbours of W = 8
GROUPS = ("punch,kick", "dance_a,dance_b", "run")  # combat, dance and locomotion, as in the paper
SAMPLERS = ("uniform_clips", "uniform_bins", "frozen", "adaptive")


@dataclass(kw_only=True)
class Options(StudyOptions):
    """Run what is missing of a sweep, then write its JSON, its table and its figure."""

    kind: Annotated[Literal["lambda", "targets", "sampler", "seeds"], tyro.conf.Positional]
    """What the runs differ in: the penalty, the targets, the sampler with and without the wrench, or only the seed."""
    values: list[str] = field(default_factory=list)
    """Penalties (by default 0.5 1 4 6 7 8 9 12 16), groups of targets (punch,kick dance_a,dance_b run) or samplers."""
    output: Path | None = None
    """Folder for KIND.json, KIND.md, KIND.png and KIND.svg; runs/sweep-ROBOT-KIND by default."""


def lambda_study(penalties: tuple[str, ...] = PENALTIES, name: str = "lambda") -> Study:
    """What the penalty λ does, and where the targets tip over."""
    try:
        values = {f"λ = {float(text):g}": {"penalty": float(text)} for text in penalties}
    except ValueError as error:
        raise InputError(f"--values: {error}; accepted: penalties above 0, such as 4 8 16") from None
    if not all(0.0 < value["penalty"] < math.inf for value in values.values()):
        raise InputError(f"--values: found {' '.join(penalties)}; accepted: penalties above 0, such as 4 8 16")
    return variants_study(
        name,
        "The penalty λ",
        lambda lab: values,
        paper.LAMBDA,
        iterations=ITERATIONS | {"paper": 30_000},
        asks=list(values),
        tell=lambda document: _tell_lambda(document["results"]["variants"]),
        draw=lambda document: _draw_lambda(document["results"]["variants"]),
    )


def targets_study(
    groups: tuple[str, ...] = GROUPS,
    name: str = "targets",
    title: str = "Other motions as targets",
    theirs: Mapping[str, Any] | None = None,
) -> Study:
    """Other clips to forget, beside the paper's numbers where it has them."""

    def variants(lab: Lab) -> dict[str, dict[str, Any]]:
        from forgetmimic_jax.tracking.setup import check_targets

        asked = [comma_separated(group) for group in groups]
        if groups == GROUPS:  # as far as the robot's library has them
            there = [tuple(clip for clip in targets if clip in lab.info.clips) for targets in asked]
            asked = [targets for targets in there if targets]
        for targets in asked:
            check_targets(targets, lab.info.clips)
        return {" + ".join(targets): {"targets": ",".join(targets)} for targets in asked}

    return variants_study(
        name,
        title,
        variants,
        theirs or {},
        asks=list(groups),
        draw=lambda document: _draw_targets(document["results"]["variants"]),
    )


def sampler_study(samplers: tuple[str, ...] = SAMPLERS) -> Study:
    """The four samplers, with and without the wrench."""
    for sampler in samplers:
        if sampler not in SAMPLERS:
            raise InputError(f"--values: no sampler '{sampler}'; known: {', '.join(SAMPLERS)}")
    asks = list(samplers)
    return variants_study("sampler", "Sampler and wrench", lambda lab: ablation(samplers), paper.ABLATION, asks=asks)


def seeds_study(_: tuple[str, ...] = ()) -> Study:
    """The default run with several seeds."""
    return variants_study("seeds", "The default run", lambda lab: {"λ = 16": {}}, paper.VALIDITY)


def ablation(samplers: tuple[str, ...] = SAMPLERS) -> dict[str, dict[str, Any]]:
    """Each sampler without and with the wrench, for arft; the targets' share is the sampler's own."""
    own_share = {"set": ["sampling.target_share=0.0"]}
    return {
        f"{sampler.replace('_', ' ')}{', wrench' if wrench else ''}": {
            **(own_share if sampler == "uniform_clips" else {"sampler": sampler}),
            **({"wrench": True} if wrench else {}),
        }
        for sampler in samplers
        for wrench in (False, True)
    }


STUDIES: dict[str, Callable[..., Study]] = {
    "lambda": lambda_study,
    "targets": targets_study,
    "sampler": sampler_study,
    "seeds": seeds_study,
}


def edge() -> float:
    """W, the total weight of the tracking terms by default: the penalty at which the paper's algebra turns."""
    from forgetmimic_jax.settings.config import RewardConfig
    from forgetmimic_jax.tracking.reward import total_tracking_weight

    return total_tracking_weight(RewardConfig())


def _tell_lambda(variants: Mapping[str, Any]) -> str:
    skill = {label: variant["over_seeds"]["policy"]["target"].get("skill", {}) for label, variant in variants.items()}
    forgotten = [label for label, estimate in skill.items() if estimate.get("mean", 1.0) <= FORGOTTEN]
    first = next(iter(variants.values()))["over_seeds"]
    lines = [variant_table(variants, paper.LAMBDA)]
    if "lambda_crit" in first:
        lines.append(
            "On the base's own target steps the mean reward changes its sign at λ_crit = W (1 + R_reg / R_track) = "
            f"{number(first['lambda_crit'], 2)}; W = {edge():g} leaves the other rewards out.\n"
        )
    crossed = half_gone_by_seed(variants)
    if crossed:
        lines.append(
            f"Half of the base's skill on the targets is gone at λ = {told_half_gone(crossed)} (between two penalties "
            "the skill is taken as linear in log λ). A longer run may forget at a smaller λ.\n"
        )
    lines.append(
        f"At most {100 * FORGOTTEN:.0f} % of the base's skill on the targets is left at "
        f"{', '.join(forgotten) if forgotten else 'none of these penalties'}.\n"
    )
    return "\n".join(lines)


def half_gone_by_seed(variants: Mapping[str, Any]) -> list[Between]:
    """Where half of the skill is gone, for each seed that has a skill."""
    skills: dict[str, dict[float, float]] = {}
    for variant in variants.values():
        for seed, run in variant["seeds"].items():
            if "skill" in run["policy"]["target"]:
                skills.setdefault(seed, {})[float(variant["options"]["penalty"])] = run["policy"]["target"]["skill"]
    return [half_gone(of) for of in skills.values()]


def half_gone(skills: Mapping[float, float]) -> Between:
    """The penalty at which the skill, linear in log λ between the penalties tried, first falls to a half.

    Between 0 and the smallest penalty where the skill is at most a half there already, between the largest and infinity
    where it is more than a half at all of them.
    """
    tried = sorted(skills)
    if skills[tried[0]] <= 0.5:
        return Between(0.0, tried[0])
    for low, high in itertools.pairwise(tried):
        if skills[low] > 0.5 >= skills[high]:
            share = (skills[low] - 0.5) / (skills[low] - skills[high])
            return Between(*[low * (high / low) ** share] * 2)
    return Between(tried[-1], math.inf)


def told_half_gone(crossed: Sequence[Between]) -> str:
    """The mean over the seeds; seed by seed where one lies outside the penalties that were tried."""
    if all(low == high for low, high in crossed):
        return f"{number(statistics.over_seeds([low for low, _ in crossed]), 1)}, mean of {len(crossed)} seed(s)"
    words = [
        f"{low:.1f}" if low == high else f"below {high:g}" if low == 0.0 else f"above {low:g}" for low, high in crossed
    ]
    return f"{', '.join(words)}, seed by seed"


def _draw_lambda(variants: Mapping[str, Any]) -> Figure:
    penalties = [float(variant["options"]["penalty"]) for variant in variants.values()]
    figure = new_figure(width=11.0, height=3.5)
    for place, metric in enumerate(("survival_weighted_tracking", "success_rate", "tracking_reward")):
        axes = figure.add_subplot(1, 3, place + 1)
        for group in ("target", "kept"):
            of = [variant["over_seeds"]["policy"][group][metric] for variant in variants.values()]
            curve(axes, penalties, of, group)
        axes.set_xscale("log", base=2)
        axes.set_xticks(penalties, [f"{penalty:g}" for penalty in penalties])
        axes.axvline(edge(), color="0.6", linestyle=":", label="W")
        crit = next(iter(variants.values()))["over_seeds"].get("lambda_crit")
        if crit:
            axes.axvline(crit["mean"], color="0.3", linestyle="--", label="λ_crit")
        axes.set_ylim(0.0, 1.02)
        axes.set_xlabel("λ")
        axes.set_title(metric.replace("_", " "), fontsize="medium")
    figure.axes[0].legend(frameon=False)
    return figure


def _draw_targets(variants: Mapping[str, Any]) -> Figure:
    """Survival-weighted tracking of every clip, of the base and after forgetting each group; targets framed."""
    from matplotlib.patches import Rectangle

    first = next(iter(variants.values()))["over_seeds"]
    columns = {"base": first[BASE]} | {label: variant["over_seeds"]["policy"] for label, variant in variants.items()}
    clips = list(first[BASE]["clips"])
    values = [[of["clips"][clip]["survival_weighted_tracking"]["mean"] for of in columns.values()] for clip in clips]
    figure = new_figure(width=3.0 + 0.9 * len(columns), height=1.5 + 0.35 * len(clips))
    axes = figure.add_subplot()
    heat_map(axes, values, clips, list(columns))
    for place, variant in enumerate(variants.values(), start=1):
        for target in variant["options"]["targets"].split(","):
            corner = (place - 0.5, clips.index(target) - 0.5)
            axes.add_patch(Rectangle(corner, 1.0, 1.0, fill=False, edgecolor="red", linewidth=2))
    axes.set_title("survival-weighted tracking", fontsize="medium")
    return figure


def main(options: Options) -> None:
    """Run the sweep."""
    options.output = options.output or Path("runs") / f"sweep-{options.robot}-{options.kind}"
    make = STUDIES[options.kind]
    conduct(make(tuple(options.values)) if options.values else make(), options, "make experiments")


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "sweep")))
