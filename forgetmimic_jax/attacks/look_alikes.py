"""Kept segments that look like a target, and others as hard that do not: is what was lost near the target alone?

Retention is from the tracking at every step of rollouts that were made anyway.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from forgetmimic_jax.attacks.case import TRAINED, Case
from forgetmimic_jax.attacks.document import LookAlike, LookAlikes
from forgetmimic_jax.attacks.warping import Segment, distances
from forgetmimic_jax.evaluation import statistics
from forgetmimic_jax.evaluation.document import Estimate
from forgetmimic_jax.evaluation.metrics import BASE, Rollout

NEAREST = 8  # segments compared
OF_A_CLIP = 2  # of them, at most: the cycles of a walk are all alike
FEWEST_EPISODES = 2  # that pass a segment


@dataclass(frozen=True)
class SegmentPair:
    """A kept segment near a target, and one far from it that is as hard for the base."""

    near: Segment
    far: Segment
    near_distance: float  # rad
    far_distance: float  # rad


def matched(
    distance: Mapping[Segment, float], difficulty: Mapping[Segment, float], count: int = NEAREST
) -> list[SegmentPair]:
    """The nearest segments, each with a far one of nearly the same difficulty; no segment is used twice.

    Of a clip at most `OF_A_CLIP` segments are near ones.

    Args:
        distance: of every kept segment to the targets, rad.
        difficulty: the base's tracking per step on it; only segments that have one count.
        count: pairs at most.
    """
    order = sorted((segment for segment in distance if segment in difficulty), key=lambda of: distance[of])
    places = [[other.clip for other in order[: place + 1]].count(of.clip) for place, of in enumerate(order)]
    eligible = [segment for segment, place in zip(order, places, strict=True) if place <= OF_A_CLIP]
    near = eligible[: min(count, len(order) // 2)]
    rest = [segment for segment in order if segment not in near]
    far = rest[min(len(rest) // 2, len(rest) - len(near)) :]  # the farther half
    pairs = []
    for segment in near:
        match = min(far, key=lambda of: abs(difficulty[of] - difficulty[segment]))
        far.remove(match)
        pairs.append(SegmentPair(segment, match, distance[segment], distance[match]))
    return pairs


def tracking_in(rollouts: Mapping[str, Rollout], names: Sequence[str], segment: Segment) -> dict[str, float]:
    """Each policy's mean tracking per step in a segment, 0 after an episode's end.

    Only episodes count in which every policy is still there when the segment begins. Too few of them: empty.

    Args:
        rollouts: of the policies that are compared, on the same episodes.
        names: of the clips that `Rollout.clip` indexes.
        segment: frames of one of them.
    """
    first = next(iter(rollouts.values()))
    # The step t of an episode tracks the frame start + t + 1.
    begin = np.maximum(segment.first - first.start_frame - 1, 0)
    end = np.minimum(segment.end - first.start_frame - 1, first.horizon)
    there = (first.clip == names.index(segment.clip)) & (end > begin) & (first.start_frame < segment.end - 1)
    for rollout in rollouts.values():
        there &= rollout.length > begin
    if there.sum() < FEWEST_EPISODES:
        return {}
    steps = np.arange(first.tracking_reward.shape[1])
    inside = (steps >= begin[:, None]) & (steps < end[:, None]) & there[:, None]
    return {
        name: float(
            np.where(inside & (steps < rollout.length[:, None]), rollout.tracking_reward, 0.0).sum() / inside.sum()
        )
        for name, rollout in rollouts.items()
    }


def retention(
    pairs: Sequence[SegmentPair], tracking: Mapping[Segment, Mapping[str, float]], policies: Sequence[str]
) -> LookAlikes:
    """Retention of the base's tracking near the targets and far from them, with intervals over the segments.

    Args:
        pairs: of segments.
        tracking: per step on each of them, by policy.
        policies: whose retention it is.
    """

    def kept(policy: str, segment: Segment) -> float:
        return tracking[segment][policy] / tracking[segment][BASE]

    def over(values: Iterable[float]) -> Estimate:
        return msgspec.convert(statistics.over_seeds(list(values)), Estimate)

    found = [
        LookAlike(
            near=str(pair.near),
            far=str(pair.far),
            distances=(pair.near_distance, pair.far_distance),
            retention={policy: (kept(policy, pair.near), kept(policy, pair.far)) for policy in policies},
        )
        for pair in pairs
    ]
    return LookAlikes(
        pairs=found,
        near={policy: over(one.retention[policy][0] for one in found) for policy in policies if found},
        far={policy: over(one.retention[policy][1] for one in found) for policy in policies if found},
        difference={
            policy: over(one.retention[policy][0] - one.retention[policy][1] for one in found)
            for policy in policies
            if found
        },
    )


def attack(case: Case) -> LookAlikes:
    """Retention on the kept segments nearest to the targets and on far ones, by every policy."""
    performance, names = case.on_library, tuple(case.clips)
    policies = [policy for policy in TRAINED if policy in case.policies]
    rollouts = {policy: performance.rollout(policy) for policy in policies}
    distance = distances(case.chosen(case.kept), case.chosen(case.targets))
    tracking = {segment: tracking_in(rollouts, names, segment) for segment in distance}
    difficulty = {segment: of[BASE] for segment, of in tracking.items() if of and of[BASE] > 0.0}
    return retention(matched(distance, difficulty), tracking, policies)
