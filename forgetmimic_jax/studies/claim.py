"""A claim of the paper as a number and a bound, and the word that a study's numbers give it.

A claim *holds* where the whole 95 % interval of its number lies on the right side of the bound, *does not hold* where
the interval lies on the wrong side, and is *open* between. One unit, a base or a seed, has no interval.

Of many intervals at 95 % some miss by chance. The words of a study are therefore corrected for their number by Holm's
method, those that answer its main claim and those of its further findings apart: in either family the chance that any
word is wrong is at most 5 %. Holm and not Benjamini-Hochberg, because the claims of a study are about the same few
runs, and Holm's bound needs nothing known about how they depend on each other.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from forgetmimic_jax.evaluation.repeats import over_repeats
from forgetmimic_jax.evaluation.statistics import PlainEstimate
from forgetmimic_jax.evaluation.tables import markdown_table

LEVEL = 0.05
HOLDS, FAILS, OPEN = "holds", "does not hold", "open"
ONE_RUN = {HOLDS: "one run: yes", FAILS: "one run: no"}


@dataclass(frozen=True)
class Finding:
    """What a study says of a claim.

    Args:
        claim: one sentence.
        word: `HOLDS`, `FAILS`, `OPEN`, or words of a study's own.
        evidence: the number and its bound.
        n: how many units the number is over: bases, or the seeds of one base.
        p: two-sided p-value of the number against its bound; None where nothing was tested, as with one unit.
        main: whether it is a part of the answer to the study's claim of the paper.
    """

    claim: str
    word: str
    evidence: str
    n: int
    p: float | None = None
    main: bool = False


class Between(NamedTuple):
    """A number that is known to lie between two ends; both are the number itself where it was measured."""

    low: float
    high: float


def judged(value: PlainEstimate, bound: float, *, below: bool = True) -> str:
    """Whether a number lies below (or above) its bound."""
    mean = value["mean"]
    if "low" not in value:
        return ONE_RUN[HOLDS if (mean <= bound) == below else FAILS]
    low, high = value["low"], value["high"]
    if (high <= bound) if below else (low >= bound):
        return HOLDS
    return FAILS if ((low >= bound) if below else (high <= bound)) else OPEN


def p_value(value: PlainEstimate, bound: float) -> float | None:
    """Two-sided p-value of `mean = bound`, from the same distribution as the 95 % interval; None for one unit.

    An interval excludes the bound where this is under 0.05.
    """
    from scipy import stats  # which takes a second to load

    if "low" not in value:
        return None

    if "episodes" in value:  # an exact interval of all episodes together, see `variants.estimates_of`
        episodes, successes = value["episodes"], round(value["mean"] * value["episodes"])
        tails = stats.binom.cdf(successes, episodes, bound), stats.binom.sf(successes - 1, episodes, bound)
        return float(min(1.0, 2.0 * min(tails)))
    distance, error = abs(value["mean"] - bound), value["std"] / np.sqrt(value["n"])
    if error == 0.0:
        return 1.0 if distance == 0.0 else 0.0
    return float(2.0 * stats.t.sf(distance / error, value["n"] - 1))


def finding(
    claim: str, value: PlainEstimate, bound: float, evidence: str, *, below: bool = True, main: bool = False
) -> Finding:
    """A claim that a number lies below (or above) a bound."""
    return Finding(claim, judged(value, bound, below=below), evidence, value["n"], p_value(value, bound), main)


def finding_between(
    claim: str, values: Mapping[str, Between], bound: float, evidence: str, *, below: bool = True, main: bool = False
) -> Finding:
    """The same of numbers, one a repeat, of which some were not measured but only bounded.

    The claim holds where it does with every number at its end nearest to the bound's wrong side, and does not hold
    where it fails with every number at the other end. An infinite end decides nothing.
    """
    lows = {repeat: low for repeat, (low, _) in values.items()}
    highs = {repeat: high for repeat, (_, high) in values.items()}
    cautious, generous = (highs, lows) if below else (lows, highs)
    for ends, word in ((cautious, HOLDS), (generous, FAILS)):
        if _finite(ends):
            found = finding(claim, over_repeats(ends), bound, evidence, below=below, main=main)
            if found.word in (word, ONE_RUN[word]):
                return found
    units = over_repeats(dict.fromkeys(values, 0.0))["n"]
    tested = units > 1 and (_finite(lows) or _finite(highs))
    return Finding(claim, OPEN, evidence, units, 1.0 if tested else None, main)


def _finite(ends: Mapping[str, float]) -> bool:
    return bool(np.isfinite(list(ends.values())).all())


def corrected(findings: Iterable[Finding]) -> list[Finding]:
    """The findings of a study with the words that remain after Holm's correction, in each of the two families."""
    findings = list(findings)
    undecided = {id(found) for main in (True, False) for found in _undecided([f for f in findings if f.main == main])}
    return [dataclasses.replace(found, word=OPEN) if id(found) in undecided else found for found in findings]


def _undecided(family: Sequence[Finding]) -> list[Finding]:
    """What Holm's method leaves open (Holm 1979, "A simple sequentially rejective multiple test procedure").

    The smallest of m p-values is compared with level / m, the next with level / (m - 1), and so on; from the first that
    is larger, all are open.
    """
    tested = sorted((found for found in family if found.p is not None), key=lambda found: found.p or 0.0)
    for place, found in enumerate(tested):
        if (found.p or 0.0) > LEVEL / (len(tested) - place):
            return tested[place:]
    return []


def answer(claim: str, findings: Iterable[Finding]) -> Finding:
    """A study's answer to its claim: the claim holds where all main findings do, and fails where one does.

    Args:
        claim: the paper's, in one sentence.
        findings: of the study, corrected.
    """
    main = [found for found in findings if found.main]
    words = {found.word for found in main}
    word = FAILS if FAILS in words else words.pop() if len(words) == 1 else OPEN
    return Finding(claim, word, "; ".join(found.evidence for found in main), min(found.n for found in main))


def findings_table(findings: Iterable[Finding]) -> str:
    """The findings of a study, the main ones first, in Markdown."""
    rows = [
        [found.claim, f"**{found.word}**", found.evidence, str(found.n)]
        for found in sorted(findings, key=lambda found: not found.main)
    ]
    return markdown_table(["claim", "here", "number", "n"], rows)
