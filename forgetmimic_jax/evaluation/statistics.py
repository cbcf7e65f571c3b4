"""95 % intervals: bootstrap over episodes stratified by clip, exact for rates, Student's t over seeds.

An interval over episodes says how well these clips were measured with this one checkpoint. What another training run
would give is a question to several seeds, and then the seed is the unit (`over_seeds`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypedDict

import numpy as np

CONFIDENCE = 0.95
RESAMPLES = 2000


class PlainEstimate(TypedDict, total=False):
    """An `evaluation.document.Estimate` as a plain dict, as a JSON file holds it: what is undefined is absent.

    `std` is the standard deviation over the n units; for a ratio, which no single unit has, that of the bootstrap.
    `unit` says what the n units are, a base or a seed (`evaluation.repeats`). `episodes` is there for a rate, and for a
    difference of two: of all units together; for a difference `other` is the rate that was taken away.
    """

    mean: float
    low: float
    high: float
    std: float
    n: int
    unit: str
    episodes: int
    other: float


def estimate(mean: float, low: float, high: float, std: float, n: int) -> PlainEstimate:
    """An estimate of what is finite among its numbers."""
    numbers = {"mean": mean, "low": low, "high": high, "std": std}
    finite = {name: float(number) for name, number in numbers.items() if np.isfinite(number)}
    return PlainEstimate(**finite, n=int(n))  # type: ignore[typeddict-item]


def resampling_weights(strata: np.ndarray, *, seed: int, resamples: int = RESAMPLES) -> np.ndarray:
    """Weights f32[resample, E] of each episode in bootstrap samples that keep every stratum's share.

    A stratum of n episodes is resampled n - 1 at a time and rescaled (Rao and Wu 1988), which makes the variance of its
    mean s^2/n: plain resampling of n is too narrow by (n - 1)/n, a half at two episodes a clip. A stratum of one
    episode has no spread to learn from: its weights are NaN, and so is every interval it enters.

    The same strata and seed give the same weights, so that policies run on the same episodes are compared in pairs.
    """
    random = np.random.default_rng(seed)
    weights = np.empty((resamples, len(strata)), np.float32)
    for stratum in np.unique(strata):
        members = np.flatnonzero(strata == stratum)
        n = len(members)
        if n > 1:
            weights[:, members] = random.multinomial(n - 1, np.full(n, 1.0 / n), size=resamples) * (n / (n - 1.0))
        else:
            weights[:, members] = np.nan
    return weights


def resampled_mean(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Means f[resample] of `values` f[E] under `weights` f[resample, E] of whole strata."""
    return weights @ values / len(values)


def bootstrap_mean(values: np.ndarray, weights: np.ndarray) -> PlainEstimate:
    """Mean over episodes with the percentile interval of its resampled means."""
    std = np.std(values, ddof=1) if len(values) > 1 else np.nan
    return estimate(np.mean(values), *_percentiles(resampled_mean(values, weights)), std, len(values))


def bootstrap_quantile(values: np.ndarray, weights: np.ndarray, share: float) -> PlainEstimate:
    """The least of `values` f[E] that at least `share` of them do not exceed, with its percentile interval.

    Args:
        values: one an episode.
        weights: f[resample, E] of whole strata.
        share: 0.5 is the median.
    """

    def quantile(of: np.ndarray) -> np.ndarray:
        total = np.cumsum(of[:, order], axis=1)
        reached = total >= share * total[:, -1:] - 1e-4  # the sums of float32 weights
        return values[order][reached.argmax(axis=1)]

    order = np.argsort(values)
    point = float(quantile(np.ones((1, len(values))))[0])
    if np.isnan(weights).any():
        return estimate(point, np.nan, np.nan, np.nan, len(values))
    resampled = quantile(weights)
    return estimate(point, *_percentiles(resampled), np.std(resampled), len(values))


def bootstrap_of_means(
    function: Callable[..., np.ndarray], *samples: tuple[np.ndarray, np.ndarray], n: int
) -> PlainEstimate:
    """A function of several means, each sample a pair (values, weights); weights drawn together keep samples paired."""
    point = float(function(*(np.mean(values) for values, _ in samples)))
    resampled = function(*(resampled_mean(values, weights) for values, weights in samples))
    return estimate(point, *_percentiles(resampled), np.std(resampled), n)


def rate(successes: int, n: int) -> PlainEstimate:
    """Share of successes with the exact (Clopper-Pearson) interval: 0 of 20 is 0 % with an upper bound of 17 %.

    Over clips of unequal difficulty the interval errs on the wide side.
    """
    from scipy import stats  # half a second, which a command's --help does not wait for

    interval = stats.binomtest(successes, n).proportion_ci(confidence_level=CONFIDENCE, method="exact")
    share = successes / n
    return estimate(share, interval.low, interval.high, np.sqrt(share * (1.0 - share)), n)


def shifted_difference(one: float, other: float, n: int) -> tuple[float, float]:
    """Centre and standard error of a difference of two rates of n episodes each, with one success and one failure more.

    The additions keep the error above 0 where a rate is 0 or 1 (Agresti and Caffo 2000, "Simple and effective
    confidence intervals for proportions and differences of proportions result from adding two successes and two
    failures").
    """
    shifted = [(rate_ * n + 1.0) / (n + 2.0) for rate_ in (one, other)]
    return shifted[0] - shifted[1], float(np.sqrt(sum(of * (1.0 - of) / (n + 2.0) for of in shifted)))


def difference_of_rates(one: float, other: float, n: int) -> PlainEstimate:
    """One rate minus another, each over n episodes, with the interval of Agresti and Caffo.

    Two policies on the same episodes are more alike than the interval takes them to be, so it errs on the wide side.
    """
    from scipy import stats  # half a second, which a command's --help does not wait for

    centre, error = shifted_difference(one, other, n)
    half = stats.norm.ppf(0.5 + CONFIDENCE / 2.0) * error
    return estimate(one - other, centre - half, centre + half, np.nan, n)


def units_needed(std: float, distance: float, limit: int = 100) -> int | None:
    """The least number n of units whose Student's interval would reach no further than `distance` from its mean.

    The interval's half width is t(0.975, n - 1) std / sqrt(n), with the standard deviation and the mean taken as they
    were observed. It falls as n grows, so the first n from 2 on is the answer; None where `limit` does not suffice.

    Args:
        std: over the units, as observed.
        distance: from the observed mean to the bound, in the unit of `std`.
        limit: the largest n that is tried.
    """
    from scipy import stats  # half a second, which a command's --help does not wait for

    n = np.arange(2, limit + 1)
    enough = stats.t.ppf(0.5 + CONFIDENCE / 2.0, n - 1) * std / np.sqrt(n) <= distance
    return int(n[enough.argmax()]) if enough.any() else None


def over_seeds(values: Sequence[float] | np.ndarray) -> PlainEstimate:
    """Mean over training seeds with Student's t interval; one seed has no interval."""
    from scipy import stats  # half a second, which a command's --help does not wait for

    values = np.asarray(values, dtype=np.float64)
    n, mean = len(values), float(np.mean(values))
    if n == 1:
        return estimate(mean, np.nan, np.nan, np.nan, n)
    std = float(np.std(values, ddof=1))
    half = stats.t.ppf(0.5 + CONFIDENCE / 2.0, n - 1) * std / np.sqrt(n)
    return estimate(mean, mean - half, mean + half, std, n)


def _percentiles(samples: np.ndarray) -> tuple[float, float]:
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(samples, [tail, 100.0 - tail])
    return float(low), float(high)
