"""A clip's kinematics with their Jacobians: what every residual of the refinement is made from."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from forgetmimic_jax.motion.contact import FloorPoints
from forgetmimic_jax.robot.model import Robot


@dataclass(frozen=True)
class Pose:
    """Positions and rotations of a clip with their Jacobians over nv, world frame."""

    qpos: np.ndarray  # [frame, nq]
    bodies: np.ndarray  # [frame, body, 3] m, the bodies' origins
    bodies_jac: np.ndarray  # [frame, body, 3, nv]
    turns: np.ndarray  # [frame, body, 3, 3]
    turns_jac: np.ndarray  # [frame, body, 3, nv] world-frame rotation
    floor: np.ndarray  # [frame, point, 3] m, the lowest positions of the floor points
    floor_jac: np.ndarray  # [frame, point, 3, nv]
    com: np.ndarray  # [frame, 3] m
    com_jac: np.ndarray  # [frame, 3, nv]
    momentum: np.ndarray  # [frame, 3, nv] takes qvel to the angular momentum about the centre of mass


def pose_of(robot: Robot, points: FloorPoints, qpos: np.ndarray) -> Pose:
    """The kinematics of qpos [frame, nq]."""
    model, data = robot.model, mujoco.MjData(robot.model)
    frames, bodies, count, nv = len(qpos), model.nbody, len(points.body), model.nv
    pose = Pose(
        qpos,
        bodies=np.empty((frames, bodies, 3)),
        bodies_jac=np.empty((frames, bodies, 3, nv)),
        turns=np.empty((frames, bodies, 3, 3)),
        turns_jac=np.empty((frames, bodies, 3, nv)),
        floor=np.empty((frames, count, 3)),
        floor_jac=np.empty((frames, count, 3, nv)),
        com=np.empty((frames, 3)),
        com_jac=np.empty((frames, 3, nv)),
        momentum=np.empty((frames, 3, nv)),
    )
    for frame in range(frames):
        data.qpos[:] = qpos[frame]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        pose.bodies[frame] = data.xpos
        pose.turns[frame] = data.xmat.reshape(-1, 3, 3)
        turns = pose.turns[frame, points.body]
        pose.floor[frame] = data.xpos[points.body] + np.einsum("pij,pj->pi", turns, points.local)
        for body in range(bodies):
            mujoco.mj_jacBody(model, data, pose.bodies_jac[frame, body], pose.turns_jac[frame, body], body)
        for row, body in enumerate(points.body):
            mujoco.mj_jac(model, data, pose.floor_jac[frame, row], None, pose.floor[frame, row], body)
        pose.com[frame] = data.subtree_com[1]
        mujoco.mj_jacSubtreeCom(model, data, pose.com_jac[frame], 1)
        mujoco.mj_angmomMat(model, data, pose.momentum[frame], 1)
    pose.floor[..., 2] -= points.radius
    return pose
