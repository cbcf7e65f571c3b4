"""What the floor cannot give: Newton's and Euler's laws over a clip, against contact forces inside friction pyramids.

A motion is possible only if the floor can push as its acceleration needs. What no set of forces at the touching points
supplies is missing.
"""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.optimize import nnls

from forgetmimic_jax.motion.kinematics import tangent_steps
from forgetmimic_jax.robot.model import Robot

RADIUS = 0.3  # m, over which a moment counts as a force
FRICTION = 0.7
TOUCHING = 0.02  # m above the floor
GRAVITY = np.array([0.0, 0.0, -9.81])
PYRAMID = np.array([[FRICTION, 0, 1], [-FRICTION, 0, 1], [0, FRICTION, 1], [0, -FRICTION, 1]])  # its edges


def missing_acceleration(robot: Robot, points: np.ndarray, qpos: np.ndarray, fps: float) -> np.ndarray:
    """What a motion needs and the floor cannot give, per unit of mass.

    [frame - 2, 6]: force, and moment about the centre of mass over RADIUS, in m/s^2.

    Args:
        robot: the robot.
        points: [frame, point, 3] m that can touch the floor.
        qpos: [frame, nq].
        fps: frames per s.
    """
    model, data = robot.model, mujoco.MjData(robot.model)
    com, momentum = np.empty((len(qpos), 3)), np.empty((len(qpos), 3, model.nv))
    for frame, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        com[frame] = data.subtree_com[1]
        mujoco.mj_angmomMat(model, data, momentum[frame], 1)
    force = (com[2:] - 2.0 * com[1:-1] + com[:-2]) * fps**2 - GRAVITY
    spin = np.einsum("tij,tj->ti", 0.5 * (momentum[1:] + momentum[:-1]), tangent_steps(qpos))
    moment = fps**2 / (float(model.body_subtreemass[1]) * RADIUS) * np.diff(spin, axis=0)
    needed = np.concatenate([force, moment], axis=-1)
    given, _ = floor_answer(needed, points[1:-1] - com[1:-1, None], points[1:-1, :, 2] < TOUCHING)
    return needed - given


def floor_answer(needed: np.ndarray, levers: np.ndarray, touching: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The wrench nearest to `needed` [row, 6] that the touching points give, and the projector [row, 6, 6] off it.

    levers [row, point, 3] m: the points from the centre of mass; touching bool[row, point].
    """
    given = np.zeros_like(needed)
    project = np.tile(np.eye(6), (len(needed), 1, 1))
    for row in np.flatnonzero(touching.any(axis=1)):
        arms = np.repeat(levers[row, touching[row]], len(PYRAMID), axis=0)
        forces = np.tile(PYRAMID, (len(arms) // len(PYRAMID), 1))
        columns = np.concatenate([forces, np.cross(arms, forces) / RADIUS], axis=1).T
        share, _ = nnls(columns, needed[row])
        given[row] = columns @ share
        active = columns[:, share > 0.0]
        if active.size:
            project[row] -= active @ np.linalg.pinv(active)
    return given, project
