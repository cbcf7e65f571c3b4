"""What the motors cannot give: inverse dynamics over a clip, against their torque limits.

The floor's forces are those that leave least of the motion unexplained and, where they can be shared out in several
ways, load the motors least.
"""

from __future__ import annotations

import copy
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.optimize import nnls

from forgetmimic_jax.motion.contact import FloorPoints
from forgetmimic_jax.motion.dynamics import PYRAMID, RADIUS, TOUCHING
from forgetmimic_jax.motion.kinematics import tangent_steps
from forgetmimic_jax.robot.model import Robot

BALANCE = 20.0  # motors' torque limits that a missing root force of the robot's weight counts as
STEP = 1e-6  # of the finite differences


class Load(NamedTuple):
    """What the motors have to give in one frame, in units of their torque limits."""

    torque: np.ndarray  # [joint]
    project: np.ndarray  # [joint, nv] its change by a generalized force, N and N m


def motor_loads(robot: Robot, points: FloorPoints, positions: np.ndarray, qpos: np.ndarray, fps: float) -> np.ndarray:
    """Torque over torque limit of every motor, 0 where it does not count: [frame - 2, joint], signed.

    Args:
        robot: the robot.
        points: its points that can touch the floor.
        positions: of the points [frame, point, 3] m.
        qpos: [frame, nq].
        fps: frames per s.
    """
    steps = tangent_steps(qpos)
    velocity, acceleration = rates(steps[:-1], steps[1:], fps)
    inverse, loads = InverseDynamics(robot), np.zeros((len(velocity), robot.num_joints))
    for row in range(len(loads)):
        force = inverse.force(qpos[row + 1], velocity[row], acceleration[row])
        touching = np.flatnonzero(positions[row + 1, :, 2] < TOUCHING)
        loads[row] = answered(robot, force, inverse.jacobians(points, touching)).torque
    return np.where(robot.motor_counts, loads, 0.0)


def rates(step: np.ndarray, next_step: np.ndarray, fps: float) -> tuple[np.ndarray, np.ndarray]:
    """Velocity and acceleration at the frame between two tangent steps."""
    return 0.5 * fps * (step + next_step), fps**2 * (next_step - step)


def answered(robot: Robot, force: np.ndarray, jacobians: np.ndarray) -> Load:
    """The motors' loads after the floor's best answer, by non-negative least squares over the friction pyramids.

    Args:
        robot: the robot.
        force: generalized [nv] that the motion needs, N and N m.
        jacobians: [point, 3, nv] of the points that touch.
    """
    root = BALANCE / robot.weight
    motors = 1.0 / np.asarray(robot.arrays.effort, np.float64)
    scale = np.concatenate([np.full(3, root), np.full(3, root / RADIUS), motors])
    torque, project = scale * force, np.diag(scale)
    if len(jacobians):
        columns = scale[:, None] * np.einsum("eb,pbn->npe", PYRAMID, jacobians).reshape(len(scale), -1)
        pushes, _ = nnls(columns, torque)
        torque = torque - columns @ pushes
        active = columns[:, pushes > 0.0]
        if active.size:
            project = project - active @ (np.linalg.pinv(active) * scale)
    return Load(torque[6:], project[6:])


class InverseDynamics:
    """Generalized forces [nv] of a motion without contacts, and their derivatives."""

    def __init__(self, robot: Robot) -> None:
        self._model = copy.copy(robot.model)
        self._model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        self._data = mujoco.MjData(self._model)

    def force(self, qpos: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray) -> np.ndarray:
        """N and N m [nv]; velocity and acceleration as MuJoCo's qvel and its rate."""
        self._data.qpos[:], self._data.qvel[:], self._data.qacc[:] = qpos, velocity, acceleration
        mujoco.mj_inverse(self._model, self._data)
        return self._data.qfrc_inverse.copy()

    def derivatives(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the last motion's force by its position, velocity and acceleration: [nv, nv] each."""
        position, velocity, acceleration = np.zeros((3, self._model.nv, self._model.nv))
        nothing = (None,) * 4
        mujoco.mjd_inverseFD(self._model, self._data, STEP, False, position, velocity, acceleration, *nothing)
        return position.T, velocity.T, acceleration.T

    def jacobians(self, points: FloorPoints, rows: np.ndarray) -> np.ndarray:
        """Of some floor points at the last motion's position: [row, 3, nv]."""
        found = np.zeros((len(rows), 3, self._model.nv))
        for jacobian, row in zip(found, rows, strict=True):
            body = points.body[row]
            point = self._data.xpos[body] + self._data.xmat[body].reshape(3, 3) @ points.local[row]
            mujoco.mj_jac(self._model, self._data, jacobian, None, point, body)
        return found
