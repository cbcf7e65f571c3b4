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
from forgetmimic_jax.motion.least_squares import Term
from forgetmimic_jax.motion.timeline import Timeline
from forgetmimic_jax.robot.model import Robot

BALANCE = 20.0  # motors' torque limits that a missing root force of the robot's weight counts as
SURE = 1.0  # torque limits: beyond it a lack counts linearly, so that an impact does not bend the motion
STEP = 1e-6  # of the finite differences


class Load(NamedTuple):
    """What the motors have to give in one frame, in units of their torque limits."""

    torque: np.ndarray  # [joint]
    project: np.ndarray  # [joint, nv] its change by a generalized force, N and N m


def motor_torque(
    robot: Robot,
    timeline: Timeline,
    qpos: np.ndarray,
    points: np.ndarray,
    points_jac: np.ndarray,
    flight: np.ndarray,
    fps: float,
    share: float,
    weight: float,
) -> Term:
    """What each motor lacks, in torque limits, times `weight`: [row, joint], 0 where it has enough.

    Args:
        robot: the robot.
        timeline: of the clip's frames.
        qpos: [frame, nq].
        points: [frame, point, 3] m that can touch the floor.
        points_jac: [frame, point, 3, nv].
        flight: bool[frame], no contact is allowed.
        fps: frames per s.
        share: of the torque limits that the motion may use.
        weight: per torque limit.
    """
    change, before, after = timeline.changes(qpos)
    first, _ = timeline.having(2)
    second = (first + 1) % timeline.frames
    velocity, acceleration = _rates(change[first], change[second], fps)
    inverse, counted = InverseDynamics(robot), ~wrists(robot)
    lack = np.zeros((len(first), robot.num_joints))
    position, speed, rate = (np.zeros((*lack.shape, robot.model.nv)) for _ in range(3))
    for row, frame in enumerate(second):
        force = inverse.force(qpos[frame], velocity[row], acceleration[row])
        touching = (points[frame, :, 2] < TOUCHING) & ~flight[frame]
        load = answered(robot, force, points_jac[frame, touching])
        lack[row] = counted * (load.torque - np.clip(load.torque, -share, share))
        if lack[row].any():
            project = (lack[row] != 0.0)[:, None] * load.project
            position[row], speed[row], rate[row] = (project @ by for by in inverse.derivatives())
    speed, rate = 0.5 * fps * speed, fps**2 * rate
    blocks = {
        0: (speed - rate) @ before[first],
        1: position + speed @ (after[first] + before[second]) + rate @ (before[second] - after[first]),
        2: (speed + rate) @ after[second],
    }
    return Term(first, lack, blocks).softened(weight, SURE)


def motor_loads(robot: Robot, points: FloorPoints, positions: np.ndarray, qpos: np.ndarray, fps: float) -> np.ndarray:
    """Torque over torque limit of every motor, 0 for the wrists': [frame - 2, joint], signed.

    Args:
        robot: the robot.
        points: its points that can touch the floor.
        positions: of the points [frame, point, 3] m.
        qpos: [frame, nq].
        fps: frames per s.
    """
    change, _, _ = Timeline(len(qpos), None).changes(qpos)
    velocity, acceleration = _rates(change[:-1], change[1:], fps)
    inverse, loads = InverseDynamics(robot), np.zeros((len(velocity), robot.num_joints))
    for row in range(len(loads)):
        force = inverse.force(qpos[row + 1], velocity[row], acceleration[row])
        touching = np.flatnonzero(positions[row + 1, :, 2] < TOUCHING)
        loads[row] = answered(robot, force, inverse.jacobians(points, touching)).torque
    return np.where(wrists(robot), 0.0, loads)


def wrists(robot: Robot) -> np.ndarray:
    """bool[joint]: motors that do not count. A wrist that gives way moves nothing else; a handstand overloads it."""
    return np.array(["wrist" in joint for joint in robot.joint_names])


def answered(robot: Robot, force: np.ndarray, jacobians: np.ndarray) -> Load:
    """The motors' loads after the floor's best answer, by non-negative least squares over the friction pyramids.

    Args:
        robot: the robot.
        force: generalized [nv] that the motion needs, N and N m.
        jacobians: [point, 3, nv] of the points that touch.
    """
    root = BALANCE / (float(robot.model.body_subtreemass[1]) * 9.81)
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
        position, velocity, acceleration = (np.zeros((self._model.nv, self._model.nv)) for _ in range(3))
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


def _rates(change: np.ndarray, next_change: np.ndarray, fps: float) -> tuple[np.ndarray, np.ndarray]:
    """Velocity and acceleration at the frame between two tangent steps."""
    return 0.5 * fps * (change + next_change), fps**2 * (next_change - change)
