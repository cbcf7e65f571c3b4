"""What neither the floor nor the motors can give, as residuals of a clip that the refinement drives down."""

from __future__ import annotations

import numpy as np

from forgetmimic_jax.motion.dynamics import GRAVITY, RADIUS, TOUCHING, floor_answer
from forgetmimic_jax.motion.motors import InverseDynamics, answered, rates
from forgetmimic_jax.retarget.least_squares import Residuals
from forgetmimic_jax.retarget.pose import Pose
from forgetmimic_jax.retarget.timeline import Timeline, cross_matrix
from forgetmimic_jax.robot.model import Robot

# Beyond these a lack counts linearly instead of squared, so that an impact does not bend the motion.
SURE_ACCELERATION = 20.0  # m/s^2
SURE_TORQUE = 1.0  # torque limits


def floor_wrench(robot: Robot, timeline: Timeline, pose: Pose, flight: np.ndarray, weight: float) -> Residuals:
    """The residual per unit of mass: [force; moment about the centre of mass over RADIUS] in m/s^2, times `weight`.

    The floor's best answer, by non-negative least squares, is subtracted from what the motion needs; a body in
    flight gets none, so that it falls freely and keeps its angular momentum.

    Args:
        robot: the robot.
        timeline: of the clip's frames.
        pose: of the clip.
        flight: bool[frame], no contact is allowed.
        weight: per m/s^2.
    """
    fps = timeline.fps
    rate = fps**2 / (float(robot.model.body_subtreemass[1]) * RADIUS)
    change, before, after = timeline.changes(pose.qpos)
    here, _ = timeline.having(1)
    between = 0.5 * (pose.momentum[here] + timeline.vectors(pose.momentum, here, 1))  # each frame and the next
    first, _ = timeline.having(2)
    second = (first + 1) % timeline.frames
    between_second = timeline.vectors(between, first, 1)

    com_1, com_2 = timeline.positions(pose.com, first, 1), timeline.positions(pose.com, first, 2)
    force = (com_2 - 2.0 * com_1 + pose.com[first]) * fps**2 - GRAVITY
    spin_second = np.einsum("tij,tj->ti", between_second, change[second])
    spin_first = np.einsum("tij,tj->ti", between[first], change[first])
    needed = np.concatenate([force, rate * (spin_second - spin_first)], axis=-1)
    points = timeline.positions(pose.floor, first, 1)
    touching = (points[..., 2] < TOUCHING) & ~flight[second, None]
    given, project = floor_answer(needed, points - com_1[:, None], touching)

    jac_1, jac_2 = timeline.vectors(pose.com_jac, first, 1), timeline.vectors(pose.com_jac, first, 2)
    lever = -cross_matrix(given[:, :3]) / RADIUS @ jac_1
    blocks = {
        0: (fps**2 * pose.com_jac[first], -rate * between[first] @ before[first]),
        1: (
            -2.0 * fps**2 * jac_1,
            lever + rate * (between_second @ before[second] - between[first] @ after[first]),
        ),
        2: (fps**2 * jac_2, rate * between_second @ after[second]),
    }
    jacobians = {offset: project @ np.concatenate(block, axis=1) for offset, block in blocks.items()}
    return Residuals(first, needed - given, jacobians).softened(weight, SURE_ACCELERATION)


def motor_torque(
    robot: Robot, timeline: Timeline, pose: Pose, flight: np.ndarray, *, share: float, weight: float
) -> Residuals:
    """What each motor lacks, in torque limits, times `weight`: [row, joint], 0 where it has enough or does not count.

    Args:
        robot: the robot.
        timeline: of the clip's frames.
        pose: of the clip.
        flight: bool[frame], no contact is allowed.
        share: of the torque limits that the motion may use.
        weight: per torque limit.
    """
    change, before, after = timeline.changes(pose.qpos)
    first, _ = timeline.having(2)
    second = (first + 1) % timeline.frames
    velocity, acceleration = rates(change[first], change[second], timeline.fps)
    inverse = InverseDynamics(robot)
    lack = np.zeros((len(first), robot.num_joints))
    position, speed, rate = np.zeros((3, *lack.shape, robot.model.nv))
    for row, frame in enumerate(second):
        force = inverse.force(pose.qpos[frame], velocity[row], acceleration[row])
        touching = (pose.floor[frame, :, 2] < TOUCHING) & ~flight[frame]
        load = answered(robot, force, pose.floor_jac[frame, touching])
        lack[row] = robot.motor_counts * (load.torque - np.clip(load.torque, -share, share))
        if lack[row].any():
            project = (lack[row] != 0.0)[:, None] * load.project
            position[row], speed[row], rate[row] = (project @ by for by in inverse.derivatives())
    speed, rate = 0.5 * timeline.fps * speed, timeline.fps**2 * rate
    blocks = {
        0: (speed - rate) @ before[first],
        1: position + speed @ (after[first] + before[second]) + rate @ (before[second] - after[first]),
        2: (speed + rate) @ after[second],
    }
    return Residuals(first, lack, blocks).softened(weight, SURE_TORQUE)
