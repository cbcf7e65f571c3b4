"""A claim of the paper as a number and a bound, and the word that a study's numbers give it.

A claim *holds* where the whole 95 % interval of its number lies on the right side of the bound, *does not hold* where
the interval lies on the wrong side, and is *open* between. One unit, a base or a seed, has no interval. Units that are
all the same have none either, but for rates (`evaluation.repeats`), and then nothing is decided.

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

from forgetmimic_jax.evaluation import statistics
from forgetmimic_jax.evaluation.repeats import SEED, over_repeats, units
from forgetmimic_jax.evaluation.statistics import PlainEstimate
from forgetmimic_jax.evaluation.tables import markdown_table

LEVEL = 0.05
LIMIT = 100  # units; a study of more would not be run
HOLDS, FAILS, OPEN = "holds", "does not hold", "open"
ONE_RUN = {HOLDS: "one run: yes", FAILS: "one run: no"}
ONE_BASE = {HOLDS: "one base: yes", FAILS: "one base: no"}  # of several, as the interval over its seeds has it
ONE_VALUE = "one value"  # the same in every unit, and no rate
NOT_MEASURED = "not measured"


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
        unit: that n counts.
    """

    claim: str
    word: str
    evidence: str
    n: int
    p: float | None = None
    main: bool = False
    unit: str = SEED


class Between(NamedTuple):
    """A number that is known to lie between two ends; both are the number itself where it was measured."""

    low: float
    high: float


def judged(value: PlainEstimate, bound: float, *, below: bool = True) -> str:
    """Whether a number lies below (or above) its bound."""
    mean = value["mean"]
    if "low" not in value:
        return ONE_VALUE if value["n"] > 1 else ONE_RUN[HOLDS if (mean <= bound) == below else FAILS]
    low, high = value["low"], value["high"]
    if (high <= bound) if below else (low >= bound):
        return HOLDS
    return FAILS if ((low >= bound) if below else (high <= bound)) else OPEN


def p_value(value: PlainEstimate, bound: float) -> float | None:
    """Two-sided p-value of `mean = bound`, from the same distributions as the 95 % interval; None without an interval.

    An interval excludes the bound where this is under 0.05. That of a rate is the wider one of two, so its p-value is
    the larger one of two.
    """
    from scipy import stats  # which takes a second to load

    if "low" not in value:
        return None
    distance, error = abs(value["mean"] - bound), value["std"] / np.sqrt(value["n"])
    p = float(2.0 * stats.t.sf(distance / error, value["n"] - 1)) if error > 0.0 else 0.0
    return max(p, _p_of_episodes(value, bound)) if "episodes" in value else p


def _p_of_episodes(value: PlainEstimate, bound: float) -> float:
    """The same of all episodes together: exact for a rate, for a difference see `statistics.difference_of_rates`."""
    from scipy import stats  # which takes a second to load

    episodes = value["episodes"]
    if "other" in value:
        centre, error = statistics.shifted_difference(value["mean"] + value["other"], value["other"], episodes)
        return float(2.0 * stats.norm.sf(abs(centre - bound) / error))
    successes = round(value["mean"] * episodes)
    tails = stats.binom.cdf(successes, episodes, bound), stats.binom.sf(successes - 1, episodes, bound)
    return float(min(1.0, 2.0 * min(tails)))


def more_units(value: PlainEstimate, bound: float) -> str:
    """How many units would decide, for the evidence of a number whose Student's interval spans its bound.

    It is empty where there is no such interval, and where more units would not be what is missing.
    """
    if not value.get("std") or "low" not in value or not value["low"] < bound < value["high"]:
        return ""
    needed = statistics.units_needed(value["std"], abs(value["mean"] - bound), LIMIT)
    if needed is not None and needed <= value["n"]:
        return ""
    words = f"not even {LIMIT}" if needed is None else str(needed)
    return f"; with this mean and spread {words} {value.get('unit', SEED)}s would decide"


def finding(
    claim: str, value: PlainEstimate, bound: float, evidence: str, *, below: bool = True, main: bool = False
) -> Finding:
    """A claim that a number lies below (or above) a bound."""
    word, evidence = judged(value, bound, below=below), evidence + more_units(value, bound)
    return Finding(claim, word, evidence, value["n"], p_value(value, bound), main, value.get("unit", SEED))


def finding_between(
    claim: str, values: Mapping[str, Between], bound: float, evidence: str, *, below: bool = True, main: bool = False
) -> Finding:
    """The same of numbers, one a repeat, of which some were not measured but only bounded.

    The claim holds where it does with every number at its end nearest to the bound's wrong side, and does not hold
    where it fails with every number at the other end. An infinite end decides nothing.
    """
    lows = {repeat: low for repeat, (low, _) in values.items()}
    highs = {repeat: high for repeat, (_, high) in values.items()}
    if lows == highs:
        return finding(claim, over_repeats(lows), bound, evidence, below=below, main=main)
    cautious, generous = (highs, lows) if below else (lows, highs)
    for ends, word in ((cautious, HOLDS), (generous, FAILS)):
        if _finite(ends):
            found = finding(claim, over_repeats(ends), bound, evidence, below=below, main=main)
            if found.word in (word, ONE_RUN[word]):
                return found
    nothing = over_repeats(dict.fromkeys(values, 0.0))
    units = nothing["n"]
    tested = units > 1 and (_finite(lows) or _finite(highs))
    return Finding(claim, OPEN, evidence, units, 1.0 if tested else None, main, nothing["unit"])


def _finite(ends: Mapping[str, float]) -> bool:
    return bool(np.isfinite(list(ends.values())).all())


def corrected(findings: Iterable[Finding], bases: int = 1) -> list[Finding]:
    """The findings of a study with the words that remain after Holm's correction, in each of the two families.

    Args:
        findings: of the study.
        bases: that it has. With several, what the seeds of one of them say is no word on the others.
    """
    findings = [
        _of_one_base(found) if bases > 1 and found.unit == SEED and found.n > 1 else found for found in findings
    ]
    undecided = {id(found) for main in (True, False) for found in _undecided([f for f in findings if f.main == main])}
    return [dataclasses.replace(found, word=OPEN) if id(found) in undecided else found for found in findings]


def _of_one_base(found: Finding) -> Finding:
    return dataclasses.replace(found, word=ONE_BASE.get(found.word, found.word), p=None)


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

    Without a main finding it is not measured.

    Args:
        claim: the paper's, in one sentence.
        findings: of the study, corrected.
    """
    main = [found for found in findings if found.main]
    if not main:
        return Finding(claim, NOT_MEASURED, "", 0)
    words = {found.word for found in main}
    word = FAILS if FAILS in words else words.pop() if len(words) == 1 else OPEN
    return Finding(claim, word, "; ".join(found.evidence for found in main), min(found.n for found in main))


def findings_table(findings: Iterable[Finding]) -> str:
    """The findings of a study, the main ones first, in Markdown."""
    rows = [
        [found.claim, f"**{found.word}**", found.evidence, units({"n": found.n, "unit": found.unit})]
        for found in sorted(findings, key=lambda found: not found.main)
    ]
    return markdown_table(["claim", "here", "number", "n"], rows)
