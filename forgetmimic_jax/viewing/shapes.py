"""A robot's shapes as balls, cylinders and boxes of unit size, turned, stretched and coloured, for a mesh viewer."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from forgetmimic_jax.robot.model import VISUAL_GROUP

# Of half-size one along every axis; a capsule is a cylinder with two balls.
UNIT_MESHES = {
    "ball": trimesh.creation.uv_sphere(radius=1.0, count=[12, 20]),
    "cylinder": trimesh.creation.cylinder(radius=1.0, height=2.0, sections=20),
    "box": trimesh.creation.box(extents=(2.0, 2.0, 2.0)),
}


class Shapes(NamedTuple):
    """Shapes of one kind. Leading dimension: shape."""

    body: np.ndarray  # i the model's number of the body that it is on
    position: np.ndarray  # [shape, 3] m, in the body's frame
    rotation: Rotation  # to the body's frame
    half_size: np.ndarray  # [shape, 3] m
    colour: np.ndarray  # u8[shape, 3]

    def placed(self, positions: np.ndarray, orientations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions [shape, 3] m and orientations [shape, 4] in the world, given those of every body."""
        bodies = Rotation.from_quat(orientations[self.body], scalar_first=True)
        centre = positions[self.body] + bodies.apply(self.position)
        return centre, (bodies * self.rotation).as_quat(scalar_first=True)


def shapes(model: mujoco.MjModel) -> dict[str, Shapes]:
    """What is seen of a `drawing_model` but the floor, by kind of `UNIT_MESHES`.

    The numbers of the bodies are those of the simulated model too.
    """
    kinds = mujoco.mjtGeom
    found: dict[str, list[tuple[int, np.ndarray, np.ndarray]]] = {}  # geom, offset along its axes, half size
    for geom in map(int, np.flatnonzero(model.geom_group == VISUAL_GROUP)):
        kind, (x, y, z) = kinds(model.geom_type[geom]), model.geom_size[geom]
        here = np.zeros(3)
        if kind in (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER):
            found.setdefault("cylinder", []).append((geom, here, np.array([x, x, y])))
            if kind == kinds.mjGEOM_CAPSULE:
                ends = [(geom, np.array([0.0, 0.0, side * y]), np.full(3, x)) for side in (-1.0, 1.0)]
                found.setdefault("ball", []).extend(ends)
        elif kind == kinds.mjGEOM_BOX:
            found.setdefault("box", []).append((geom, here, np.array([x, y, z])))
        elif kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_ELLIPSOID):
            half = np.full(3, x) if kind == kinds.mjGEOM_SPHERE else np.array([x, y, z])
            found.setdefault("ball", []).append((geom, here, half))
        else:
            raise NotImplementedError(f"geom {geom} of the model: {kind.name} is drawn by nobody yet")
    return {kind: _gather(model, rows) for kind, rows in found.items()}


def _gather(model: mujoco.MjModel, rows: list[tuple[int, np.ndarray, np.ndarray]]) -> Shapes:
    geoms, offsets, halves = (np.array(column) for column in zip(*rows, strict=True))
    turns = Rotation.from_quat(model.geom_quat[geoms], scalar_first=True)
    return Shapes(
        body=model.geom_bodyid[geoms],
        position=model.geom_pos[geoms] + turns.apply(offsets),
        rotation=turns,
        half_size=halves,
        colour=np.round(255 * model.geom_rgba[geoms, :3]).astype(np.uint8),
    )
