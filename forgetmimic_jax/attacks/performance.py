"""What policies did in the same episodes, and their numbers: skill, motion content and success, with intervals.

Motion content is defined as in `evaluation.unbounded`, here also for a part of an episode. The simulation is another:
there the robot's shapes touch each other, so the numbers of a robot that fell differ a little.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np

from forgetmimic_jax.attacks.document import Compared, Numbers
from forgetmimic_jax.evaluation import metrics, statistics
from forgetmimic_jax.evaluation.document import Estimate
from forgetmimic_jax.evaluation.metrics import BASE, LOWEST_CONTENT, ZERO_ACTION, Rollout
from forgetmimic_jax.evaluation.unbounded import SMALLEST_MOVEMENT


@dataclass(frozen=True)
class Performance:
    """E episodes of several policies, of T steps at most."""

    names: tuple[str, ...]  # of the clips
    clip: np.ndarray  # i[E] index into names
    start_frame: np.ndarray  # i[E]
    horizon: np.ndarray  # i[E] steps
    length: Mapping[str, np.ndarray]  # by policy, i[E] steps before the first termination; the horizon: success
    tracking: Mapping[str, np.ndarray]  # by policy, f[E, T] normalised tracking reward; unread past `length`
    deviation: Mapping[str, np.ndarray] = field(default_factory=dict)  # by policy, f[E, T] m², from the reference
    movement: np.ndarray | None = None  # f[E, T] m², of the stand from the reference

    def of(self, clips: Sequence[str]) -> np.ndarray:
        """bool[E] the episodes of some clips."""
        return np.isin(self.clip, [self.names.index(name) for name in clips])

    def joined(self, other: Performance) -> Performance:
        """With the policies of another performance on the same episodes."""
        return dataclasses.replace(
            self,
            length={**self.length, **other.length},
            tracking={**self.tracking, **other.tracking},
            deviation={**self.deviation, **other.deviation},
        )

    def rollout(self, policy: str) -> Rollout:
        """One policy's episodes as the metrics take them."""
        return Rollout(self.clip, self.start_frame, self.horizon, self.length[policy], self.tracking[policy])

    def tracked(self, policy: str) -> np.ndarray:
        """f[E] survival-weighted tracking."""
        return metrics.sum_before(self.tracking[policy], self.length[policy]) / self.horizon

    def content(self, policy: str, window: tuple[np.ndarray, np.ndarray] | None = None) -> np.ndarray:
        """f[E] motion content; NaN where the reference hardly moves, or where it was not recorded.

        Args:
            policy: by name.
            window: i[E] and i[E], the first step and the step after the last; the whole episode by default.
        """
        if self.movement is None:
            return np.full(len(self.clip), np.nan)
        first, end = window or (np.zeros(len(self.clip), int), self.horizon)
        steps = np.arange(self.movement.shape[1])
        inside = (steps >= first[:, None]) & (steps < np.minimum(end, self.horizon)[:, None])
        count = np.maximum(inside.sum(axis=1), 1)
        movement = np.where(inside, self.movement, 0.0).sum(axis=1) / count
        deviation = np.where(inside, self.deviation[policy], 0.0).sum(axis=1) / count
        moves = movement >= SMALLEST_MOVEMENT**2
        return np.maximum(1.0 - deviation / np.where(moves, movement, np.nan), LOWEST_CONTENT)


def compare(
    performance: Performance,
    members: np.ndarray,
    *,
    against: Mapping[str, str],
    seed: int,
    window: tuple[np.ndarray, np.ndarray] | None = None,
    policies: Sequence[str] | None = None,
) -> Compared:
    """The numbers of policies over some episodes; intervals are over episodes, stratified by clip.

    Args:
        performance: with base and zero action.
        members: bool[E] the episodes.
        against: by policy, the one whose numbers are subtracted in `skill_above` and `content_above`.
        seed: of the bootstrap.
        window: as in `Performance.content`; skill is then left out, since it is of the whole episode.
        policies: all but the zero action by default.
    """
    weights = statistics.resampling_weights(performance.clip[members], seed=seed)
    tracked = {name: performance.tracked(name)[members] for name in performance.length}
    content = {name: performance.content(name, window)[members] for name in performance.length}
    reach = tracked[BASE].mean() - tracked[ZERO_ACTION].mean()
    skilled = window is None and reach >= metrics.MINIMUM_SKILL_RANGE

    def skill_of(function, *policies: str) -> Estimate | None:
        if not skilled:
            return None
        samples = [(tracked[name], weights) for name in policies]
        return _typed(statistics.bootstrap_of_means(function, *samples, n=int(members.sum())))

    found = {}
    for name in policies or [name for name in performance.length if name != ZERO_ACTION]:
        numbers = Numbers(skill=skill_of(metrics.skill, name, BASE, ZERO_ACTION), content=_mean(content[name], weights))
        if window is None:
            success = (performance.length[name] == performance.horizon)[members]
            numbers.success = _typed(statistics.rate(int(success.sum()), len(success)))
        if name in against:
            other = against[name]
            numbers.skill_above = skill_of(_difference, name, other, BASE, ZERO_ACTION)
            numbers.content_above = _mean(content[name] - content[other], weights)
        found[name] = numbers
    return found


def by_clip(performance: Performance, clips: Sequence[str], **given: Any) -> dict[str, Compared]:
    """`compare` for each clip alone, since a mean over targets can hide one that is still known."""
    return {name: compare(performance, performance.of([name]), **given) for name in clips}


def over_seeds(seeds: Sequence[Compared]) -> Compared:
    """The numbers of several trainings: of one, its own; of several, their means with the seed as the unit."""
    first, *others = seeds
    if not others:
        return first

    def together(policy: str, field: str) -> Estimate | None:
        values = [getattr(seed[policy], field) for seed in seeds]
        means = [value.mean for value in values if value is not None and value.mean is not None]
        return _typed(statistics.over_seeds(means)) if len(means) == len(seeds) else None

    return {
        policy: Numbers(**{field: together(policy, field) for field in Numbers.__struct_fields__}) for policy in first
    }


def not_followed(
    performance: Performance, original: Performance, names: Mapping[str, str], share: float
) -> dict[str, float]:
    """Where the base's tracking on a variant is below `share` of that on the original: variant → that ratio.

    Args:
        performance: on the variants.
        original: on the clips that they are of.
        names: by variant, its original.
        share: below which the base does not follow.
    """
    found = {}
    for variant, clip in names.items():
        own = original.tracked(BASE)[original.of([clip])].mean()
        ratio = float(performance.tracked(BASE)[performance.of([variant])].mean() / own) if own > 0.0 else 0.0
        if ratio < share:
            found[variant] = ratio
    return found


def _difference(policy: np.ndarray, other: np.ndarray, base: np.ndarray, zero: np.ndarray) -> np.ndarray:
    return metrics.ratio(np.asarray(policy) - other, np.asarray(base) - zero)


def _mean(values: np.ndarray, weights: np.ndarray) -> Estimate | None:
    """The mean over the episodes where a value is defined; None where it is nowhere."""
    defined = np.isfinite(values)
    if not defined.any():
        return None
    # Weights of the episodes that are left sum to their number only on average, so each sample is divided by its sum.
    chosen = weights[:, defined]
    total = np.maximum(chosen.sum(axis=1, keepdims=True), 1e-9)
    return _typed(statistics.bootstrap_mean(values[defined], chosen / total * defined.sum()))


def _typed(estimate: statistics.PlainEstimate) -> Estimate:
    return msgspec.convert(estimate, Estimate)
