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
    return _origin(mode, robot, reference) + robot.action_scale * action


def to_action(mode: Literal["residual", "offset"], robot: RobotArrays, reference: Frames, joint_target: Array) -> Array:
    """The action [env, joint] that stands for joint targets [env, joint] rad: the inverse of `to_joint_target`."""
    return (joint_target - _origin(mode, robot, reference)) / robot.action_scale


def _origin(mode: Literal["residual", "offset"], robot: RobotArrays, reference: Frames) -> Array:
    return reference.joint_pos if mode == "residual" else robot.default_joint_pos
