"""Observation layouts: `TERMS` says what a term is, `LAYOUTS` which terms an actor sees, in which order.

All that depends on the observation follows from these two tables: its size, its noise, what an encoder's bias shifts,
what poisoning permutes, what belongs to a joint by name, and what an export says.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax.numpy as jnp
from flax import struct
from jax import Array

from forgetmimic_jax.basics import rotation
from forgetmimic_jax.basics.errors import InputError, nearest
from forgetmimic_jax.motion.library import Frames
from forgetmimic_jax.physics import BodyState, PhysicsState
from forgetmimic_jax.robot.model import RobotArrays


@struct.dataclass
class Moment:
    """What an observation is made of. Leading dimension: env; joints are in the robot's order."""

    robot: RobotArrays
    reference: Frames  # the frame to reach next
    physics: PhysicsState
    bodies: BodyState  # the robot's key bodies
    last_action: Array  # [env, joint] the network's last output, unscaled; 0 at the start of an episode
    anchor: int = struct.field(pytree_node=False)  # index of the anchor among the key bodies
    root: int = struct.field(pytree_node=False)  # index of the floating base among the key bodies


class Term(NamedTuple):
    """One term of an observation."""

    name: str
    numbers: int  # of a term per joint, numbers of each joint: the first ones of all joints, then the second ones
    values: Callable[[Moment], Array]  # [env, size]
    per_joint: bool = False
    of_reference: bool = False  # depends on the reference
    encoder: bool = False  # what the joint encoders read, less the default pose: their bias shifts it
    height: bool = False  # grows with the robot

    def size(self, num_joints: int) -> int:
        """Numbers of the term for a robot of `num_joints` joints."""
        return self.numbers * num_joints if self.per_joint else self.numbers


def _down(like: Array) -> Array:
    return jnp.zeros_like(like).at[:, 2].set(-1.0)


def _height(of: Frames, body: int) -> Array:
    return of.bodies.pos[:, body, 2:]


def _lin_vel(of: Frames, body: int) -> Array:
    return rotation.rotate_inverse(of.bodies.quat[:, body], of.bodies.lin_vel[:, body])


def _ang_vel(of: Frames, body: int) -> Array:
    return rotation.rotate_inverse(of.bodies.quat[:, body], of.bodies.ang_vel[:, body])


def _gravity(of: Frames, body: int) -> Array:
    return rotation.rotate_inverse(of.bodies.quat[:, body], _down(of.bodies.pos[:, body]))


def _anchor_position(m: Moment) -> Array:
    """[env, 3] m from the robot's anchor to the reference's, in the robot's anchor frame."""
    away = m.reference.bodies.pos[:, m.anchor] - m.bodies.pos[:, m.anchor]
    return rotation.rotate_inverse(m.bodies.quat[:, m.anchor], away)


def _anchor_orientation(m: Moment) -> Array:
    """[env, 6] the first two columns of M = R(robot)ᵀ R(reference), row by row: M00 M01 M10 M11 M20 M21."""
    here, there = m.bodies.quat[:, m.anchor], m.reference.bodies.quat[:, m.anchor]
    columns = rotation.to_matrix_columns(rotation.multiply(rotation.conjugate(here), there))
    return columns.reshape(-1, 2, 3).swapaxes(1, 2).reshape(-1, 6)


def _base_quat(m: Moment) -> Array:
    return rotation.normalize(m.physics.qpos[:, 3:7])


# m, m/s, rad, rad/s; a suffix _b means the axes of the body. The names are wbc-mjlab's and mjlab's for the same terms,
# but for ref_root_*, which are ours.
TERMS: dict[str, Term] = {
    term.name: term
    for term in (
        Term("ref_base_height", 1, lambda m: _height(m.reference, m.anchor), of_reference=True, height=True),
        Term("ref_base_lin_vel_b", 3, lambda m: _lin_vel(m.reference, m.anchor), of_reference=True),
        Term("ref_base_ang_vel_b", 3, lambda m: _ang_vel(m.reference, m.anchor), of_reference=True),
        Term("ref_gravity_b", 3, lambda m: _gravity(m.reference, m.anchor), of_reference=True),
        Term("ref_root_height", 1, lambda m: _height(m.reference, m.root), of_reference=True, height=True),
        Term("ref_root_lin_vel_b", 3, lambda m: _lin_vel(m.reference, m.root), of_reference=True),
        Term("ref_root_ang_vel_b", 3, lambda m: _ang_vel(m.reference, m.root), of_reference=True),
        Term("ref_root_gravity_b", 3, lambda m: _gravity(m.reference, m.root), of_reference=True),
        Term("ref_joint_pos", 1, lambda m: m.reference.joint_pos, per_joint=True, of_reference=True),
        Term("command", 2, lambda m: jnp.concatenate([m.reference.joint_pos, m.reference.joint_vel], axis=-1),
             per_joint=True, of_reference=True),
        Term("motion_anchor_pos_b", 3, _anchor_position, of_reference=True),
        Term("motion_anchor_ori_b", 6, _anchor_orientation, of_reference=True),
        Term("base_lin_vel", 3, lambda m: rotation.rotate_inverse(_base_quat(m), m.physics.qvel[:, :3])),
        Term("base_ang_vel", 3, lambda m: m.physics.qvel[:, 3:6]),
        Term("projected_gravity", 3, lambda m: rotation.rotate_inverse(_base_quat(m), _down(m.physics.qpos[:, :3]))),
        Term("joint_pos", 1, lambda m: m.physics.qpos[:, 7:] - m.robot.default_joint_pos, per_joint=True, encoder=True),
        Term("joint_vel", 1, lambda m: m.physics.qvel[:, 6:], per_joint=True),
        Term("actions", 1, lambda m: m.last_action, per_joint=True),
    )
}  # fmt: skip


@dataclass(frozen=True)
class Layout:
    """The terms that an actor sees, in their order."""

    name: str
    sensor_noise: Mapping[str, float | tuple[float, ...]]  # of each term: half-width of the uniform noise in training
    body: Literal["anchor", "root"] = "anchor"  # of the reference, where a term is of one body

    @property
    def terms(self) -> tuple[Term, ...]:
        return tuple(TERMS[name] for name in self.sensor_noise)

    def size(self, num_joints: int) -> int:
        """Numbers of the whole observation."""
        return sum(term.size(num_joints) for term in self.terms)

    def places(self, num_joints: int) -> dict[str, slice]:
        """Where each term is in the observation."""
        places, begin = {}, 0
        for term in self.terms:
            places[term.name] = slice(begin, begin + term.size(num_joints))
            begin += term.size(num_joints)
        return places

    def joints_of(self, size: int) -> int:
        """The number of joints of a robot whose observation has `size` numbers."""
        fixed = self.size(0)
        return (size - fixed) // (self.size(1) - fixed)


_LAYOUTS = (
    # wbc-mjlab, 16 + 4 joint: its terms, all of the reference's anchor, and its noise.
    Layout("wbc132", {
        "ref_base_height": 0.01,
        "ref_base_lin_vel_b": (0.1, 0.1, 0.05),
        "ref_base_ang_vel_b": (0.2, 0.2, 0.3),
        "ref_gravity_b": 0.02,
        "ref_joint_pos": 0.05,
        "base_ang_vel": 0.2,
        "projected_gravity": 0.05,
        "joint_pos": 0.01,
        "joint_vel": 1.5,
        "actions": 0.0,
    }),
    # mjlab and BeyondMimic, 15 + 5 joint.
    Layout("mjlab160", {
        "command": 0.0,
        "motion_anchor_pos_b": 0.25,
        "motion_anchor_ori_b": 0.05,
        "base_lin_vel": 0.5,
        "base_ang_vel": 0.2,
        "joint_pos": 0.01,
        "joint_vel": 0.5,
        "actions": 0.0,
    }),
    # The same without state estimation, 9 + 5 joint.
    Layout("mjlab154", {
        "command": 0.0,
        "motion_anchor_ori_b": 0.05,
        "base_ang_vel": 0.2,
        "joint_pos": 0.01,
        "joint_vel": 0.5,
        "actions": 0.0,
    }),
    # wbc132 with the reference's floating base in the anchor's place; earlier shipped bases have it.
    Layout("root132", {
        "ref_root_height": 0.01,
        "ref_root_lin_vel_b": (0.1, 0.1, 0.05),
        "ref_root_ang_vel_b": (0.2, 0.2, 0.3),
        "ref_root_gravity_b": 0.02,
        "ref_joint_pos": 0.05,
        "base_ang_vel": 0.2,
        "projected_gravity": 0.05,
        "joint_pos": 0.01,
        "joint_vel": 1.5,
        "actions": 0.0,
    }, body="root"),
)  # fmt: skip
LAYOUTS = {layout.name: layout for layout in _LAYOUTS}

# Layouts of other projects that are not supported: a part of their name, and what they need that is not here.
_HUMANOIDVERSE = "a history of four observations, the phase of the clip, and a scale for each term"
UNSUPPORTED = {
    "humanoidverse": _HUMANOIDVERSE,
    "asap": _HUMANOIDVERSE,
    "pbhc": _HUMANOIDVERSE,
    "380": _HUMANOIDVERSE,
    "holosoma": "its terms in the order of their names",
    "history": "a history of earlier observations",
}


def find_layout(name: str) -> Layout:
    """The layout called `name`.

    Raises:
        InputError: there is none; of one that is known but not supported, what it needs that is missing.
    """
    if name in LAYOUTS:
        return LAYOUTS[name]
    needs = next((needs for part, needs in UNSUPPORTED.items() if part in name.lower()), None)
    if needs:
        raise InputError(
            f"observation.layout: '{name}' is not supported: it needs {needs}; accepted: {', '.join(LAYOUTS)}"
        )
    raise InputError(f"observation.layout: no layout '{name}'; {nearest(name, LAYOUTS)}")
