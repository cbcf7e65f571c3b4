"""Kept segments that look like a target, and others as hard that do not: is what was lost near the target alone?

Segments are of one second. How alike two of them are is the dynamic time warping of their joint angles. Retention is
from the tracking at every step of rollouts that were made anyway.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from forgetmimic_jax.evaluation.metrics import Rollout
from forgetmimic_jax.motion.clip import Clip

SECONDS = 1.0  # of a segment; the next one starts half of it later
NEAREST = 8  # segments compared
FEWEST_EPISODES = 2  # that pass a segment


@dataclass(frozen=True)
class Segment:
    """Frames first ≤ frame < end of a clip."""

    clip: str
    first: int
    end: int


@dataclass(frozen=True)
class Pair:
    """A kept segment near a target, and one far from it that is as hard for the base."""

    near: Segment
    far: Segment
    near_distance: float  # rad
    far_distance: float  # rad


def warped_distance(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Dynamic time warping of pairs of motions, rad [pair].

    The cost of two frames is the root mean square of their joint differences. A step in both motions counts twice, a
    step in one of them once, and the least sum of costs is divided by the two lengths' sum (Sakoe and Chiba 1978,
    symmetric form without a slope constraint): a mean cost.

    Args:
        one: [pair, frame, joint] rad.
        other: [pair, frame', joint] rad.
    """
    cost = np.sqrt(((one[:, :, None] - other[:, None]) ** 2).mean(axis=-1))
    pairs, rows, columns = cost.shape
    total = np.full((pairs, rows + 1, columns + 1), np.inf)
    total[:, 0, 0] = 0.0
    for row in range(rows):
        for column in range(columns):
            here = cost[:, row, column]
            before = np.minimum(total[:, row, column + 1], total[:, row + 1, column]) + here
            total[:, row + 1, column + 1] = np.minimum(before, total[:, row, column] + 2.0 * here)
    return total[:, -1, -1] / (rows + columns)


def segments(clip: Clip) -> list[Segment]:
    """The segments of a clip; of a clip shorter than one, the whole."""
    length = min(round(SECONDS * clip.fps), clip.num_frames)
    firsts = range(0, clip.num_frames - length + 1, max(1, length // 2))
    return [Segment(clip.name, first, first + length) for first in firsts]


def distances(kept: Sequence[Clip], targets: Sequence[Clip]) -> dict[Segment, float]:
    """Every kept segment's distance to the nearest segment of any target, rad."""
    theirs = [_joints(clip, segment, targets[0]) for clip in targets for segment in segments(clip)]
    found = {}
    for clip in kept:
        for segment in segments(clip):
            ours = _joints(clip, segment, targets[0])
            found[segment] = min(
                float(warped_distance(np.broadcast_to(ours, (len(alike), *ours.shape)), np.stack(alike)).min())
                for alike in _by_length(theirs)
            )
    return found


def matched(distance: Mapping[Segment, float], difficulty: Mapping[Segment, float], count: int = NEAREST) -> list[Pair]:
    """The nearest segments, each with a far one of nearly the same difficulty; no segment is used twice.

    Args:
        distance: of every kept segment to the targets, rad.
        difficulty: the base's tracking per step on it; only segments that have one count.
        count: pairs at most.
    """
    order = sorted((segment for segment in distance if segment in difficulty), key=lambda of: distance[of])
    near = order[: min(count, len(order) // 2)]
    rest = order[len(near) :]
    far = rest[min(len(rest) // 2, len(rest) - len(near)) :]  # the farther half
    pairs = []
    for segment in near:
        match = min(far, key=lambda of: abs(difficulty[of] - difficulty[segment]))
        far.remove(match)
        pairs.append(Pair(segment, match, distance[segment], distance[match]))
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


def _joints(clip: Clip, segment: Segment, like: Clip) -> np.ndarray:
    """Joint angles [frame, joint] of a segment, in the order of another clip's joints."""
    order = [clip.joint_names.index(joint) for joint in like.joint_names]
    return clip.joint_pos[segment.first : segment.end, order]


def _by_length(motions: Sequence[np.ndarray]) -> list[list[np.ndarray]]:
    """Motions [frame, joint] of equal lengths together."""
    lengths = dict.fromkeys(len(motion) for motion in motions)
    return [[motion for motion in motions if len(motion) == length] for length in lengths]
