"""What the penalty λ does, and at which λ the targets are forgotten (paper, table 2)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.evaluation.plots import curve, new_figure
from forgetmimic_jax.evaluation.repeats import over_repeats
from forgetmimic_jax.evaluation.tables import FORGOTTEN, number, share
from forgetmimic_jax.studies import paper
from forgetmimic_jax.studies.claim import Between, Finding, finding_between
from forgetmimic_jax.studies.findings import SUCCESS
from forgetmimic_jax.studies.study import ITERATIONS, Document, Study, variants_study
from forgetmimic_jax.studies.variants import TRACKING, estimates, variant_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PENALTIES = ("0.5", "1", "4", "6", "7", "8", "9", "12", "16")  # the paper's, and the neighbours of W = 8


def penalty_study(penalties: tuple[str, ...] = PENALTIES, name: str = "penalty") -> Study:
    """The default run with each penalty.

    Raises:
        InputError: a penalty that is not a number above 0.
    """
    try:
        values = {f"λ = {float(text):g}": {"penalty": float(text)} for text in penalties}
    except ValueError as error:
        raise InputError(f"--values: {error}; accepted: penalties above 0, such as 4 8 16") from None
    if not all(0.0 < value["penalty"] < math.inf for value in values.values()):
        raise InputError(f"--values: found {' '.join(penalties)}; accepted: penalties above 0, such as 4 8 16")
    return variants_study(
        name,
        "What does the penalty λ do, and from which λ on are the targets forgotten?",
        "The targets are forgotten from λ = 8 on, the sum W of the tracking weights.",
        lambda lab: values,
        papers=paper.PENALTY,
        iterations=ITERATIONS | {"paper": 30_000},
        conditions=lambda lab: {"values": list(values)},
        body=body,
        draw=draw,
        findings=findings,
        answer=answer,
        theirs="targets succeed in 100 % of the episodes at λ = 4 and in 0 % at λ = 8",
    )


def edge() -> float:
    """W, the total weight of the tracking terms: where the paper's algebra has the mean target reward change sign."""
    from forgetmimic_jax.settings.config import RewardConfig
    from forgetmimic_jax.tracking.reward import total_tracking_weight

    return total_tracking_weight(RewardConfig())


def body(document: Document) -> str:
    """The table, λ_crit, and where the targets are forgotten."""
    variants = document["results"]["variants"]
    skill = {label: estimates(variant)["policy"]["target"].get("skill", {}) for label, variant in variants.items()}
    forgotten = [label for label, estimate in skill.items() if estimate.get("high", 1.0) <= FORGOTTEN]
    lines = [variant_table(variants, paper.PENALTY)]
    crit = _lambda_crit(variants)
    if crit:
        lines.append(
            "On the base's own target steps the mean reward changes its sign at λ_crit = W (1 + R_reg / R_track) = "
            f"{number(crit, 2)}; W = {edge():g} leaves the other rewards out.\n"
        )
    crossed = half_gone_by_repeat(variants)
    if crossed:
        lines.append(
            f"Half of the base's skill on the targets is gone at λ = {half_gone_text(crossed)} (between two penalties "
            "the skill is taken as linear in log λ). A longer run may forget at a smaller λ.\n"
        )
    lines.append(
        f"At most {share(FORGOTTEN)} of the base's skill on the targets is retained, by the whole interval, at "
        f"{', '.join(forgotten) if forgotten else 'none of these penalties'}.\n"
    )
    return "\n".join(lines)


def findings(document: Document) -> Iterator[Finding]:
    """Where the targets are forgotten."""
    variants = document["results"]["variants"]
    crossed, crit = half_gone_by_repeat(variants), _lambda_crit(variants)
    if crossed:
        evidence = f"half of the skill on the targets is gone at λ = {half_gone_text(crossed)}; bound {edge():g}"
        evidence += f"; λ_crit on the base's steps {number(crit, 2)}" if crit else ""
        claim = f"half of the skill is gone at λ = {edge():g} or below"
        yield finding_between(claim, crossed, edge(), evidence, main=True)


def answer(document: Document) -> str:
    """Where half of the skill is gone, beside W, in one sentence."""
    crossed, crit = half_gone_by_repeat(document["results"]["variants"]), _lambda_crit(document["results"]["variants"])
    if not crossed:
        return "The base has no skill on the targets that could be forgotten."
    edge_here = f", and at λ = {number(crit, 2)} the targets' mean reward changes its sign here" if crit else ""
    return (
        f"Half of the skill on the targets is gone at λ = {half_gone_text(crossed)}, where W is {edge():g}{edge_here}."
    )


def half_gone_by_repeat(variants: Mapping[str, Any]) -> dict[str, Between]:
    """Where half of the skill is gone, for each repeat that has a skill."""
    skills: dict[str, dict[float, float]] = {}
    for variant in variants.values():
        for repeat, run in variant["runs"].items():
            if "skill" in run["policy"]["target"]:
                skills.setdefault(repeat, {})[float(variant["options"]["penalty"])] = run["policy"]["target"]["skill"]
    return {repeat: half_gone(of) for repeat, of in skills.items()}


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


def half_gone_text(crossed: Mapping[str, Between]) -> str:
    """The mean over the repeats; run by run where one lies outside the penalties that were tried."""
    if all(low == high for low, high in crossed.values()):
        return number(over_repeats({repeat: low for repeat, (low, _) in crossed.items()}), 1)
    words = [
        f"{low:.1f}" if low == high else f"below {high:g}" if low == 0.0 else f"above {low:g}"
        for low, high in crossed.values()
    ]
    return f"{', '.join(words)} (run by run)"


def draw(document: Document) -> Figure:
    """Success and tracking over λ, with W and λ_crit."""
    variants = document["results"]["variants"]
    penalties = [float(variant["options"]["penalty"]) for variant in variants.values()]
    over, crit = [estimates(variant)["policy"] for variant in variants.values()], _lambda_crit(variants)
    figure = new_figure(width=11.0, height=3.5)
    for place, metric in enumerate((TRACKING, SUCCESS, "tracking_reward")):
        axes = figure.add_subplot(1, 3, place + 1)
        for group in ("target", "kept"):
            curve(axes, penalties, [of[group][metric] for of in over], group)
        axes.set_xscale("log", base=2)
        axes.set_xticks(penalties, [f"{penalty:g}" for penalty in penalties])
        axes.axvline(edge(), color="0.6", linestyle=":", label="W")
        if crit:
            axes.axvline(crit["mean"], color="0.3", linestyle="--", label="λ_crit")
        axes.set_ylim(0.0, 1.02)
        axes.set_xlabel("λ")
        axes.set_title(metric.replace("_", " "), fontsize="medium")
    figure.axes[0].legend(frameon=False)
    return figure


def _lambda_crit(variants: Mapping[str, Any]) -> Any:
    """λ_crit in the first iteration, whose steps are the base's with every penalty; None if absent."""
    return estimates(next(iter(variants.values()))).get("lambda_crit")
