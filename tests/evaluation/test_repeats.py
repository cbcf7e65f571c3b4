"""The mean over repeats, against the arithmetic of its two levels."""

import numpy as np
import pytest
from scipy import stats

from forgetmimic_jax.evaluation.repeats import (
    Repeat,
    base_of,
    difference_over_repeats,
    over_repeats,
    rate_over_repeats,
    units,
)


def test_with_several_bases_the_interval_is_over_their_means():
    runs = {Repeat(0, 0): 0.1, Repeat(1, 0): 0.5, Repeat(2, 0): 0.6, Repeat(0, 1): 0.3, Repeat(2, 1): 0.8}
    found = over_repeats({str(repeat): value for repeat, value in runs.items()})
    means = [0.2, 0.5, 0.7]  # of two, one and two seeds
    low, high = stats.t.interval(0.95, 2, loc=np.mean(means), scale=stats.sem(means))
    assert (found["mean"], found["low"], found["high"], found["n"]) == pytest.approx((1.4 / 3, low, high, 3))


def test_with_one_base_the_interval_is_over_its_seeds():
    values = [0.2, 0.5, 0.35]
    found = over_repeats({str(Repeat(4, seed)): value for seed, value in enumerate(values)})
    low, high = stats.t.interval(0.95, 2, loc=np.mean(values), scale=stats.sem(values))
    assert (found["mean"], found["low"], found["high"], found["n"]) == pytest.approx((0.35, low, high, 3))


def test_one_run_has_no_interval():
    assert over_repeats({"base 0, seed 0": 0.5}) == {"mean": 0.5, "n": 1, "unit": "seed"}


def test_a_repeat_is_named_by_its_base_and_seed():
    assert str(Repeat(12, 3)) == "base 12, seed 3"
    assert base_of("base 12, seed 3") == 12


BASES = [str(Repeat(base, 0)) for base in range(3)]


def by_base(*values):
    return dict(zip(BASES, values, strict=True))


def test_numbers_that_are_all_the_same_have_no_interval():
    assert over_repeats(by_base(0.1 + 0.2, 0.3, 0.3)).keys() == {"mean", "std", "n", "unit"}
    assert over_repeats(by_base(0.31, 0.3, 0.3)).keys() == {"mean", "std", "low", "high", "n", "unit"}


def test_a_rates_interval_is_widened_to_that_of_all_its_episodes_and_never_narrowed():
    forty = dict.fromkeys(BASES, 40)
    none = rate_over_repeats(by_base(0.0, 0.0, 0.0), forty)
    # None of 120: the upper end x has (1 - x)^120 = 0.025, so x = 0.0303.
    assert (none["low"], none["high"], none["n"], none["episodes"]) == (0.0, pytest.approx(0.0303, abs=1e-4), 3, 120)
    spread = by_base(0.1, 0.5, 0.9)
    assert rate_over_repeats(spread, forty) == {**over_repeats(spread), "episodes": 120}
    # Hardly any spread: the episodes' interval is the wider one, 48 to 66 % for 69 of 120.
    close = rate_over_repeats(by_base(0.575, 0.575, 0.5751), forty)
    exact = stats.binomtest(69, 120).proportion_ci(method="exact")
    assert (close["low"], close["high"]) == pytest.approx((exact.low, exact.high))
    assert "low" not in rate_over_repeats({BASES[0]: 0.5}, forty)  # one base is one unit, whatever its episodes
    assert "low" not in rate_over_repeats(by_base(0.5, 0.5, 0.5), {BASES[0]: 40})


def test_a_difference_of_rates_has_the_interval_of_its_episodes_where_all_bases_agree():
    found = difference_over_repeats(by_base(*[(0.9, 0.8)] * 3), dict.fromkeys(BASES, 20))
    # 55 of 62 and 49 of 62: 0.0968 +- 1.96 sqrt(0.887 * 0.113 / 62 + 0.790 * 0.210 / 62)
    assert (found["mean"], found["n"]) == (pytest.approx(0.1), 3)
    assert (found["low"], found["high"]) == (pytest.approx(-0.0316, abs=1e-4), pytest.approx(0.2252, abs=1e-4))
    apart = by_base((0.9, 0.1), (0.5, 0.5), (0.1, 0.9))
    student = over_repeats(by_base(0.8, 0.0, -0.8))
    assert difference_over_repeats(apart, dict.fromkeys(BASES, 20))["low"] == student["low"]


def test_the_unit_is_named():
    assert units(over_repeats(by_base(1.0, 2.0, 3.0))) == "3 bases"
    assert units(over_repeats({str(Repeat(0, seed)): 0.1 * seed for seed in range(2)})) == "2 seeds"
    assert units(over_repeats({BASES[0]: 1.0})) == "1"
