import numpy as np
import pytest
from scipy import stats

from forgetmimic_jax.evaluation import statistics


def test_no_success_in_twenty_still_allows_seventeen_percent():
    nothing = statistics.rate(0, 20)
    assert nothing["mean"] == 0.0
    assert nothing["low"] == 0.0
    # The exact upper bound solves (1 - p)^20 = 0.025.
    assert nothing["high"] == pytest.approx(1.0 - 0.025 ** (1 / 20))
    assert round(nothing["high"], 3) == 0.168


def test_rate_is_the_beta_quantile_form_of_clopper_pearson():
    some = statistics.rate(13, 20)
    assert some["low"] == pytest.approx(stats.beta.ppf(0.025, 13, 8))
    assert some["high"] == pytest.approx(stats.beta.ppf(0.975, 14, 7))
    assert some["std"] == pytest.approx(np.sqrt(0.65 * 0.35))
    assert some["n"] == 20


def test_every_resample_keeps_each_clips_share():
    strata = np.repeat([3, 7, 9], [2, 5, 20])
    weights = statistics.resampling_weights(strata, seed=1, resamples=50)
    for stratum, size in ((3, 2), (7, 5), (9, 20)):
        np.testing.assert_allclose(weights[:, strata == stratum].sum(axis=1), size, rtol=1e-6)


def test_resampled_variance_is_the_stratified_one_even_with_two_episodes_a_clip():
    random = np.random.default_rng(0)
    strata = np.repeat(np.arange(6), 2)
    values = random.normal(size=12) + 5.0 * strata  # the spread between clips must not enter
    weights = statistics.resampling_weights(strata, seed=2, resamples=40_000)
    within = [np.var(values[strata == stratum], ddof=1) for stratum in range(6)]
    expected = sum(2**2 * variance / 2 for variance in within) / 12**2  # sum over clips of (share)^2 s^2 / n
    assert np.var(statistics.resampled_mean(values, weights)) == pytest.approx(expected, rel=0.05)


def test_one_stratum_agrees_with_scipy():
    values = np.random.default_rng(3).exponential(size=400)
    ours = statistics.bootstrap_mean(values, statistics.resampling_weights(np.zeros(400), seed=0, resamples=10_000))
    theirs = stats.bootstrap((values,), np.mean, n_resamples=10_000, method="percentile", rng=0).confidence_interval
    assert ours["mean"] == pytest.approx(values.mean())
    assert ours["std"] == pytest.approx(values.std(ddof=1))
    assert ours["low"] == pytest.approx(theirs.low, abs=0.01)
    assert ours["high"] == pytest.approx(theirs.high, abs=0.01)


def test_interval_covers_the_true_mean_about_95_times_in_100():
    random = np.random.default_rng(4)
    strata = np.repeat(np.arange(3), 20)
    truth = np.array([0.0, 1.0, 5.0])
    covered = 0
    for trial in range(400):
        values = truth[strata] + random.normal(size=60)
        found = statistics.bootstrap_mean(values, statistics.resampling_weights(strata, seed=trial, resamples=500))
        covered += found["low"] <= truth.mean() <= found["high"]
    # Three standard errors of a 95 % rate over 400 trials are 3.3 %.
    assert covered / 400 == pytest.approx(0.95, abs=0.033)


def test_same_seed_same_interval_and_pairs_stay_paired():
    strata = np.repeat([0, 1], 10)
    weights = statistics.resampling_weights(strata, seed=5)
    np.testing.assert_array_equal(weights, statistics.resampling_weights(strata, seed=5))
    values = np.random.default_rng(5).uniform(1.0, 2.0, 20)
    twice = statistics.bootstrap_of_means(np.divide, (2.0 * values, weights), (values, weights), n=20)
    assert twice["low"] == pytest.approx(2.0, rel=1e-6)
    assert twice["high"] == pytest.approx(2.0, rel=1e-6)


def test_one_episode_a_clip_has_no_interval():
    alone = statistics.bootstrap_mean(np.array([0.4]), statistics.resampling_weights(np.array([0]), seed=0))
    assert alone == {"mean": 0.4, "n": 1}


def test_over_seeds_is_students_t():
    values = [0.71, 0.64, 0.80]
    found = statistics.over_seeds(values)
    # mean .71667, s .08021, t(2, .975) 4.30265: half width .19925
    assert found["mean"] == pytest.approx(0.716667, abs=1e-6)
    assert found["low"] == pytest.approx(0.517415, abs=1e-5)
    assert found["high"] == pytest.approx(0.915918, abs=1e-5)
    low, high = stats.t.interval(0.95, 2, loc=np.mean(values), scale=stats.sem(values))
    assert (found["low"], found["high"]) == pytest.approx((low, high))
    assert statistics.over_seeds([0.5]) == {"mean": 0.5, "n": 1}


@pytest.mark.parametrize(
    ("std", "distance", "needed"),
    [
        # t(0.975, n - 1) / sqrt(n): 2.484 with 3, 1.591 with 4, 1.049 with 6 and 0.925 with 7
        *((1.0, 2.0, 4), (1.0, 1.0, 7), (0.5, 0.5, 7), (0.0, 1.0, 2)),
        # 12.706 / sqrt(2) = 8.985
        *((1.0, 9.0, 2), (1.0, 8.9, 3)),
        # 1.984 / 10 = 0.1984 with 100
        *((1.0, 0.199, 100), (1.0, 0.198, None), (1.0, 0.0, None)),
    ],
)
def test_the_units_that_would_decide(std, distance, needed):
    assert statistics.units_needed(std, distance) == needed
