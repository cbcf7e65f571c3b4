from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from forgetmimic_jax.settings.config import SamplingConfig
from forgetmimic_jax.tracking.rsi import (
    Bins,
    bin_probabilities,
    episode_failure,
    make_bins,
    sample_start,
    update_failure_level,
)

RULES = ["adaptive", "uniform_clips", "uniform_bins", "frozen"]
DRAWS = 40_000


def bins_of(lengths: list[int], width: int) -> Bins:
    return make_bins(SimpleNamespace(length=jnp.asarray(lengths)), bin_seconds=0.02 * width, control_step=0.02)


def spans(bins: Bins, clip: int) -> list[tuple[int, int]]:
    valid = np.asarray(bins.valid[clip])
    return list(zip(np.asarray(bins.start)[clip][valid], np.asarray(bins.end)[clip][valid], strict=True))


def test_the_papers_bin_of_four_seconds_is_200_frames():
    assert spans(bins_of([601], 200), 0) == [(0, 200), (200, 400), (400, 600)]


def test_a_rest_of_at_least_half_a_width_is_a_bin():
    assert spans(bins_of([8 + 1], 5), 0) == [(0, 5), (5, 8)]  # 3 of 5
    assert spans(bins_of([6 + 1], 4), 0) == [(0, 4), (4, 6)]  # exactly half


def test_a_shorter_rest_joins_the_last_bin():
    assert spans(bins_of([7 + 1], 5), 0) == [(0, 7)]  # 2 of 5


def test_every_clip_has_a_bin_however_short():
    assert spans(bins_of([2, 101], 50), 0) == [(0, 1)]


def test_every_start_frame_but_the_last_lies_in_exactly_one_bin():
    lengths = np.random.default_rng(0).integers(2, 400, 50)
    bins = bins_of(lengths.tolist(), 37)
    for clip, length in enumerate(lengths):
        frames = [frame for start, end in spans(bins, clip) for frame in range(start, end)]
        assert sorted(frames) == list(range(length - 1))


@pytest.mark.parametrize("rule", RULES)
def test_probabilities_sum_to_one_and_are_zero_where_no_bin_is(rule):
    bins = bins_of([31, 72, 5], 10)
    level = jax.random.uniform(jax.random.PRNGKey(0), bins.valid.shape)
    probabilities = np.asarray(bin_probabilities(SamplingConfig(rule=rule), bins, level))
    assert probabilities.sum() == pytest.approx(1.0, abs=1e-6)
    assert (probabilities[~np.asarray(bins.valid)] == 0.0).all()
    assert (probabilities[np.asarray(bins.valid)] > 0.0).all()


@pytest.mark.parametrize("rule", ["adaptive", "frozen"])
def test_adaptive_probabilities_by_hand(rule):
    bins = bins_of([11, 21], 10)  # one bin and two: N_valid = 3, so exp(L/τ) = 4^L
    level = jnp.array([[0.5, 0.9], [0.0, 1.0]])  # the 0.9 belongs to no bin
    expected = 0.85 * np.array([[2.0, 0.0], [1.0, 4.0]]) / 7.0 + 0.15 / 3.0 * np.array([[1, 0], [1, 1]])
    np.testing.assert_allclose(bin_probabilities(SamplingConfig(rule=rule), bins, level), expected, rtol=1e-5)


def test_a_prior_over_clips_does_not_favour_the_clip_of_many_bins():
    config = SamplingConfig(prior="clips", uniform_ratio=0.2)
    level = jnp.array([[0.5, 0.9], [0.0, 1.0]])  # as above: 4^L times the prior (1/2 and 1/4, 1/4)
    expected = 0.8 * np.array([[1.0, 0.0], [0.25, 1.0]]) / 2.25 + 0.2 * np.array([[0.5, 0], [0.25, 0.25]])
    np.testing.assert_allclose(bin_probabilities(config, bins_of([11, 21], 10), level), expected, rtol=1e-5)


@pytest.mark.parametrize("rule", RULES)
def test_the_targets_get_their_share_and_each_side_keeps_the_rules_proportions(rule):
    bins = bins_of([11, 21, 16], 10)
    level = jnp.array([[0.5, 0.9], [0.0, 1.0], [0.3, 0.6]])
    is_target = jnp.array([True, False, True])
    plain = np.asarray(bin_probabilities(SamplingConfig(rule=rule), bins, level, is_target))
    shared = np.asarray(bin_probabilities(SamplingConfig(rule=rule, target_share=0.7), bins, level, is_target))
    assert shared[[0, 2]].sum() == pytest.approx(0.7)
    assert shared[1].sum() == pytest.approx(0.3)
    np.testing.assert_allclose(shared[[0, 2]], 0.7 * plain[[0, 2]] / plain[[0, 2]].sum(), rtol=1e-5)
    np.testing.assert_allclose(shared[1], 0.3 * plain[1] / plain[1].sum(), rtol=1e-5)


@pytest.mark.parametrize("rule", RULES)
def test_with_given_starts_the_rule_decides_among_a_clips_bins_alone(rule):
    bins = bins_of([11, 21, 16], 10)
    level = jnp.array([[0.5, 0.9], [0.0, 1.0], [0.3, 0.6]])
    plain = np.asarray(bin_probabilities(SamplingConfig(rule=rule), bins, level))
    given = np.asarray(bin_probabilities(SamplingConfig(rule=rule), bins, level, starts=jnp.array([0.5, 0.0, 0.5])))
    np.testing.assert_allclose(given.sum(-1), [0.5, 0.0, 0.5], rtol=1e-6)
    np.testing.assert_allclose(given[[0, 2]], 0.5 * plain[[0, 2]] / plain[[0, 2]].sum(-1, keepdims=True), rtol=1e-5)


def test_uniform_bins_gives_every_bin_the_same():
    bins = bins_of([11, 21], 10)
    expected = np.array([[1, 0], [1, 1]]) / 3.0
    np.testing.assert_allclose(
        bin_probabilities(SamplingConfig(rule="uniform_bins"), bins, jnp.ones((2, 2))), expected, rtol=1e-6
    )


def test_uniform_clips_gives_every_clip_the_same_and_every_frame_of_a_clip_the_same():
    lengths = [8, 25, 40]
    bins = bins_of(lengths, 10)
    config = SamplingConfig(rule="uniform_clips")
    probabilities = bin_probabilities(config, bins, jnp.ones(bins.valid.shape))
    np.testing.assert_allclose(probabilities.sum(-1), 1.0 / 3.0, rtol=1e-6)
    clip, _, frame = (np.asarray(x) for x in sample_start(config, jax.random.PRNGKey(1), probabilities, bins, DRAWS))
    assert stats.chisquare(np.bincount(clip, minlength=3)).pvalue > 1e-3
    for index, length in enumerate(lengths):
        counts = np.bincount(frame[clip == index], minlength=length - 1)
        assert len(counts) == length - 1  # the last frame is never a start
        assert stats.chisquare(counts).pvalue > 1e-3


def test_a_share_of_the_starts_is_at_the_first_frame_of_the_same_clips():
    bins = bins_of([31, 72, 5], 10)
    probabilities = bin_probabilities(SamplingConfig(), bins, jnp.ones(bins.valid.shape))
    plain, moved = (
        [np.asarray(x) for x in sample_start(config, jax.random.PRNGKey(3), probabilities, bins, DRAWS)]
        for config in (SamplingConfig(), SamplingConfig(first_frame=0.3))
    )
    np.testing.assert_array_equal(moved[0], plain[0])
    first = (moved[1] == 0) & (moved[2] == 0)
    np.testing.assert_array_equal(moved[1][~first], plain[1][~first])
    np.testing.assert_array_equal(moved[2][~first], plain[2][~first])
    others = plain[2] > 0
    assert stats.binomtest(int(first[others].sum()), int(others.sum()), 0.3).pvalue > 1e-3


def test_starts_follow_the_probabilities_and_lie_in_their_bin():
    bins = bins_of([31, 72, 5], 10)
    level = jax.random.uniform(jax.random.PRNGKey(2), bins.valid.shape)
    config = SamplingConfig()
    probabilities = bin_probabilities(config, bins, level)
    clip, index, frame = (
        np.asarray(x) for x in sample_start(config, jax.random.PRNGKey(3), probabilities, bins, DRAWS)
    )
    counts = np.zeros(bins.valid.shape)
    np.add.at(counts, (clip, index), 1)
    valid = np.asarray(bins.valid)
    assert counts[~valid].sum() == 0
    expected = np.asarray(probabilities, np.float64)[valid]
    assert stats.chisquare(counts[valid], DRAWS * expected / expected.sum()).pvalue > 1e-3
    assert (frame >= np.asarray(bins.start)[clip, index]).all()
    assert (frame < np.asarray(bins.end)[clip, index]).all()


def test_a_better_tracked_bin_is_drawn_less():
    bins = bins_of([11, 11], 10)
    before = bin_probabilities(SamplingConfig(), bins, jnp.array([[0.5], [0.5]]))
    after = bin_probabilities(SamplingConfig(), bins, jnp.array([[0.2], [0.5]]))
    assert after[0, 0] < before[0, 0] < after[1, 0]


def test_an_early_death_is_a_failure_although_it_tracked_well_while_alive():
    episode = dict(tracking_sum=jnp.array(9.0), steps=jnp.array(10), horizon=jnp.array(100))
    assert float(episode_failure(SamplingConfig(), **episode)) == pytest.approx(0.91)
    literal = SamplingConfig(failure_signal="alive_mean")
    assert float(episode_failure(literal, **episode)) == pytest.approx(0.1)


def test_both_failure_signals_agree_on_an_episode_that_lived_to_its_end():
    episode = dict(tracking_sum=jnp.array(60.0), steps=jnp.array(80), horizon=jnp.array(80))
    for signal in ("survival_weighted", "alive_mean"):
        assert float(episode_failure(SamplingConfig(failure_signal=signal), **episode)) == pytest.approx(0.25)


def one_update(level, ended: list[tuple[int, int, float]], config=SamplingConfig()):  # noqa: B008 (frozen)
    clip, index, failure = (jnp.asarray(column) for column in zip(*ended, strict=True))
    return update_failure_level(config, level, jnp.ones(len(ended), bool), failure.astype(jnp.float32), clip, index)


def test_one_episode_moves_its_bin_by_alpha():
    level = one_update(jnp.full((2, 3), 0.5), [(1, 2, 1.0)])
    expected = np.full((2, 3), 0.5)
    expected[1, 2] = 0.995 * 0.5 + 0.005 * 1.0
    np.testing.assert_allclose(level, expected, rtol=1e-6)


@pytest.mark.parametrize("count", [1, 3, 17, 400])
def test_a_batch_of_episodes_equals_the_same_episodes_one_after_another(count):
    mean_failure, level = 0.3, 0.8
    for _ in range(count):
        level = (1.0 - 0.005) * level + 0.005 * mean_failure
    batch = one_update(jnp.full((1, 1), 0.8), [(0, 0, mean_failure)] * count)
    np.testing.assert_allclose(batch[0, 0], level, rtol=1e-4)


def test_a_batch_takes_the_mean_failure_of_its_episodes():
    level = one_update(jnp.full((1, 1), 0.6), [(0, 0, 0.0), (0, 0, 0.5), (0, 0, 1.0)])
    keep = 0.995**3
    np.testing.assert_allclose(level[0, 0], keep * 0.6 + (1 - keep) * 0.5, rtol=1e-6)


def test_episodes_that_still_run_teach_nothing():
    done = jnp.array([[False, True], [False, False]])
    failure = jnp.array([[1.0, 0.0], [1.0, 1.0]])
    clip, index = jnp.array([[0, 1], [0, 1]]), jnp.zeros((2, 2), jnp.int32)
    level = update_failure_level(SamplingConfig(smoothing=0.5), jnp.full((2, 1), 0.4), done, failure, clip, index)
    np.testing.assert_allclose(level, [[0.4], [0.2]], rtol=1e-6)


def test_the_frozen_sampler_does_not_learn():
    level = jnp.full((1, 1), 0.4)
    assert one_update(level, [(0, 0, 1.0)], SamplingConfig(rule="frozen"))[0, 0] == level[0, 0]


@pytest.mark.parametrize("rule", RULES)
def test_a_clip_without_a_valid_bin_is_never_started(rule):
    bins = Bins(
        start=jnp.array([[0, 10], [0, 10]]),
        end=jnp.array([[10, 20], [10, 20]]),
        valid=jnp.array([[True, True], [False, False]]),
    )
    probabilities = bin_probabilities(SamplingConfig(rule=rule), bins, jnp.full((2, 2), 0.5))
    np.testing.assert_allclose(probabilities, [[0.5, 0.5], [0.0, 0.0]], atol=1e-6)
