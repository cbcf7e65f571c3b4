"""The robot's shapes above the floor: which of their points can touch it first, and how high those are."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.robot.model import Robot


@dataclass(frozen=True)
class FloorPoints:
    """Points of the robot's shapes that can touch the floor first: the centres of spheres, the ends of capsules."""

    geom: np.ndarray  # [point] geom ids
    body: np.ndarray  # [point] body ids
    local: np.ndarray  # [point, 3] m in the body's frame
    radius: np.ndarray  # [point] m
    is_sole: np.ndarray  # bool[point]: of a foot


def floor_points(robot: Robot) -> FloorPoints:
    """The floor points of every shape that collides.

    Raises:
        InputError: a shape that is no sphere, capsule or box.
    """
    model = robot.model
    geoms, local, radii = [], [], []
    for geom in range(model.ngeom):
        if not model.geom_conaffinity[geom] or model.geom_bodyid[geom] == 0:
            continue
        ends, radius = _ends(robot, geom)
        geoms += [geom] * len(ends)
        radii += [radius] * len(ends)
        local += list(ends)
    return FloorPoints(
        geom=np.array(geoms),
        body=model.geom_bodyid[geoms],
        local=np.array(local),
        radius=np.array(radii),
        is_sole=np.isin(geoms, robot.foot_geom_ids),
    )


def _ends(robot: Robot, geom: int) -> tuple[np.ndarray, float]:
    """Points [point, 3] m of a shape in its body's frame, and the radius about them."""
    model = robot.model
    size, kind = model.geom_size[geom], model.geom_type[geom]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        offsets, radius = np.zeros((1, 3)), float(size[0])
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        offsets, radius = np.array([[0.0, 0.0, size[1]], [0.0, 0.0, -size[1]]]), float(size[0])
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        offsets, radius = np.array(np.meshgrid([1, -1], [1, -1], [1, -1])).reshape(3, -1).T * size, 0.0
    else:
        body = model.body(model.geom_bodyid[geom]).name
        raise InputError(
            f"robot {robot.name}: shape '{model.geom(geom).name}' of {body}: found a shape that is none of these; "
            "accepted: spheres, capsules and boxes"
        )
    return model.geom_pos[geom] + offsets @ _matrix(model.geom_quat[geom]).T, radius


def floor_positions(robot: Robot, points: FloorPoints, qpos: np.ndarray) -> np.ndarray:
    """Lowest position of every floor point [frame, point, 3] m, world frame; z is its height above the floor."""
    data = mujoco.MjData(robot.model)
    positions = np.empty((len(qpos), len(points.body), 3))
    for frame, configuration in enumerate(qpos):
        data.qpos[:] = configuration
        mujoco.mj_kinematics(robot.model, data)
        turns = data.xmat[points.body].reshape(-1, 3, 3)
        positions[frame] = data.xpos[points.body] + np.einsum("pij,pj->pi", turns, points.local)
    positions[..., 2] -= points.radius
    return positions


def _matrix(quat: np.ndarray) -> np.ndarray:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)
