"""The shapes of a vendor's robot: what touches the ground, as spheres, capsules and boxes, and what is only seen."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

KINDS = mujoco.mjtGeom
PRIMITIVES = (KINDS.mjGEOM_SPHERE, KINDS.mjGEOM_CAPSULE, KINDS.mjGEOM_BOX)
SEEN_GROUP, TOUCHING_GROUP = 2, 3
BONE = 0.03  # m, radius of what is seen of a robot without shapes to be seen
FRICTION = 0.6
Sphere = tuple[str, float, float, float, float]  # body, x, y, z in its frame, radius; m


def set_shapes(spec: mujoco.MjSpec, spheres: Sequence[Sphere], notes: list[str]) -> None:
    """Shapes that touch the ground alone, all of them spheres, capsules and boxes; the others are only seen."""
    given = {body for body, *_ in spheres}
    changed: set[str] = set()
    robot = [geom for body in spec.bodies[1:] for geom in body.geoms]
    for geom in robot:
        kind = KINDS(geom.type)
        touches = bool(geom.contype or geom.conaffinity)
        if touches and not geom.name:
            name = f"{geom.parent.name}_shape{list(geom.parent.geoms).index(geom)}"
            give_way(spec, name, notes)
            geom.name = name
        if kind not in PRIMITIVES and (touches or kind == KINDS.mjGEOM_MESH):
            changed.add(kind.name.removeprefix("mjGEOM_").lower())
            _make_capsule(geom)
        if touches and geom.parent.name in given:
            geom.contype, geom.conaffinity, geom.group = 0, 0, SEEN_GROUP
        elif touches and geom.contype:  # otherwise it is one of this project's own
            geom.contype, geom.conaffinity, geom.group = 0, 1, TOUCHING_GROUP
            geom.condim = max(geom.condim, 3)
        elif not touches:
            geom.group = SEEN_GROUP
    if changed:
        notes.append(f"shapes that are made capsules: {', '.join(sorted(changed))}")
    for number, (body, *place, radius) in enumerate(spheres):
        parent = spec.body(body)
        if parent is not None:
            give_way(spec, sphere_name(body, number), notes)
            parent.add_geom(
                name=sphere_name(body, number),
                type=KINDS.mjGEOM_SPHERE,
                size=[radius, 0.0, 0.0],
                pos=place,
                contype=0,
                conaffinity=1,
                condim=3,
                group=TOUCHING_GROUP,
                priority=1,
                friction=[FRICTION, 0.005, 0.0001],
                mass=0.0,
            )
    if not any(geom.group == SEEN_GROUP for body in spec.bodies[1:] for geom in body.geoms):
        _add_bones(spec)
        notes.append("no shape is there to be seen: bones are drawn")


def give_way(spec: mujoco.MjSpec, name: str, notes: list[str]) -> None:
    """Call a vendor's shape otherwise whose name the project needs."""
    taken = {geom.name: geom for geom in spec.geoms}
    if name in taken:
        other = next(other for number in range(len(taken)) if (other := f"{name}_{number}") not in taken)
        taken[name].name = other
        notes.append(f"the shape '{name}' of {taken[name].parent.name} is called '{other}'")


def sphere_name(body: str, number: int) -> str:
    """The name of the shape that a YAML's sphere becomes; number: its place in the YAML."""
    return f"{body}_sphere{number}"


def _make_capsule(geom: mujoco.MjsGeom) -> None:
    """A capsule in place of a cylinder, an ellipsoid, or a mesh, to which MuJoCo fits it."""
    size, kind = np.array(geom.size), geom.type
    geom.type = KINDS.mjGEOM_CAPSULE
    if kind == KINDS.mjGEOM_CYLINDER and not np.isfinite(geom.fromto[0]):
        geom.size = [size[0], max(size[1] - size[0], 1e-3), 0.0]
    elif kind == KINDS.mjGEOM_ELLIPSOID and not np.isfinite(geom.fromto[0]):
        long = int(np.argmax(size))
        radius = float(np.delete(size, long).mean())
        turns = {0: [0.0, 90.0], 1: [-90.0, 0.0], 2: [0.0, 0.0]}  # degrees about x and y that bring z to the long axis
        turn, quat = np.zeros(4), np.zeros(4)
        about_x, about_y = np.radians(turns[long])
        mujoco.mju_euler2Quat(turn, np.array([about_x, about_y, 0.0]), "xyz")
        mujoco.mju_mulQuat(quat, np.array(geom.quat), turn)
        geom.size, geom.quat = [radius, max(float(size[long]) - radius, 1e-3), 0.0], quat


def _add_bones(spec: mujoco.MjSpec) -> None:
    """Something to see: a capsule from every body to each of its children, or a ball."""
    seen = {"contype": 0, "conaffinity": 0, "mass": 0.0, "group": SEEN_GROUP, "rgba": [0.6, 0.62, 0.65, 1.0]}
    for body in spec.bodies[1:]:
        far = [np.array(child.pos) for child in body.bodies if np.linalg.norm(child.pos) > 1e-3]
        for place in far:
            fromto = [0.0, 0.0, 0.0, *place]
            body.add_geom(type=KINDS.mjGEOM_CAPSULE, size=[BONE, 0.0, 0.0], fromto=fromto, **seen)
        if not far:
            body.add_geom(type=KINDS.mjGEOM_SPHERE, size=[1.5 * BONE, 0.0, 0.0], **seen)
