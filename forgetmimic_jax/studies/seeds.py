"""The default run with several seeds."""

from __future__ import annotations

from collections.abc import Iterator

from forgetmimic_jax.studies import paper
from forgetmimic_jax.studies.claim import Finding
from forgetmimic_jax.studies.findings import forgotten_and_kept, kept_stay, no_success, skill_gone
from forgetmimic_jax.studies.study import Document, Study, variants_study

LABEL = "λ = 16"


def seeds_study(_: tuple[str, ...] = ()) -> Study:
    """Only the seed differs."""
    return variants_study(
        "seeds",
        "The default run",
        "The targets are forgotten and the other clips are kept.",
        lambda lab: {LABEL: {}},
        findings=findings,
        answer=lambda document: forgotten_and_kept(document["results"]["variants"]),
        papers=paper.VALIDITY,
    )


def findings(document: Document) -> Iterator[Finding]:
    """Forgotten and kept."""
    variants = document["results"]["variants"]
    yield no_success(variants, LABEL, "the targets are no longer completed", main=True)
    yield from skill_gone(variants, LABEL, "the skill on the targets is gone", main=True)
    yield from kept_stay(variants, LABEL, None, "the kept clips stay as they were", main=True)
