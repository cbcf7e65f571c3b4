"""Fit a clip that was read to the robot and the library: the rate, the limits, the ground."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.ndimage import median_filter

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.contact import floor_points, floor_positions
from forgetmimic_jax.motion.kinematics import configuration, resample
from forgetmimic_jax.robot.model import Robot

MAX_SINK = 0.015  # m
MAX_SHIFT = 0.3  # m: a clip further from the ground was recorded for something else
LASTING = 0.2  # s: shorter dips are slips, and move nothing
GROUND = 0.05  # m: a robot whose lowest point stays higher never touches


def fit(robot: Robot, clip: Clip, fps: float) -> Clip:
    """The clip at `fps`, with its joints inside the robot's limits."""
    clip = resample(clip, fps)
    return dataclasses.replace(clip, joint_pos=np.clip(clip.joint_pos, robot.joint_lower, robot.joint_upper))


def lowest_points(robot: Robot, clip: Clip, soles: bool = False) -> np.ndarray:
    """Height [frame] m of the robot's lowest point, or of its soles'."""
    points = floor_points(robot)
    heights = floor_positions(robot, points, configuration(clip, robot))[..., 2]
    return heights[:, points.is_sole].min(axis=1) if soles else heights.min(axis=1)


def on_floor(robot: Robot, clip: Clip) -> tuple[Clip, float]:
    """The clip raised or lowered to stand on the ground, and by how much in m.

    The lowest fifth of the frames' lowest sole points decides, and what lies lower for LASTING: no single frame, which
    is often a recording's slip. The lowest that lasts may then lie up to MAX_SINK under the ground.

    Raises:
        InputError: more than MAX_SHIFT.
    """
    lowest = lowest_points(robot, clip, soles=True)
    lasting = median_filter(lowest, 2 * round(0.5 * LASTING * clip.fps) + 1, mode="nearest")
    raised = -min(float(np.quantile(lowest, 0.2)), float(lasting.min()) + MAX_SINK)
    if abs(raised) > MAX_SHIFT:
        raise InputError(
            f"{clip.name}: the soles are {-raised:.2f} m from the ground; at most {MAX_SHIFT} m are shifted. Is the "
            "height another robot's, or in another unit (--unit)?"
        )
    return dataclasses.replace(clip, root_pos=clip.root_pos + np.array([0.0, 0.0, raised])), raised


def check_touches(clip: Clip, lowest: np.ndarray) -> None:
    """Refuse a robot that never touches the ground; `lowest` [frame] m are the heights of its lowest points."""
    if lowest.min() > GROUND:
        raise InputError(
            f"{clip.name}: the robot never touches the ground: its lowest point is {lowest.min():.2f} m above"
        )
