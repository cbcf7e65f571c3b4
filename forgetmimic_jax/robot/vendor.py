"""A vendor's MJCF as this project simulates robots: its own file stays as it is, the mends are made when it is read.

A file that needs no mend, such as those in `robots/`, is read unchanged.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from forgetmimic_jax.basics.files import check_no_pointer
from forgetmimic_jax.robot.check import FLOOR
from forgetmimic_jax.robot.shapes import FRICTION, KINDS, Sphere, give_way, set_shapes

SETTINGS = ("timestep", "integrator", "iterations", "ls_iterations")  # of <option>, which the project's settings say
FLAGS = {"disableflags": mujoco.mjtDisableBit, "enableflags": mujoco.mjtEnableBit}
NAMED = {"cone": mujoco.mjtCone, "jacobian": mujoco.mjtJacobian, "solver": mujoco.mjtSolver}


@dataclass(frozen=True)
class Additions:
    """What a robot's YAML adds to its MJCF."""

    fixed: Sequence[str] = ()  # patterns of joints that are welded where they stand
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # rad, of joints without limits
    # (body, x, y, z, radius) m: spheres in the body's frame, in place of all that touches of that body
    spheres: Sequence[Sphere] = ()


class Unreadable(Exception):
    """An MJCF that cannot be simulated, with the mend."""


def read_mjcf(file: Path, additions: Additions | None = None) -> tuple[mujoco.MjSpec, list[str]]:
    """A robot's MJCF, mended, and what was mended, a line each.

    Raises:
        Unreadable: MuJoCo does not read it, or it holds no robot.
        InputError: it is a Git LFS pointer, or a file that it names is.
    """
    additions = additions or Additions()
    spec, model, notes = read_unmended(file)
    _keep_inertias(spec, model)
    _keep_one_robot(spec, model, notes)
    _set_option(spec, notes)
    _leave_out_gravcomp(spec, notes)
    _leave_out_what_drives(spec, notes)
    _set_ground(spec, model, notes)
    _set_joints(spec, additions, notes)
    set_shapes(spec, additions.spheres, notes)
    return spec, notes


def read_unmended(file: Path) -> tuple[mujoco.MjSpec, mujoco.MjModel, list[str]]:
    """A vendor's MJCF, compiled too, as it is but for files that are not there; everything has a name.

    Raises:
        Unreadable: MuJoCo does not read it.
        InputError: it is a Git LFS pointer, or a file that it names is.
    """
    check_no_pointer(file)
    notes: list[str] = []
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            spec = mujoco.MjSpec.from_file(str(file))
        notes += _in_a_line_each(said)
        for name, folder in _files(spec, file):
            check_no_pointer(folder / name)
        _leave_out_missing_meshes(spec, file, notes)
        _leave_out_missing_textures(spec, file, notes)
        _name_all(spec)
        whole = spec.copy()
        whole.compiler.fusestatic = False  # every body stays, those without a joint too
        return spec, compiled(whole)[0], notes  # warnings that the mends leave come again
    except (ValueError, OSError, RuntimeError) as error:
        raise Unreadable(f"{file.name} is no MJCF that MuJoCo reads: {' '.join(str(error).split())}") from None


def compiled(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, list[str]]:
    """The model, and MuJoCo's warnings, a line each, which it does not print itself."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        model = spec.compile()
    return model, _in_a_line_each(said)


def _in_a_line_each(said: Sequence[warnings.WarningMessage]) -> list[str]:
    return list(dict.fromkeys(f"MuJoCo says: {' '.join(str(one.message).split())}" for one in said))


def _files(spec: mujoco.MjSpec, file: Path) -> list[tuple[str, Path]]:
    """The files that an MJCF names, each with its folder."""
    meshes = [mesh.file for mesh in spec.meshes]
    textures = [name for texture in spec.textures for name in (texture.file, *texture.cubefiles)]
    folders = ((meshes, file.parent / spec.meshdir), (textures, file.parent / spec.texturedir))
    return [(name, folder) for names, folder in folders for name in names]


def _leave_out_missing_meshes(spec: mujoco.MjSpec, file: Path, notes: list[str]) -> None:
    """Shapes whose mesh files are not there."""
    folder = file.parent / spec.meshdir
    missing = {mesh.name or Path(mesh.file).stem: mesh for mesh in spec.meshes if _is_missing(mesh.file, folder)}
    if not missing:
        return
    for geom in list(spec.geoms):
        if geom.meshname in missing:
            spec.delete(geom)
    for mesh in missing.values():
        spec.delete(mesh)
    notes.append(f"{len(missing)} mesh files are not in {folder} (such as {min(missing)}): their shapes are left out")


def _leave_out_missing_textures(spec: mujoco.MjSpec, file: Path, notes: list[str]) -> None:
    """All materials, where a texture's file is not there; their colours stay."""
    folder = file.parent / spec.texturedir
    names = [name for texture in spec.textures for name in (texture.file, *texture.cubefiles)]
    if not any(_is_missing(name, folder) for name in names):
        return
    for geom in spec.geoms:
        if geom.material:
            geom.rgba, geom.material = spec.material(geom.material).rgba, ""
    for element in (*spec.sites, *spec.skins, *spec.tendons):
        element.material = ""
    for element in (*spec.materials, *spec.textures):
        spec.delete(element)
    notes.append("texture files are not there: materials are left out")


def _is_missing(name: str, folder: Path) -> bool:
    return bool(name) and not (folder / name).is_file() and not Path(name).is_file()


def _name_all(spec: mujoco.MjSpec) -> None:
    """Names for bodies and joints that have none."""
    taken, joints = {body.name for body in spec.bodies}, {joint.name for joint in spec.joints}
    for body in spec.bodies:
        if not body.name:
            body.name = next(name for number in range(len(taken) + 1) if (name := f"body{number}") not in taken)
            taken.add(body.name)
    for joint in spec.joints:
        if not joint.name and joint.type != mujoco.mjtJoint.mjJNT_FREE:
            first, stem = joint.parent.joints.index(joint), f"{joint.parent.name}_joint"
            joint.name = next(name for number in count(first) if (name := f"{stem}{number}") not in joints)
            joints.add(joint.name)


def _keep_inertias(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Masses that follow from shapes or from a total stay, whatever becomes of the shapes."""
    scaled = spec.compiler.settotalmass > 0.0
    for body in spec.bodies[1:]:
        if scaled or not body.explicitinertial:
            here = model.body(body.name)
            body.explicitinertial = True
            body.fullinertia = [np.nan] + [0.0] * 5
            body.mass, body.ipos, body.iquat, body.inertia = here.mass[0], here.ipos, here.iquat, here.inertia
    spec.compiler.settotalmass = -1.0


def _keep_one_robot(spec: mujoco.MjSpec, model: mujoco.MjModel, notes: list[str]) -> None:
    """The body at the top with most joints, on a free joint; others are scenery."""
    tops = list(spec.worldbody.bodies)
    if not tops:
        raise Unreadable("no body; a robot is a tree of bodies with hinges")
    root = max(tops, key=lambda body: len(_joints_below(body)))
    if not _joints_below(root):
        raise Unreadable("no joint; a robot is a tree of bodies with hinges")
    others = [body.name for body in tops if body is not root]
    if others:
        gone = {name for top in tops if top is not root for name in _names_below(top)}
        for exclude in list(spec.excludes):
            if gone & {exclude.bodyname1, exclude.bodyname2}:
                spec.delete(exclude)
        for body in tops:
            if body is not root:
                spec.delete(body)
        notes.append(f"bodies that are not of the robot are left out: {', '.join(others)}")
    own = list(root.joints)
    if any(joint.type == mujoco.mjtJoint.mjJNT_SLIDE for joint in own):  # a free joint in parts
        for joint in own:
            spec.delete(joint)
        notes.append(f"{len(own)} joints of {root.name} are replaced by a free joint")
    elif own and own[0].type != mujoco.mjtJoint.mjJNT_FREE:
        raise Unreadable(f"{root.name} hangs on the world by a hinge; mend: put <freejoint/> in its place")
    if not any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in root.joints):
        if _rigid_mass(root) <= 0.0:
            raise Unreadable(
                f"{root.name} floats and has no mass; mend: give it one (<inertial>), or take away the joints of the "
                "body that it carries"
            )
        root.add_freejoint()
        notes.append(f"a free joint is added to {root.name}")
    if root.pos[2] <= 0.0:
        root.pos = [0.0, 0.0, -float(_lowest(model))]


def _joints_below(body: mujoco.MjsBody) -> list[mujoco.MjsJoint]:
    own = [joint for joint in body.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE]
    return own + [joint for child in body.bodies for joint in _joints_below(child)]


def _rigid_mass(body: mujoco.MjsBody) -> float:
    """kg of a body and of what it carries without a joint."""
    return float(body.mass) + sum(_rigid_mass(child) for child in body.bodies if not child.joints)


def _names_below(body: mujoco.MjsBody) -> list[str]:
    return [body.name] + [name for child in body.bodies for name in _names_below(child)]


def _lowest(model: mujoco.MjModel) -> float:
    """Height of the lowest body's origin, m, where the MJCF places the robot."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return float(min(data.xpos[1:, 2].min(), -0.1))


def _set_option(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """The project's physics: gravity, air, contacts and flags that a vendor's <option> changes."""
    own, ours = spec.option, mujoco.MjSpec().option
    own.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)  # of no effect on the project's integrator
    for name in (name for name in dir(ours) if not name.startswith("_") and name not in SETTINGS):
        found = _option_in_words(name, getattr(own, name))
        expected = _option_in_words(name, getattr(ours, name))
        setattr(own, name, getattr(ours, name))
        if found != expected:
            notes.append(f"<option> {name}: {found} is replaced by {expected}")


def _option_in_words(name: str, value: Any) -> str:
    """A field of <option>: flags and kinds by name, otherwise its numbers."""
    if name in FLAGS:
        flags = [each for each, flag in FLAGS[name].__members__.items() if "_" in each and value & int(flag)]
        return " ".join(each.split("_")[1].lower() for each in flags) or "none"
    if name in NAMED:
        return NAMED[name](value).name.split("_")[1].lower()
    return " ".join(f"{part:g}" for part in np.atleast_1d(value))


def _leave_out_gravcomp(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """Bodies that gravity does not pull."""
    light = [body for body in spec.bodies if body.gravcomp]
    for body in light:
        body.gravcomp = 0.0
    if light:
        notes.append(f"gravcomp is left out: {', '.join(body.name for body in light)}")


def _leave_out_what_drives(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """Actuators, sensors, keyframes and what couples joints; the project adds its own motors and sensors."""
    for camera in list(spec.cameras):
        spec.delete(camera)
    touching = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    for geom in spec.geoms:  # touched by name; from here on by the ground alone
        if geom.name in touching and not (geom.contype or geom.conaffinity):
            geom.contype = 1
    for what, said in (
        ("actuators", True),
        ("tendons", True),
        ("equalities", True),
        ("sensors", False),
        ("keys", False),
        ("pairs", False),
        ("skins", False),
        ("tuples", False),
    ):
        elements = list(getattr(spec, what))
        for element in elements:
            spec.delete(element)
        if elements and said:
            put = "replaced by motors of the project's" if what == "actuators" else "left out: no joint is coupled"
            notes.append(f"{len(elements)} {what} are {put}")


def _set_ground(spec: mujoco.MjSpec, model: mujoco.MjModel, notes: list[str]) -> None:
    """One plane called `floor`, level and at height 0, and light."""
    own = list(spec.worldbody.geoms)
    if any(geom.name == FLOOR for geom in own) and _is_ground(model, model.geom(FLOOR).id):
        spec.geom(FLOOR).contype = 1
        return
    planes = [geom for geom in own if geom.type == KINDS.mjGEOM_PLANE]
    for geom in own:
        spec.delete(geom)
    give_way(spec, FLOOR, notes)
    spec.worldbody.add_geom(
        name=FLOOR,
        type=KINDS.mjGEOM_PLANE,
        size=[0.0, 0.0, 0.05],
        contype=1,
        conaffinity=0,
        friction=[FRICTION, 0.005, 0.0001],
        rgba=[0.45, 0.5, 0.55, 1.0],
    )
    if not list(spec.lights):
        spec.worldbody.add_light(pos=[0.0, 0.0, 3.0], dir=[0.0, 0.0, -1.0])
    notes.append(f"the ground is {'replaced by' if planes else 'added as'} the plane '{FLOOR}'; light is there")


def _is_ground(model: mujoco.MjModel, geom: int) -> bool:
    """Whether a shape of the world is a plane, level and at height 0."""
    normal = np.zeros(3)
    mujoco.mju_rotVecQuat(normal, np.array([0.0, 0.0, 1.0]), model.geom_quat[geom])
    level = normal[2] > 1.0 - 1e-9 and model.geom_pos[geom, 2] == 0.0
    return bool(level and model.geom_type[geom] == KINDS.mjGEOM_PLANE)


def _set_joints(spec: mujoco.MjSpec, additions: Additions, notes: list[str]) -> None:
    """Joints that are welded, and limits that the YAML gives."""
    fixed = [joint for joint in spec.joints if any(re.fullmatch(pattern, joint.name) for pattern in additions.fixed)]
    if fixed:
        notes.append(f"joints that are welded: {', '.join(joint.name for joint in fixed)}")
    for joint in fixed:
        spec.delete(joint)
    for name, limits in additions.ranges.items():
        joint = spec.joint(name)
        if joint is not None:
            joint.range = np.degrees(limits) if spec.compiler.degree else list(limits)
            joint.limited = True
