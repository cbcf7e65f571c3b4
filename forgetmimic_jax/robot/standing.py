"""What a new robot stands on, and how: its soles, its default pose and height, proposed from its geometry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from forgetmimic_jax.robot.tree import Tree, above, at_rest

SOLE_RADIUS = 0.01  # m
BEND = 0.6  # rad of the knees, where the vendor gives no pose


def soles(model: mujoco.MjModel, foot: str, notes: list[str]) -> list[list[Any]]:
    """Four spheres for a foot that has no shape to stand on: under the box that its inertia is that of."""
    body = model.body(foot).id
    if any(model.geom_bodyid[geom] == body and model.geom_conaffinity[geom] for geom in range(model.ngeom)):
        return []
    data = at_rest(model)
    ixx, iyy, izz = model.body_inertia[body]
    scale = 6.0 / max(float(model.body_mass[body]), 1e-6)
    squares = np.array([iyy + izz - ixx, ixx + izz - iyy, ixx + iyy - izz])
    half = 0.5 * np.sqrt(np.maximum(scale * squares, 1e-6))
    turn = data.xmat[body].reshape(3, 3)
    inertial = data.ximat[body].reshape(3, 3)
    reach = np.abs(inertial) @ half  # half extents along the world's axes
    centre = data.xipos[body] - data.xpos[body]
    notes.append(
        f"{foot} has no shape to stand on: four spheres under the box of its inertia ({200 * reach[0]:.0f} cm long)"
    )
    out = np.array([reach[0] - SOLE_RADIUS, max(reach[1] - SOLE_RADIUS, SOLE_RADIUS), reach[2] - SOLE_RADIUS])
    corners = [centre + out * [x, y, -1] for x in (1, -1) for y in (1, -1)]
    return [[foot, *(round(float(part), 4) + 0.0 for part in turn.T @ corner), SOLE_RADIUS] for corner in corners]


def standing(tree: Tree, roles: Mapping[str, Any], keyframe: Mapping[str, float]) -> dict[str, Any]:
    """default_pose and default_height: the vendor's keyframe, or knees bent, soles flat on the ground.

    The hips then turn until the centre of mass is over the middle of the soles.
    """
    legs = [_pitches(tree, roles, side) for side in (0, 1)] if "pairs" in roles else []
    pose = dict(keyframe)
    if all(len(leg) == 3 for leg in legs):
        if not pose:
            axes = at_rest(tree.model).xaxis
            turns = [(joint, share * BEND) for leg in legs for joint, share in zip(leg, (-0.5, 1.0, -0.5), strict=True)]
            pose = {joint: turn * float(np.sign(axes[tree.model.joint(joint).id, 1])) for joint, turn in turns}
        poses = [_bent(tree.model, legs, float(turn), pose) for turn in np.linspace(-0.2, 0.2, 81)]
        pose = min(poses, key=lambda one: abs(_ahead(tree.model, roles, one)))
    lowest, _ = _soles(tree.model, at_rest(tree.model, pose), roles)
    return {"default_height": round(max(-lowest, 0.05), 4), "default_pose": pose}


def _pitches(tree: Tree, roles: Mapping[str, Any], side: int) -> list[str]:
    """The joints of a leg that bend it: at its hip, its knee and its ankle; fewer where it has not all of them."""
    knee = tree.names.index(roles["pairs"]["knees"][side])
    foot = tree.names.index(roles["pairs"]["feet"][side])
    data = at_rest(tree.model)
    found: dict[str, str] = {}
    for body in above(tree.model, foot):
        for joint in range(tree.model.body_jntadr[body], tree.model.body_jntadr[body] + tree.model.body_jntnum[body]):
            if tree.model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE and abs(data.xaxis[joint, 1]) > 0.9:
                place = "knee" if body == knee else "hip" if body in above(tree.model, knee) else "ankle"
                found.setdefault(place, tree.model.joint(joint).name)
    return [found[place] for place in ("hip", "knee", "ankle") if place in found]


def _bent(
    model: mujoco.MjModel, legs: Sequence[Sequence[str]], turn: float, pose: Mapping[str, float]
) -> dict[str, float]:
    """A pose whose hips are turned by `turn` rad about y, and its ankles back, inside the joints' ranges."""
    axes, changed = at_rest(model).xaxis, dict(pose)
    for hip, _, ankle in legs:
        for joint, by in ((hip, turn), (ankle, -turn)):
            row = model.joint(joint).id
            changed[joint] = changed.get(joint, 0.0) + by * float(np.sign(axes[row, 1]))
    for joint, angle in changed.items():
        row = model.joint(joint).id
        inside = np.clip(angle, *model.jnt_range[row]) if model.jnt_limited[row] else angle
        changed[joint] = round(float(inside), 4)
    return changed


def _ahead(model: mujoco.MjModel, roles: Mapping[str, Any], pose: Mapping[str, float]) -> float:
    """m that the centre of mass is in front of the middle of the soles."""
    data = at_rest(model, pose)
    return float(data.subtree_com[1, 0] - _soles(model, data, roles)[1])


def _soles(model: mujoco.MjModel, data: mujoco.MjData, roles: Mapping[str, Any]) -> tuple[float, float]:
    """Height of the lowest point of the feet, and the middle of their shapes along x, m."""
    feet = [model.body(foot).id for foot in roles.get("pairs", {}).get("feet", ())]
    lowest, along = [], []
    for geom in range(model.ngeom):
        if model.geom_conaffinity[geom] and model.geom_bodyid[geom] in feet:
            lowest.append(_under(model, data, geom))
            along.append(float(data.geom_xpos[geom, 0]))
    for body, *place, radius in roles.get("spheres", ()):
        at = model.body(body).id
        if at not in feet:
            continue
        point = data.xpos[at] + data.xmat[at].reshape(3, 3) @ np.array(place)
        lowest.append(float(point[2]) - radius)
        along.append(float(point[0]))
    if not lowest:
        return float(data.xpos[1:, 2].min()), float(data.xpos[feet, 0].mean()) if feet else 0.0
    return min(lowest), 0.5 * (min(along) + max(along))


def _under(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """Height of a primitive shape's lowest point, m."""
    size, axes = model.geom_size[geom], data.geom_xmat[geom].reshape(3, 3)
    kind = model.geom_type[geom]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        below = float(np.abs(axes[2]) @ size)
    else:
        below = float(size[0] + (abs(axes[2, 2]) * size[1] if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0))
    return float(data.geom_xpos[geom, 2]) - below
