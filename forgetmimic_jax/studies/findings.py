"""Findings that several studies state: the targets are forgotten, the kept clips are kept."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from forgetmimic_jax.evaluation.tables import FORGOTTEN, percent, share
from forgetmimic_jax.studies.claim import Finding, finding
from forgetmimic_jax.studies.variants import estimates, mean_gained, within

SUCCESS = "success_rate"
NONE = 0.05  # of the episodes: a success rate of at most this counts as none
POINTS = 0.05  # of success rate that kept clips may lose


def no_success(variants: Mapping[str, Any], label: str, claim: str, *, main: bool = False) -> Finding:
    """The targets are no longer completed."""
    success = estimates(variants[label])["policy"]["target"][SUCCESS]
    evidence = f"success on the targets {percent(within(success, 0.0, 1.0))}; bound {share(NONE)}"
    return finding(claim, success, NONE, evidence, main=main)


def skill_gone(variants: Mapping[str, Any], label: str, claim: str, *, main: bool = False) -> Iterator[Finding]:
    """The skill on the targets is gone; no finding where the base has no skill to lose."""
    skill = estimates(variants[label])["policy"]["target"].get("skill")
    if skill:
        evidence = f"skill retained on the targets {percent(skill)}; bound {share(FORGOTTEN)}"
        yield finding(claim, skill, FORGOTTEN, evidence, main=main)


def kept_stay(
    variants: Mapping[str, Any], label: str, other: str | None, claim: str, *, main: bool = False
) -> Iterator[Finding]:
    """The kept clips succeed as often as with the base, or as with another variant of the same repeat."""
    change = mean_gained(variants, label, other, "kept", SUCCESS)
    if change:
        whose = "the control's" if other else "the base's"
        evidence = f"success on the kept clips minus {whose} {percent(change)}; bound {share(-POINTS)}"
        yield finding(claim, change, -POINTS, evidence, below=False, main=main)


def forgotten_and_kept(variants: Mapping[str, Any]) -> str:
    """What was measured of "forgotten and kept", label by label, for a reader."""
    parts = []
    for label, variant in variants.items():
        skill = estimates(variant)["policy"]["target"].get("skill")
        change = mean_gained(variants, label, None, "kept", SUCCESS)
        parts.append(f"{percent(skill)} and {percent(change)} ({label})")
    return (
        "Skill retained on the targets, and change of the success rate on the other clips against the base: "
        f"{'; '.join(parts)}."
    )
