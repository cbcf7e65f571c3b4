"""Whether a robot's YAML fits its MJCF."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import mujoco
import numpy as np

from forgetmimic_jax.basics.errors import nearest
from forgetmimic_jax.robot.sides import body_ids, side_problems
from forgetmimic_jax.robot.tree import above

HINGE = mujoco.mjtJoint.mjJNT_HINGE
FLOOR = "floor"  # the name of the ground's geom
NARROW = 0.1  # rad; half of the legs' joints have less only where radians were read as degrees


def misfits(roles: Mapping[str, Any], model: mujoco.MjModel) -> Iterator[str]:
    """What is at odds, a line each.

    Args:
        roles: the fields of the YAML that could be read, as `Roles` holds them.
        model: the MJCF, compiled.
    """
    if model.njnt < 2 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        yield f"model: {roles['model']} must have one free joint first, and hinge joints"
        return
    others = [model.joint(joint).name for joint in range(1, model.njnt) if model.jnt_type[joint] != HINGE]
    if others:
        yield f"model: joint {_quoted(others)} is no hinge; mend: hinges in its place, or weld it (fixed: [its name])"
        return
    joints = [model.joint(joint).name for joint in range(1, model.njnt)]
    endless = [joint for joint, limited in zip(joints, model.jnt_limited[1:], strict=True) if not limited]
    if endless:
        yield f"model: no range of joint {_quoted(endless)}; mend: ranges: {{{endless[0]}: [lower, upper]}} in rad"
    yield from _bodies(roles, model)
    yield from _head(roles, model)
    yield from _joints(roles, joints)


def narrow_ranges(model: mujoco.MjModel, feet: Iterable[str]) -> Iterator[str]:
    """Ranges of the legs' joints that are too narrow for any robot, a line."""
    legs = [body for foot in feet for body in above(model, model.body(foot).id)]
    of_legs = np.isin(model.jnt_bodyid, legs) & (model.jnt_type == HINGE) & (model.jnt_limited > 0)
    ranges = np.ptp(model.jnt_range[of_legs], axis=1)
    if len(ranges) and np.median(ranges) < NARROW:
        yield (
            f"ranges of the legs' joints: found a median of {np.median(ranges):.2g} rad; are they radians? Mend, in "
            'the MJCF: <compiler angle="radian"/>, then robot check with --force'
        )


def first_match(rules: Iterable[tuple[str, str]], joint: str) -> str | None:
    """The second of the first (pattern, ...) whose pattern is the whole of the joint's name."""
    return next((given for pattern, given in rules if re.fullmatch(pattern, joint)), None)


def _bodies(roles: Mapping[str, Any], model: mujoco.MjModel) -> Iterator[str]:
    bodies = [model.body(body).name for body in range(1, model.nbody)]
    named: dict[str, tuple[str, ...]] = {field: roles.get(field, ()) for field in ("key_bodies", "end_effectors")}
    named["anchor"] = (roles["anchor"],) if "anchor" in roles else ()
    named |= {f"pairs: {role}": pair for role, pair in vars(roles["pairs"]).items()} if "pairs" in roles else {}
    unknown = {field: [name for name in names if name not in bodies] for field, names in named.items()}
    for field, names in unknown.items():
        for name in names:
            yield f"{field}: no body '{name}' in {roles['model']}; {nearest(name, bodies)}"
    if "pairs" in roles and not any(unknown[field] for field in unknown if field.startswith("pairs")):
        yield from (f"pairs: {line}" for line in side_problems(model, body_ids(model, roles["pairs"])))
        yield from narrow_ranges(model, roles["pairs"].feet)
    if "key_bodies" not in roles:
        return
    for field in ("anchor", "end_effectors", "pairs: feet"):
        for name in named.get(field, ()):
            if name not in roles["key_bodies"] and name not in unknown[field]:
                yield f"{field}: '{name}' must be among key_bodies"
    if bodies[0] not in roles["key_bodies"]:
        yield f"key_bodies: the floating base '{bodies[0]}' must be among them"


def _head(roles: Mapping[str, Any], model: mujoco.MjModel) -> Iterator[str]:
    touching = [model.geom(geom).name for geom in range(model.ngeom) if model.geom_conaffinity[geom]]
    for shape in roles.get("head", ()):
        if shape not in touching:
            yield f"head: no geom '{shape}' in {roles['model']} touches the floor; {nearest(shape, touching)}"


def _joints(roles: Mapping[str, Any], joints: list[str]) -> Iterator[str]:
    for joint in roles.get("default_pose", ()):
        if joint not in joints:
            yield f"default_pose: no joint '{joint}'; {nearest(joint, joints)}"
    for pattern in roles.get("ignored_motors", ()):
        if not any(re.fullmatch(pattern, joint) for joint in joints):
            yield f"ignored_motors: no joint matches '{pattern}'"
    for name, patterns in roles.get("variants", {}).items():
        for pattern in patterns:
            if not any(re.fullmatch(pattern, joint) for joint in joints):
                yield f"variants: {name}: no joint matches '{pattern}'"
    if "joint_motors" not in roles:
        return
    if "motors" in roles:
        for motor in sorted({motor for _, motor in roles["joint_motors"]} - set(roles["motors"])):
            yield f"joint_motors: no motor '{motor}'; {nearest(motor, roles['motors'])}"
    motorless = [joint for joint in joints if first_match(roles["joint_motors"], joint) is None]
    if motorless:
        yield f"joint_motors: no pattern matches joint {_quoted(motorless)}"


def _quoted(names: list[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)
