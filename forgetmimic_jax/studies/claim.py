"""A claim of the paper as a number and a bound, and the word that a study's numbers give it.

A claim *holds* where the whole 95 % interval of its number over the seeds lies on the right side of the bound, *does
not hold* where the interval lies on the wrong side, and is *open* between. One seed has no interval.

A study states many claims, and of many intervals at 95 % each some miss by chance. The words of one study are
therefore corrected for their number by Holm's method: the chance that any of them is wrong is at most 5 %. Holm and not
Benjamini-Hochberg, because the claims of a study are about the same few runs, and Holm's bound needs nothing known
about how they depend on each other.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import stats

from forgetmimic_jax.evaluation import statistics
from forgetmimic_jax.evaluation.statistics import Estimate

HOLDS, FAILS, OPEN = "holds", "does not hold", "open"
ONE_SEED = {HOLDS: "one seed: yes", FAILS: "one seed: no"}


@dataclass(frozen=True)
class Finding:
    """What a study says of a claim.

    Args:
        claim: one sentence.
        word: `HOLDS`, `FAILS`, `OPEN`, or words of a study's own.
        evidence: the number and its bound.
        seeds: how many runs the number is over.
        p: two-sided p-value of the number against its bound; None where nothing was tested, as with one seed.
    """

    claim: str
    word: str
    evidence: str
    seeds: int
    p: float | None = None


class Between(NamedTuple):
    """A number that is known to lie between two ends; both are the number itself where it was measured."""

    low: float
    high: float


def judged(value: Estimate, bound: float, *, below: bool = True) -> str:
    """Whether a number lies below (or above) its bound."""
    mean = value["mean"]
    if "low" not in value:
        return ONE_SEED[HOLDS if (mean <= bound) == below else FAILS]
    low, high = value["low"], value["high"]
    if (high <= bound) if below else (low >= bound):
        return HOLDS
    return FAILS if ((low >= bound) if below else (high <= bound)) else OPEN


def p_value(value: Estimate, bound: float) -> float | None:
    """Two-sided p-value of `mean = bound`, from the same distribution as the 95 % interval; None for one seed.

    An interval excludes the bound where this is under 0.05.
    """
    if "low" not in value:
        return None
    if "episodes" in value:  # an exact interval of all episodes together, see `variants.over_seeds`
        episodes, successes = value["episodes"], round(value["mean"] * value["episodes"])
        tails = stats.binom.cdf(successes, episodes, bound), stats.binom.sf(successes - 1, episodes, bound)
        return float(min(1.0, 2.0 * min(tails)))
    distance, error = abs(value["mean"] - bound), value["std"] / np.sqrt(value["n"])
    if error == 0.0:
        return 1.0 if distance == 0.0 else 0.0
    return float(2.0 * stats.t.sf(distance / error, value["n"] - 1))


def finding(claim: str, value: Estimate, bound: float, evidence: str, *, below: bool = True) -> Finding:
    """A claim that a number lies below (or above) a bound."""
    return Finding(claim, judged(value, bound, below=below), evidence, value["n"], p_value(value, bound))


def finding_between(
    claim: str, values: Sequence[Between], bound: float, evidence: str, *, below: bool = True
) -> Finding:
    """The same of numbers, one a seed, of which some were not measured but only bounded.

    The claim holds where it does with every number at its end nearest to the bound's wrong side, and does not hold
    where it fails with every number at the other end. An infinite end decides nothing.
    """
    lows, highs = ([value[place] for value in values] for place in (0, 1))
    cautious, generous = (highs, lows) if below else (lows, highs)
    for ends, word in ((cautious, HOLDS), (generous, FAILS)):
        if np.isfinite(ends).all():
            found = finding(claim, statistics.over_seeds(ends), bound, evidence, below=below)
            if found.word in (word, ONE_SEED[word]):
                return found
    return Finding(claim, OPEN, evidence, len(values), None if len(values) == 1 else 1.0)


def corrected(findings: Iterable[Finding], level: float = 0.05) -> list[Finding]:
    """The findings of a study with the words that are left after Holm's correction (Holm 1979).

    The smallest of m p-values is compared with level / m, the next with level / (m - 1), and so on; from the first that
    is larger, all are open.
    """
    findings = list(findings)
    tested = sorted((p, place) for place, found in enumerate(findings) if (p := found.p) is not None)
    left = len(tested)
    while left and tested[-left][0] <= level / left:
        left -= 1
    undecided = {place for _, place in tested[len(tested) - left :]}
    return [
        dataclasses.replace(found, word=OPEN) if place in undecided else found for place, found in enumerate(findings)
    ]
