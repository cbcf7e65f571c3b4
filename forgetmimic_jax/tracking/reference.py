"""The reference frame that an environment tracks, between two frames, and moved to the robot's anchor."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from flax import struct
from jax import Array

from forgetmimic_jax.basics import rotation
from forgetmimic_jax.basics.rows import select_rows
from forgetmimic_jax.motion.library import Frames, MotionLibrary
from forgetmimic_jax.robot.bodies import Bodies


def lookup(library: MotionLibrary, clip: Array, frame: Array) -> Frames:
    """Frame `frame` [env] of clip `clip` [env]; past a clip's end its last frame, held at rest."""
    last = library.length[clip] - 1
    return _at_rest_where(frame > last, library.at(clip, frame))


def _at_rest_where(mask: Array, reference: Frames) -> Frames:
    """The reference [env] without velocities and accelerations where mask [env]."""

    def rest(values: Array) -> Array:
        return select_rows(mask, jnp.zeros_like(values), values)

    bodies = reference.bodies
    return Frames(
        joint_pos=reference.joint_pos,
        joint_vel=rest(reference.joint_vel),
        bodies=Bodies(bodies.pos, bodies.quat, rest(bodies.lin_vel), rest(bodies.ang_vel)),
        anchor_lin_acc=rest(reference.anchor_lin_acc),
        anchor_ang_acc=rest(reference.anchor_ang_acc),
    )


@struct.dataclass
class AnchorMotion:
    """The reference's anchor at one time, which may lie between two frames; world frame."""

    pos: Array  # [env, 3] m
    quat: Array  # [env, 4]
    lin_vel: Array  # [env, 3] m/s
    ang_vel: Array  # [env, 3] rad/s
    lin_acc: Array  # [env, 3] m/s²
    ang_acc: Array  # [env, 3] rad/s²


def anchor_between(
    library: MotionLibrary, anchor: int, clip: Array, frame: Array, fraction: Array | float
) -> AnchorMotion:
    """The anchor at time `frame` + `fraction` of each clip: orientations by slerp, all else linearly.

    Args:
        library: the clips.
        anchor: index of the anchor among the key bodies.
        clip: [env].
        frame: [env].
        fraction: of the way to the next frame, 0 to 1, the same for every environment.
    """
    now, following = lookup(library, clip, frame), lookup(library, clip, frame + 1)

    def between(here: Array, there: Array) -> Array:
        return here + fraction * (there - here)

    return AnchorMotion(
        pos=between(now.bodies.pos[:, anchor], following.bodies.pos[:, anchor]),
        quat=rotation.slerp(now.bodies.quat[:, anchor], following.bodies.quat[:, anchor], fraction),
        lin_vel=between(now.bodies.lin_vel[:, anchor], following.bodies.lin_vel[:, anchor]),
        ang_vel=between(now.bodies.ang_vel[:, anchor], following.bodies.ang_vel[:, anchor]),
        lin_acc=between(now.anchor_lin_acc, following.anchor_lin_acc),
        ang_acc=between(now.anchor_ang_acc, following.anchor_ang_acc),
    )


@struct.dataclass
class AlignedBodies:
    """Poses of the reference's key bodies after moving it to the robot's anchor in x, y and yaw (height stays)."""

    pos: Array  # [env, key_body, 3]
    quat: Array  # [env, key_body, 4]


def align_to_anchor(reference: Frames, anchor: int, anchor_pos: Array, anchor_quat: Array) -> AlignedBodies:
    """Move the reference so that its anchor has the robot's x, y and yaw.

    Args:
        reference: the frame tracked.
        anchor: index of the anchor among the key bodies.
        anchor_pos: [env, 3] the robot's anchor.
        anchor_quat: [env, 4].
    """
    ref_pos, ref_quat = reference.bodies.pos[:, anchor], reference.bodies.quat[:, anchor]
    turn = rotation.yaw_only(rotation.multiply(anchor_quat, rotation.conjugate(ref_quat)))[:, None]
    origin = jnp.concatenate([anchor_pos[:, :2], ref_pos[:, 2:]], axis=-1)[:, None]
    return AlignedBodies(
        pos=origin + rotation.rotate(turn, reference.bodies.pos - ref_pos[:, None]),
        quat=rotation.multiply(turn, reference.bodies.quat),
    )


def at_anchor(reference: Frames, anchor: int, anchor_pos: Array, anchor_quat: Array) -> Frames:
    """The whole reference [env], its velocities too, moved as by `align_to_anchor`, with the same arguments."""
    aligned = align_to_anchor(reference, anchor, anchor_pos, anchor_quat)
    ref_quat = reference.bodies.quat[:, anchor]
    turn = rotation.yaw_only(rotation.multiply(anchor_quat, rotation.conjugate(ref_quat)))
    bodies = Bodies(
        pos=aligned.pos,
        quat=aligned.quat,
        lin_vel=rotation.rotate(turn[:, None], reference.bodies.lin_vel),
        ang_vel=rotation.rotate(turn[:, None], reference.bodies.ang_vel),
    )
    return dataclasses.replace(
        reference,
        bodies=bodies,
        anchor_lin_acc=rotation.rotate(turn, reference.anchor_lin_acc),
        anchor_ang_acc=rotation.rotate(turn, reference.anchor_ang_acc),
    )
