"""How alike two motions are: dynamic time warping of the joint angles of segments of one second."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from forgetmimic_jax.motion.clip import Clip

SECONDS = 1.0  # of a segment; the next one starts half of it later


@dataclass(frozen=True)
class Segment:
    """Frames first ≤ frame < end of a clip."""

    clip: str
    first: int
    end: int

    def __str__(self) -> str:
        return f"{self.clip} {self.first} to {self.end - 1}"


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


def _joints(clip: Clip, segment: Segment, like: Clip) -> np.ndarray:
    """Joint angles [frame, joint] of a segment, in the order of another clip's joints."""
    order = [clip.joint_names.index(joint) for joint in like.joint_names]
    return clip.joint_pos[segment.first : segment.end, order]


def _by_length(motions: Sequence[np.ndarray]) -> list[list[np.ndarray]]:
    """Motions [frame, joint] of equal lengths together."""
    lengths = dict.fromkeys(len(motion) for motion in motions)
    return [[motion for motion in motions if len(motion) == length] for length in lengths]
