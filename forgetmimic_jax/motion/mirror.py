"""The other-handed twin of a clip: as hard to track as the clip itself, and never trained on."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.robot.model import Robot

PSEUDOVECTOR = np.array([-1.0, 1.0, -1.0])  # what a reflection of y does to an axis of rotation


def mirrored(robot: Robot, clip: Clip) -> Clip:
    """The clip reflected in the robot's xz-plane: left and right trade places. Its name ends with `_mirrored`.

    Raises:
        InputError: a joint that turns about no mirrored axis.
    """
    axes = dict(zip(robot.joint_names, _axes(robot), strict=True))
    others = {name: robot.joint_names[place] for name, place in zip(robot.joint_names, robot.counterpart, strict=True)}
    joint_pos = np.empty_like(clip.joint_pos)
    for place, name in enumerate(clip.joint_names):
        other = others[name]
        sign = float(np.dot(PSEUDOVECTOR * axes[other], axes[name]))
        if abs(abs(sign) - 1.0) > 1e-3:
            raise InputError(f"robot {robot.name}: the axes of '{name}' and '{other}' are no mirror images")
        joint_pos[:, place] = np.sign(sign) * clip.joint_pos[:, clip.joint_names.index(other)]
    return dataclasses.replace(
        clip,
        name=f"{clip.name}_mirrored",
        root_pos=clip.root_pos * [1.0, -1.0, 1.0],
        root_quat=clip.root_quat * [1.0, -1.0, 1.0, -1.0],
        joint_pos=joint_pos,
    )


def _axes(robot: Robot) -> np.ndarray:
    """Axes [joint, 3] of the joints in the root's frame, every joint at 0."""
    data = mujoco.MjData(robot.model)
    data.qpos[:] = 0.0
    data.qpos[3] = 1.0
    mujoco.mj_kinematics(robot.model, data)
    return data.xaxis[1:].copy()
