"""What the floor cannot give: Newton's and Euler's laws over a clip, against contact forces inside friction pyramids.

A motion is possible only if the floor can push as its acceleration needs. The rest, the wrench that no set of forces
at the touching points supplies, is the residual that the refinement drives down.
"""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.optimize import nnls

from forgetmimic_jax.motion.least_squares import Term
from forgetmimic_jax.motion.timeline import Timeline, cross_matrix
from forgetmimic_jax.robot.model import Robot

RADIUS = 0.3  # m, over which a moment counts as a force
FRICTION = 0.7
TOUCHING = 0.02  # m above the floor
SURE = 20.0  # m/s^2: beyond it a missing acceleration counts linearly, so that an impact does not bend the motion
GRAVITY = np.array([0.0, 0.0, -9.81])
PYRAMID = np.array([[FRICTION, 0, 1], [-FRICTION, 0, 1], [0, FRICTION, 1], [0, -FRICTION, 1]])  # its edges


def floor_wrench(
    timeline: Timeline,
    qpos: np.ndarray,
    com: np.ndarray,
    com_jac: np.ndarray,
    momentum: np.ndarray,
    points: np.ndarray,
    flight: np.ndarray,
    mass: float,
    fps: float,
    weight: float,
) -> Term:
    """The residual per unit of mass: [force; moment about the centre of mass over RADIUS] in m/s^2, times `weight`.

    The floor's best answer, by non-negative least squares, is subtracted from what the motion needs; a body in
    flight gets none, so that it falls freely and keeps its angular momentum.

    Args:
        timeline: of the clip's frames.
        qpos: [frame, nq].
        com: centre of mass [frame, 3] m.
        com_jac: its Jacobian [frame, 3, nv].
        momentum: matrix [frame, 3, nv] that takes qvel to the angular momentum about the centre of mass.
        points: [frame, point, 3] m that can touch the floor.
        flight: bool[frame], no contact is allowed.
        mass: kg.
        fps: frames per s.
        weight: per m/s^2.
    """
    change, before, after = timeline.changes(qpos)
    between = _between(timeline, momentum)
    first, _ = timeline.having(2)
    second = (first + 1) % timeline.frames
    between_second = timeline.vectors(between, first, 1)
    jac_1, jac_2 = (timeline.vectors(com_jac, first, ahead) for ahead in (1, 2))
    rate = fps**2 / (mass * RADIUS)
    missing, given, project = _missing(timeline, change, com, between, points, flight, rate, fps)
    lever = -cross_matrix(given[:, :3]) / RADIUS @ jac_1
    blocks = {
        0: (fps**2 * com_jac[first], -rate * between[first] @ before[first]),
        1: (
            -2.0 * fps**2 * jac_1,
            lever + rate * (between_second @ before[second] - between[first] @ after[first]),
        ),
        2: (fps**2 * jac_2, rate * between_second @ after[second]),
    }
    jacobians = {offset: project @ np.concatenate(block, axis=1) for offset, block in blocks.items()}
    return Term(first, missing, jacobians).softened(weight, SURE)


def missing_acceleration(robot: Robot, points: np.ndarray, qpos: np.ndarray, fps: float) -> np.ndarray:
    """What a motion needs and the floor cannot give, per unit of mass: [frame - 2, 6] m/s^2 as in `floor_wrench`.

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
    timeline = Timeline(len(qpos), None)
    change, _, _ = timeline.changes(qpos)
    flight = np.zeros(len(qpos), bool)  # whatever is low enough may push
    rate = fps**2 / (float(model.body_subtreemass[1]) * RADIUS)
    return _missing(timeline, change, com, _between(timeline, momentum), points, flight, rate, fps)[0]


def _between(timeline: Timeline, momentum: np.ndarray) -> np.ndarray:
    """The momentum matrix from each frame to the next."""
    here, _ = timeline.having(1)
    return 0.5 * (momentum[here] + timeline.vectors(momentum, here, 1))


def _missing(
    timeline: Timeline,
    change: np.ndarray,
    com: np.ndarray,
    between: np.ndarray,
    points: np.ndarray,
    flight: np.ndarray,
    rate: float,
    fps: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What is missing [row, 6], what the floor gives, and `floor_answer`'s projector, at each frame with two ahead."""
    first, _ = timeline.having(2)
    second = (first + 1) % timeline.frames
    com_1, com_2 = (timeline.positions(com, first, ahead) for ahead in (1, 2))
    force = (com_2 - 2.0 * com_1 + com[first]) * fps**2 - GRAVITY
    ahead, here = (
        np.einsum("tij,tj->ti", timeline.vectors(between, first, 1), change[second]),
        np.einsum("tij,tj->ti", between[first], change[first]),
    )
    needed = np.concatenate([force, rate * (ahead - here)], axis=-1)
    points_1 = timeline.positions(points, first, 1)
    touching = (points_1[..., 2] < TOUCHING) & ~flight[second, None]
    given, project = floor_answer(needed, points_1 - com_1[:, None], touching)
    return needed - given, given, project


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
