"""A YAML of roles for an MJCF, proposed from its names and its geometry, and what it cannot say.

The robot faces x in its own zero pose, z up, so its left is at positive y.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from forgetmimic_jax.robot.check import narrow_ranges
from forgetmimic_jax.robot.shapes import sphere_name
from forgetmimic_jax.robot.standing import soles, standing
from forgetmimic_jax.robot.tree import Tree, says_other_side
from forgetmimic_jax.robot.vendor import Additions, Unreadable, compiled, read_mjcf, read_unmended

KNEE, ELBOW = ("knee", "shin", "calf", "lower_leg"), ("elbow", "forearm", "lower_arm")
HAND, FOOT = ("hand", "wrist", "palm", "gripper"), ("foot", "ankle", "sole")
ARMATURE_PER_TORQUE = 1.8e-4  # kg m^2 per N m: Unitree's G1 and H2 motors lie between 1.1e-4 and 2.0e-4
STANDING = ("home", "stand", "standing", "default", "init", "knees_bent")  # a vendor's names of keyframes
UPRIGHT = 0.99  # w of the root's quaternion
ALIKE = 0.1  # of the robot's height
BALL = 0.05  # m, radius of what stands for a body without a shape
SPEED = 20.0  # rad/s, a motor's, which no MJCF says


@dataclass(frozen=True)
class Proposal:
    """The YAML's fields, what was mended or assumed, what the user has to say, and what looks wrong."""

    roles: dict[str, Any]
    notes: list[str]
    missing: list[str]  # with the mend, a line each
    doubts: list[str]


def propose(file: Path) -> Proposal:
    """Roles for an MJCF.

    Raises:
        Unreadable: no robot in it.
        InputError: it is a Git LFS pointer, or a file that it names is.
    """
    spec, notes = read_mjcf(file)
    try:
        model, said = compiled(spec)
    except ValueError as error:
        raise Unreadable(" ".join(str(error).split())) from None
    notes += said
    _, vendors, _ = read_unmended(file)
    missing: list[str] = []
    fixed = [model.joint(j).name for j in range(1, model.njnt) if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_HINGE]
    if fixed:
        missing.append(
            f"joints that are no hinges, welded by `fixed`: {', '.join(fixed)}; or put hinges in their place"
        )
        spec, _ = read_mjcf(file, Additions(fixed=[re.escape(joint) for joint in fixed]))
        model, _ = compiled(spec)
    tree = Tree(model)
    limbs = tree.limbs()
    roles: dict[str, Any] = {"model": file.name}
    roles |= _bodies(tree, limbs, missing)
    roles |= {"natural_frequency_hz": 10.0, "damping_ratio": 2.0, "soft_limit_factor": 0.9}
    roles |= _motors(model, torque_limits(vendors), missing)
    roles["ignored_motors"] = _ignored(tree, roles)
    endless = [model.joint(j).name for j in range(1, model.njnt) if not model.jnt_limited[j]]
    if endless:
        missing.append(
            f"limits of the joints {', '.join(endless)}; mend, in the YAML: ranges: {{{endless[0]}: [lower, upper]}}"
        )
    missing += narrow_ranges(model, roles.get("pairs", {}).get("feet", ()))
    if fixed:
        roles["fixed"] = [re.escape(joint) for joint in fixed]
    spheres = _spheres(model, roles, notes)
    if spheres:
        roles["spheres"] = spheres
    roles["head"] = _head(model, spheres)
    roles |= standing(tree, roles, _keyframe(vendors, model))
    return Proposal(roles, notes, missing, _swapped(roles))


def _bodies(tree: Tree, limbs: Sequence[tuple[int, int]], missing: list[str]) -> dict[str, Any]:
    """anchor, key_bodies, end_effectors and pairs."""
    long = [pair for pair in limbs if tree.model.body_jntnum[tree.below(pair[0])].sum() >= 3]
    if len(long) < 2:
        missing.append(
            f"found {len(long)} pairs of limbs with three joints or more; two arms and two legs are needed. Mend: name "
            "pairs, key_bodies, end_effectors and anchor in the YAML by hand"
        )
        return {}
    legs = min(long, key=lambda pair: float(tree.pos[tree.below(pair[0]), 2].min()))
    arms = max((pair for pair in long if pair != legs), key=lambda pair: float(tree.pos[pair[0], 2]))
    reach = [float(tree.pos[tree.below(pair[0]), 2].min()) for pair in (legs, arms)]
    if reach[1] < reach[0] + ALIKE * float(np.ptp(tree.pos[1:, 2])):
        missing.append(
            "arms: two pairs of limbs reach the ground alike (a quadruped?); mend: correct the proposed pairs"
        )
    leg, arm = _limb(tree, legs[0], KNEE, FOOT), _limb(tree, arms[0], ELBOW, HAND)
    roles = {"hips": leg[0], "knees": leg[1], "feet": leg[2], "shoulders": arm[0], "elbows": arm[1], "hands": arm[2]}
    pairs = {role: [tree.names[body], tree.names[tree.other.get(body, body)]] for role, body in roles.items()}
    lonely = [pair[0] for pair in pairs.values() if pair[0] == pair[1]]
    if lonely:
        missing.append(f"the other side of {', '.join(lonely)}; mend: name it in pairs")
    anchor = int(tree.model.body_parentid[arms[0]])
    left, right = [pair[0] for pair in pairs.values()], [pair[1] for pair in pairs.values()]
    order = [tree.names[1], *left[:3], *right[:3], tree.names[anchor], *left[3:], *right[3:]]
    ends = [*pairs["feet"], *pairs["hands"]]
    return {
        "anchor": tree.names[anchor],
        "key_bodies": list(dict.fromkeys(order)),
        "end_effectors": ends,
        "pairs": pairs,
    }


def _limb(tree: Tree, start: int, bends: Sequence[str], ends: Sequence[str]) -> tuple[int, int, int]:
    """First joint's centre, bend and end of a limb: hip, knee and foot, or shoulder, elbow and hand."""
    chain = tree.jointed(tree.chain(start))
    fork = next((place for place, body in enumerate(chain) if len(tree.children[body]) > 2), len(chain) - 1)
    chain = chain[: fork + 1]  # a hand ends where its fingers begin
    bend = tree.pick(chain, bends)
    bend = tree.middle(chain) if bend is None else bend
    rest = [body for body in chain if chain.index(body) >= chain.index(bend)]
    named = [body for body in rest if tree.pick([body], ends) == body]
    above = chain[: chain.index(bend)] or [start]
    return above[len(above) // 2], bend, named[-1] if named else rest[-1]


def torque_limits(model: mujoco.MjModel) -> dict[str, float]:
    """N m of each joint that a vendor's file limits: at the joint, at its actuator, or by a motor's control range."""
    limits: dict[str, float] = {}
    for joint in range(model.njnt):
        name, found = model.joint(joint).name, []
        if model.jnt_actfrclimited[joint]:
            found.append(np.abs(model.jnt_actfrcrange[joint]).max())
        for actuator in np.flatnonzero(
            (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_trnid[:, 0] == joint)
        ):
            gear = abs(model.actuator_gear[actuator, 0])
            is_motor = model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE
            if model.actuator_forcelimited[actuator]:
                found.append(gear * np.abs(model.actuator_forcerange[actuator]).max())
            elif is_motor and model.actuator_ctrllimited[actuator]:
                gain = abs(model.actuator_gainprm[actuator, 0])
                found.append(gear * gain * np.abs(model.actuator_ctrlrange[actuator]).max())
        if found and name:
            limits[name] = float(min(found))
    return limits


def _motors(model: mujoco.MjModel, limits: Mapping[str, float], missing: list[str]) -> dict[str, Any]:
    """motors and joint_motors: one kind of motor for every torque limit."""
    joints = [model.joint(j).name for j in range(1, model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE]
    unknown = [joint for joint in joints if not limits.get(joint)]
    motors: dict[str, Any] = {}
    rules = []
    for torque in sorted({limits[joint] for joint in joints if joint not in unknown}):
        kind = f"torque_{torque:g}".replace(".", "_")
        motors[kind] = {"armature": round(ARMATURE_PER_TORQUE * torque, 6), "effort": torque, "velocity": SPEED}
        alike = [re.escape(joint) for joint in joints if limits.get(joint) == torque]
        rules.append(["|".join(alike), kind])
    if unknown:
        motors["unknown"] = {"armature": None, "effort": None, "velocity": SPEED}
        rules.append(["|".join(map(re.escape, unknown)), "unknown"])
        missing.append(
            f"torque limits of the joints {', '.join(unknown)}; mend: fill in motors: unknown (effort N m, armature kg "
            f"m^2, about {ARMATURE_PER_TORQUE:g} times the effort), or several motors"
        )
    return {"motors": motors, "joint_motors": rules}


def _swapped(roles: Mapping[str, Any]) -> list[str]:
    """Pairs whose left is right by the names, a line."""
    pairs = list(roles.get("pairs", {}).values())
    found = [pair for pair in pairs if says_other_side(*pair)]
    if 2 * len(found) <= len(pairs):
        return []
    left, right = found[0]
    return [f"pairs: left is '{left}' and right is '{right}': the names say the other side: does it face -x?"]


def _spheres(model: mujoco.MjModel, roles: Mapping[str, Any], notes: list[str]) -> list[list[Any]]:
    """Shapes for key bodies and a head that have none: soles for the feet, a ball at the origin of the others."""
    touching = {int(body) for body in model.geom_bodyid[model.geom_conaffinity > 0]}
    bare = [model.body(body).name for body in range(1, model.nbody) if body not in touching]
    feet = roles.get("pairs", {}).get("feet", ())
    spheres = [sphere for foot in feet for sphere in soles(model, foot, notes)]
    balls = [body for body in bare if body not in feet and (body in roles.get("key_bodies", ()) or _is_head(body))]
    if balls:
        notes.append(f"key bodies without a shape get a ball of {BALL} m: {', '.join(balls)}")
    left = len(bare) - len(balls) - len(set(bare) & set(feet))
    if left:
        notes.append(f"{left} of {model.nbody - 1} bodies have no shape that touches: they pass through the ground")
    return spheres + [[body, 0.0, 0.0, 0.0, BALL] for body in balls]


def _is_head(name: str) -> bool:
    return bool(re.search("head(?!ing)", name.lower()))


def _head(model: mujoco.MjModel, spheres: Sequence[Sequence[Any]]) -> list[str]:
    """The names of the head's shapes."""
    geoms = [model.geom(int(geom)) for geom in np.flatnonzero(model.geom_conaffinity)]
    own = [geom.name for geom in geoms if _is_head(geom.name) or _is_head(model.body(geom.bodyid[0]).name)]
    return own + [sphere_name(body, number) for number, (body, *_) in enumerate(spheres) if _is_head(body)]


def _ignored(tree: Tree, roles: Mapping[str, Any]) -> list[str]:
    """Joints beyond the elbows: a wrist that gives way moves nothing else."""
    found = []
    for elbow in roles.get("pairs", {}).get("elbows", ()):
        for body in tree.below(tree.names.index(elbow))[1:]:
            first = tree.model.body_jntadr[body]
            found += [tree.model.joint(joint).name for joint in range(first, first + tree.model.body_jntnum[body])]
    return [re.escape(joint) for joint in found]


def _keyframe(vendors: mujoco.MjModel, model: mujoco.MjModel) -> dict[str, float]:
    """Joint angles of a vendor's keyframe of standing: called so, or the first that is upright; none without one."""
    if not vendors.njnt or vendors.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        return {}
    upright = [key for key in range(vendors.nkey) if abs(vendors.key_qpos[key, 3]) > UPRIGHT]
    if not upright:
        return {}
    key = next((key for key in upright if vendors.key(key).name.lower() in STANDING), upright[0])
    angles = {vendors.joint(j).name: vendors.key_qpos[key, vendors.jnt_qposadr[j]] for j in range(vendors.njnt)}
    joints = [model.joint(j).name for j in range(1, model.njnt)]
    return {joint: round(float(angles[joint]), 4) for joint in joints if abs(angles.get(joint, 0.0)) > 1e-6}
