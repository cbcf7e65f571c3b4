"""What the network's output does: the order of its joints, and the joint targets that it stands for."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jax import Array

from forgetmimic_jax.motion.library import Frames
from forgetmimic_jax.robot.model import Robot, RobotArrays


def in_robot_order(robot: Robot, action: Array) -> Array:
    """The network's output [env, joint], in the policy's order of joints, in the robot's order."""
    return action[:, np.argsort(robot.policy_joints)]


def to_joint_target(mode: Literal["residual", "offset"], robot: RobotArrays, reference: Frames, action: Array) -> Array:
    """Joint targets [env, joint] rad of the PD loops: origin + scale · action.

    Args:
        mode: the origin: residual, the reference joints; offset, the default pose.
        robot: constants.
        reference: the frame to reach next.
        action: [env, joint] in the robot's order.
    """
    origin = reference.joint_pos if mode == "residual" else robot.default_joint_pos
    return origin + robot.action_scale * action
