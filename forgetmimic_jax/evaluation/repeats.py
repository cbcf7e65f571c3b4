"""Repeats of a run, from several bases and with several seeds, and the mean over them.

A base is a whole training, and runs from one base are alike. So with several bases the unit of an interval is the base,
whose number is the mean over its seeds (a two-level mean). With one base the unit is the seed, and the interval says
nothing of other bases.

A spread of 0 is no certainty. The interval of a rate, or of a difference of two rates, is therefore never narrower than
that of all its episodes together. Any other number that is the same in all units has no interval.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from forgetmimic_jax.evaluation import statistics
from forgetmimic_jax.evaluation.statistics import PlainEstimate

BASE, SEED = "base", "seed"  # units
ROUNDING = 1e-9  # a spread of so little, or of so small a share of the mean, is none: a study's JSON has nine digits


class Repeat(NamedTuple):
    """One of the runs that differ only in base and seed; a study's JSON names it by its text."""

    base: int  # its place among the study's bases
    seed: int

    def __str__(self) -> str:
        return f"base {self.base}, seed {self.seed}"


def base_of(repeat: str) -> int:
    """The base of a repeat that is given by its text."""
    return int(repeat.partition(",")[0].removeprefix("base "))


def over_repeats(values: Mapping[str, float]) -> PlainEstimate:
    """Mean of numbers by repeat, with Student's interval over the bases, or over the seeds where there is one base.

    A base's number is the mean over its seeds, so that bases weigh the same whatever their number of runs. The
    estimate's n counts the units, and `unit` names them. Without spread there is no interval.
    """
    of_base: dict[int, list[float]] = {}
    for repeat, value in values.items():
        of_base.setdefault(base_of(repeat), []).append(value)
    means = [float(np.mean(of)) for of in of_base.values()]
    found = statistics.over_seeds(means if len(of_base) > 1 else list(values.values()))
    found["unit"] = BASE if len(of_base) > 1 else SEED
    if found.get("std", 1.0) <= ROUNDING * max(1.0, abs(found["mean"])):
        found.pop("low", None)
        found.pop("high", None)
    return found


def rate_over_repeats(values: Mapping[str, float], episodes: Mapping[str, int]) -> PlainEstimate:
    """`over_repeats` of a rate, with an interval that is at least as wide as the exact one of all episodes together.

    Args:
        values: share of the episodes, by repeat.
        episodes: how many they are, by repeat; where some are not known, the spread alone counts.
    """
    found, total = over_repeats(values), _total(values, episodes)
    if found["n"] == 1 or total is None:
        return found
    return _at_least(found, statistics.rate(round(found["mean"] * total), total), episodes=total)


def difference_over_repeats(pairs: Mapping[str, tuple[float, float]], episodes: Mapping[str, int]) -> PlainEstimate:
    """The same of one rate minus another, each over so many episodes; see `statistics.difference_of_rates`.

    Args:
        pairs: both shares, by repeat.
        episodes: of either, by repeat.
    """
    found = over_repeats({repeat: one - other for repeat, (one, other) in pairs.items()})
    total = _total(pairs, episodes)
    if found["n"] == 1 or total is None:
        return found
    other = over_repeats({repeat: other for repeat, (_, other) in pairs.items()})["mean"]
    pooled = statistics.difference_of_rates(found["mean"] + other, other, total)
    return {**_at_least(found, pooled, episodes=total), "other": other}


def units(estimate: Mapping[str, Any]) -> str:
    """What the n of an estimate counts, such as "3 bases"; one unit is just "1"."""
    n = estimate["n"]
    return f"{n} {estimate['unit']}s" if n > 1 and "unit" in estimate else str(n)


def _total(repeats: Iterable[str], episodes: Mapping[str, int]) -> int | None:
    known = [episodes.get(repeat) for repeat in repeats]
    return None if None in known else sum(n for n in known if n is not None)


def _at_least(found: PlainEstimate, pooled: PlainEstimate, *, episodes: int) -> PlainEstimate:
    """An estimate over units, its interval widened to that of all episodes together."""
    low, high = found.get("low", found["mean"]), found.get("high", found["mean"])
    return {**found, "low": min(low, pooled["low"]), "high": max(high, pooled["high"]), "episodes": episodes}
