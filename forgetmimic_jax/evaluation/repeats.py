"""Repeats of a run, from several bases and with several seeds, and the mean over them.

A base is a whole training, and runs from one base are alike. So with several bases the unit of an interval is the base,
whose number is the mean over its seeds (a two-level mean). With one base the unit is the seed, and the interval says
nothing of other bases.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from forgetmimic_jax.evaluation import statistics
from forgetmimic_jax.evaluation.statistics import PlainEstimate


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
    estimate's n counts the units.
    """
    of_base: dict[int, list[float]] = {}
    for repeat, value in values.items():
        of_base.setdefault(base_of(repeat), []).append(value)
    means = [float(np.mean(of)) for of in of_base.values()]
    return statistics.over_seeds(means if len(of_base) > 1 else list(values.values()))
