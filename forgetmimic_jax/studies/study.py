"""What makes a study: its question, its claim, what it measures, and how its page and figure show that."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from forgetmimic_jax.studies.claim import Finding
from forgetmimic_jax.studies.lab import Lab
from forgetmimic_jax.studies.variants import variant_bars, variant_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Of a trial without a stop rule: enough to tell variants apart. Studies that train for longer say so.
ITERATIONS = {"cpu": 200, "paper": 1000}

Document = Mapping[str, Any]


@dataclass(frozen=True)
class Study:
    """What makes a study.

    Args:
        name: of its files.
        title: its question, in a few words.
        claim: what the paper says, in one sentence; see `ours`.
        measure: runs the trials; returns the JSON's `results`.
        body: (document) → the page's tables and what a reader must know of them, in Markdown.
        draw: (document) → its figure.
        findings: (document) → what the numbers say of the paper's claims; the main ones answer `claim`.
        iterations: of each trial, by preset.
        conditions: (lab) → what the results depend on beside the options, such as the values of a sweep.
        answer: (document) → what was measured of `claim`, in one sentence; by default the main findings' evidence.
        theirs: the paper's own number for `claim`, in words; empty where it has none.
        ours: whether the claim is this project's and not the paper's.
        watches: whether it reads the evaluations during training, which have `watched_episodes`.
        own_targets: whether every row has targets of its own.
        kind: of its runs: they unlearn from the bases, train fresh policies on all clips, or only roll the bases out.
    """

    name: str
    title: str
    claim: str
    measure: Callable[[Lab], dict[str, Any]]
    body: Callable[[Document], str]
    draw: Callable[[Document], Figure]
    findings: Callable[[Document], Iterable[Finding]]
    iterations: Mapping[str, int] = field(default_factory=lambda: ITERATIONS)
    conditions: Callable[[Lab], Mapping[str, Any]] = lambda lab: {}
    answer: Callable[[Document], str] | None = None
    theirs: str = ""
    ours: bool = False
    watches: bool = False
    own_targets: bool = False
    kind: Literal["unlearn", "fresh", "rollout"] = "unlearn"


def variants_study(
    name: str,
    title: str,
    claim: str,
    variants: Callable[[Lab], Mapping[str, Mapping[str, Any]]],
    *,
    papers: Mapping[str, Any],
    **others: Any,
) -> Study:
    """A study of the usual kind: variants over repeats, a row of the table and a pair of bars each.

    Args:
        name: see `Study`.
        title: see `Study`.
        claim: see `Study`.
        variants: by label, the options of `forgetmimic_jax.unlearn` that a lab is to try.
        papers: its numbers, a row of the table each.
        others: the rest of `Study`; `body` and `draw` are the table and the bars by default.
    """
    usual: dict[str, Any] = {
        "measure": lambda lab: lab.over_repeats(variants(lab), name),
        "body": lambda document: variant_table(document["results"]["variants"], papers),
        "draw": lambda document: variant_bars(document["results"]["variants"]),
    }
    return Study(name=name, title=title, claim=claim, **{**usual, **others})
