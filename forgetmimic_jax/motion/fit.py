"""Fit a clip that was read to the robot and the library: the part wanted, the rate, the limits, the floor."""

from __future__ import annotations

import dataclasses

import numpy as np

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.contact import floor_points, floor_positions
from forgetmimic_jax.motion.kinematics import configuration, resample
from forgetmimic_jax.robot.model import Robot

MAX_SINK = 0.015  # m


def fit(robot: Robot, clip: Clip, fps: float, start: float = 0.0, end: float | None = None) -> Clip:
    """The clip from `start` to `end` in s, at `fps`, with its joints inside the robot's limits."""
    clip = resample(trimmed(clip, start, end), fps)
    return dataclasses.replace(clip, joint_pos=np.clip(clip.joint_pos, robot.joint_lower, robot.joint_upper))


def trimmed(clip: Clip, start: float, end: float | None) -> Clip:
    """The frames from `start` to `end` in s.

    Raises:
        InputError: fewer than two frames lie between.
    """
    last = (clip.num_frames - 1) / clip.fps
    end = last if end is None else end
    first, stop = int(np.ceil(start * clip.fps - 1e-6)), int(np.floor(end * clip.fps + 1e-6)) + 1
    if not 0 <= first < stop - 1 or stop > clip.num_frames:
        raise InputError(
            f"{clip.name}: --start {start:g} --end {end:g}: two frames or more between 0 and {last:.2f} s are needed"
        )
    kept = slice(first, stop)
    return dataclasses.replace(
        clip, root_pos=clip.root_pos[kept], root_quat=clip.root_quat[kept], joint_pos=clip.joint_pos[kept]
    )


def on_floor(robot: Robot, clip: Clip) -> tuple[Clip, float]:
    """The clip raised or lowered to stand on the floor, and by how much in m.

    The lowest fifth of the frames' lowest sole points decides, not the single lowest, which is often a recording's
    slip; that one may then lie up to MAX_SINK under the floor.
    """
    points = floor_points(robot)
    lowest = floor_positions(robot, points, configuration(clip, robot))[:, points.is_sole, 2].min(axis=1)
    raised = -min(float(np.quantile(lowest, 0.2)), float(lowest.min()) + MAX_SINK)
    return dataclasses.replace(clip, root_pos=clip.root_pos + np.array([0.0, 0.0, raised])), raised
