"""Every sampler of start states, with and without the assistive wrench (paper, the ablation of table 1)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.evaluation.repeats import over_repeats
from forgetmimic_jax.evaluation.statistics import PlainEstimate
from forgetmimic_jax.evaluation.tables import number
from forgetmimic_jax.studies import paper
from forgetmimic_jax.studies.claim import Finding, finding
from forgetmimic_jax.studies.study import Study, variants_study
from forgetmimic_jax.studies.variants import TRACKING, gained

SAMPLERS = ("uniform_clips", "uniform_bins", "frozen", "adaptive")


def sampler_study(samplers: tuple[str, ...] = SAMPLERS) -> Study:
    """The four samplers, with and without the wrench.

    Raises:
        InputError: no such sampler.
    """
    for sampler in samplers:
        if sampler not in SAMPLERS:
            raise InputError(f"--values: no sampler '{sampler}'; known: {', '.join(SAMPLERS)}")
    conditions = {"values": list(samplers)}
    return variants_study(
        "sampler",
        "What do the sampler and the wrench do?",
        "Adaptive sampling and the wrench resist forgetting and cost the kept clips.",
        lambda lab: ablation(samplers),
        findings=lambda document: findings(document["results"]["variants"], main=True),
        papers=paper.ABLATION,
        conditions=lambda lab: conditions,
    )


def label_of(sampler: str, *, wrench: bool = False) -> str:
    """A row of the ablation."""
    return f"{sampler.replace('_', ' ')}{', wrench' if wrench else ''}"


def ablation(samplers: tuple[str, ...] = SAMPLERS) -> dict[str, dict[str, Any]]:
    """Each sampler without and with the wrench, for arft; the targets' share of the starts is the sampler's own."""
    own_share = {"set": ["sampling.target_share=0.0"]}
    return {
        label_of(sampler, wrench=wrench): {
            **(own_share if sampler == "uniform_clips" else {"sampler": sampler}),
            **({"wrench": True} if wrench else {}),
        }
        for sampler in samplers
        for wrench in (False, True)
    }


def findings(variants: Mapping[str, Any], prefix: str = "", *, main: bool = False) -> Iterator[Finding]:
    """What adaptive sampling, its feedback and the wrench do to targets and kept clips; `prefix` leads the labels."""

    def against(one: str, other: str) -> list[tuple[str, str]]:
        """The pairs of two samplers, without and with the wrench."""
        return [(prefix + label_of(one, wrench=w), prefix + label_of(other, wrench=w)) for w in (False, True)]

    with_wrench = [(prefix + label_of(sampler, wrench=True), prefix + label_of(sampler)) for sampler in SAMPLERS]
    switches = {
        "adaptive sampling": (against("adaptive", "uniform_clips"), "uniform clips, mean of wrench and none"),
        "the feedback of adaptive sampling": (
            against("adaptive", "frozen"),
            "frozen at the base's shares, mean of wrench and none",
        ),
        "the wrench": (with_wrench, "none, mean of the samplers"),
    }
    for name, (pairs, other) in switches.items():
        for group, claim in (("target", f"{name} resists forgetting"), ("kept", f"{name} costs the kept clips")):
            change = effect(variants, pairs, group)
            if change:
                evidence = f"{group} tracking minus that with {other} {number(change, 2)}; bound 0"
                yield finding(claim, change, 0.0, evidence, below=group == "kept", main=main)


def effect(variants: Mapping[str, Any], pairs: Sequence[tuple[str, str]], group: str) -> PlainEstimate | None:
    """What one switch changes in tracking, mean over what else is set; None where no repeat has all.

    Args:
        variants: of the comparison.
        pairs: the variants with and without it.
        group: target or kept.
    """
    each = [gained(variants, *pair, group, TRACKING) for pair in pairs]
    means = {at: float(np.mean([of[at] for of in each])) for at in each[0] if all(at in of for of in each)}
    return over_repeats(means) if means else None
