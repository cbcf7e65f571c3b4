"""Whether numbers are a motion of the robot at all: limits, ground and support, against the other ways to read them.

A right reading stands on its feet; a wrong one slides, floats or breaks its joints. So a reading is refused where
another one is much better, and that one is named.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.contact import floor_points, floor_positions
from forgetmimic_jax.motion.converting import converted
from forgetmimic_jax.motion.kinematics import configuration
from forgetmimic_jax.motion.recording import Reading, Recording
from forgetmimic_jax.robot.model import Robot

PAIRS = 150  # pairs of frames that are looked at, spread over the clip
APART = 0.1  # s between the two of a pair: noise from frame to frame is no speed
SUPPORT = 0.03  # m above the lowest point: what carries the robot
GROUND = 0.05  # m above the usual lowest height: a frame that stands

# What counts as 1. Of 26 real clips (both shipped libraries, g1-moves, TWIST2, unitree_rl_lab) none reaches LIMIT or
# WANDER by a fifth, and the largest support speed is 0.15 m/s.
LIMIT = 0.15  # rad beyond the joints' ranges
LEVEL = 0.3  # m between the ground and the usual lowest height
WANDER = 0.1  # m that the lowest height varies by
SLIDE = 0.3  # m/s of the support that moves least
SCALE = 0.3  # share of its speed that a root may be too fast by: a human's path, not scaled to a robot of 1.3 m


@dataclasses.dataclass(frozen=True)
class Doubt:
    """What counts against a reading, as medians over frames."""

    limit: float  # rad, of the joint that is furthest beyond its range
    level: float  # m, height of the lowest point that a fifth of the frames lie under
    wander: float  # m, of the lowest point about its median
    slide: float  # m/s, horizontal, of the slowest point that carries the robot
    travel: float  # m/s, horizontal, of the root

    @property
    def size(self) -> float:
        """Small for a motion of the robot."""
        return self._of(self.slide)

    @property
    def size_at_scale(self) -> float:
        """The same where sliding is forgiven that a root's path too long for the robot brings about."""
        return self._of(max(self.slide - SCALE * self.travel, 0.0))

    def _of(self, slide: float) -> float:
        return self.limit / LIMIT + abs(self.level) / LEVEL + self.wander / WANDER + slide / SLIDE

    def __str__(self) -> str:
        return (
            f"joints {self.limit:.2f} rad beyond their limits, lowest point {self.level:.2f} m from the ground and "
            f"wandering by {self.wander:.2f} m, feet skate at {self.slide:.2f} m/s"
        )


# How large a doubt may be. On the 26 real clips the largest is 0.53 (a noisy retarget), the next 0.25. Read in a wrong
# order of joints or of the quaternion, with y up, in cm, mm or degrees, the same clips give 0.12 to 10^5; a standing,
# symmetric one gives the 0.12, every other 1.0 or more.
NOTICED = 0.04  # from here on other readings are tried
BETTER = 0.5  # of the doubt: on real clips no wrong reading has less than 1.1 times that of the right one
GOOD = 0.6  # the doubt about a reading that is worth naming
# No motion of this robot, whatever else it is. Wrong readings that no single flag mends have a `size_at_scale` of 1.8
# or more; the real clips made rough (30 Hz, joints noisy by 0.02 rad, the root by 1 cm, toes down by 0.25 rad, paths
# 1.15 times as long) 1.7 or less.
IMPOSSIBLE = 1.75
LARGEST_ANGLE = 7.0  # more is no angle in radians
LARGEST_PLACE = 10.0  # m: less is no position in cm

OTHERS: dict[str, tuple[str, ...]] = {
    "quaternion": ("xyzw", "wxyz"),
    "up": ("z", "y"),
    "unit": ("m", "cm", "mm"),
    "angles": ("radians", "degrees"),
    "joint_order": ("robot", "isaac"),
}


def doubt_of(robot: Robot, clip: Clip) -> Doubt:
    """What counts against a clip being a motion of the robot."""
    apart = min(max(1, round(APART * clip.fps)), clip.num_frames - 1)
    first = np.unique(np.linspace(0, clip.num_frames - 1 - apart, PAIRS).astype(int))
    qpos = configuration(clip, robot)
    points = floor_points(robot)
    now = floor_positions(robot, points, qpos[first])
    after = floor_positions(robot, points, qpos[first + apart])
    lowest = now[..., 2].min(axis=1)
    level = float(np.quantile(lowest, 0.2))
    speed = np.linalg.norm(after[..., :2] - now[..., :2], axis=-1) * clip.fps / apart
    carries = (now[..., 2] < lowest[:, None] + SUPPORT) & (after[..., 2] < after[..., 2].min(axis=1)[:, None] + SUPPORT)
    slowest = np.where(carries, speed, np.inf).min(axis=1)
    stands = (lowest < level + GROUND) & np.isfinite(slowest)
    return Doubt(
        limit=float(np.median(beyond_ranges(robot, qpos[first, 7:]))),
        level=level,
        wander=float(np.median(np.abs(lowest - np.median(lowest)))),
        slide=float(np.median(slowest[stands])) if stands.any() else np.inf,
        travel=float(np.median(np.linalg.norm(np.diff(clip.root_pos[:, :2], axis=0), axis=1))) * clip.fps,
    )


def beyond_ranges(robot: Robot, joint_pos: np.ndarray) -> np.ndarray:
    """[frame] rad, of the joint that is furthest beyond its range; 0 where every joint is inside."""
    return np.maximum(robot.beyond(joint_pos).max(axis=1), 0.0)


def check_plausible(robot: Robot, recording: Recording, reading: Reading, clip: Clip, path: Path) -> list[str]:
    """Notes on a reading.

    Raises:
        InputError: another reading is much better, or the reading is no motion of the robot.
    """
    here = doubt_of(robot, clip)
    if here.size < NOTICED:
        return []
    for candidates in (other_readings(recording, reading, 1), other_readings(recording, reading, 2)):
        tried = [(_doubt(robot, recording, other, clip.fps, path), flags) for other, flags in candidates]
        best, flags = min(tried, default=(np.inf, ""))
        if best < min(BETTER * here.size, GOOD):
            raise InputError(
                f"{path}: not {robot.name}'s motion as it is read ({here}); it looks like another reading: {flags}"
            )
        if here.size_at_scale < IMPOSSIBLE:
            break  # two changes at once explain only what is far off
    if here.size_at_scale > IMPOSSIBLE:
        raise InputError(
            f"{path}: not {robot.name}'s motion ({here}); another robot's joints, or another order of them? "
            "No other reading (--quaternion, --up, --unit, --angles, --joint-order) is better"
        )
    exchanged = dataclasses.replace(clip, joint_pos=clip.joint_pos[:, robot.counterpart])
    if doubt_of(robot, exchanged).size < BETTER * here.size:
        return [
            f"warning: left and right look swapped, and their signs are not: {here}; with the joints' sides exchanged "
            "it has less than half of that"
        ]
    return []


def other_readings(recording: Recording, reading: Reading, changes: int) -> Iterator[tuple[Reading, str]]:
    """Every reading that differs in some fields, and the flags that ask for it."""
    used: dict[str, Any] = {**vars(reading), "quaternion": reading.quaternion.replace("auto", recording.quaternion)}
    used["joint_order"] = used["joint_order"].replace("auto", "robot")
    fields = [field for field in OTHERS if field != "joint_order" or recording.joint_names is None]
    shrinks = {"cm", "mm"} if np.abs(recording.root_pos).max() < LARGEST_PLACE else set()
    shrinks |= {"degrees"} if np.abs(recording.joint_pos).max() < LARGEST_ANGLE else set()
    single = [
        (field, value) for field in fields for value in OTHERS[field] if value != used[field] and value not in shrinks
    ]
    for chosen in combinations(single, changes):
        change: dict[str, Any] = dict(chosen)
        if len(change) == changes:
            flags = " ".join(f"--{field.replace('_', '-')} {value}" for field, value in chosen)
            yield dataclasses.replace(reading, **change), flags


def _doubt(robot: Robot, recording: Recording, reading: Reading, rate: float, path: Path) -> float:
    """The size of the doubt about a reading; infinite where it is none."""
    try:
        return doubt_of(robot, converted(robot, recording, reading, rate, path)[0]).size
    except InputError:
        return np.inf
