"""The mean over repeats, against the arithmetic of its two levels."""

import numpy as np
import pytest
from scipy import stats

from forgetmimic_jax.evaluation.repeats import Repeat, base_of, over_repeats


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
    assert over_repeats({"base 0, seed 0": 0.5}) == {"mean": 0.5, "n": 1}


def test_a_repeat_is_named_by_its_base_and_seed():
    assert str(Repeat(12, 3)) == "base 12, seed 3"
    assert base_of("base 12, seed 3") == 12
