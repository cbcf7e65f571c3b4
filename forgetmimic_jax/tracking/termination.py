"""Conditions that end an episode early (paper, 'Termination Conditions')."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from forgetmimic_jax.basics import rotation
from forgetmimic_jax.motion.library import Frames
from forgetmimic_jax.physics import BodyState
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.settings.config import TerminationConfig
from forgetmimic_jax.tracking.reference import AlignedBodies


def terminations(
    config: TerminationConfig,
    reference: Frames,
    aligned: AlignedBodies,
    bodies: BodyState,
    robot: Robot,
) -> dict[str, Array]:
    """Which bound each environment breaks: name → bool [env]."""
    anchor, end_effectors = robot.anchor, jnp.asarray(robot.end_effectors)
    ref_quat, quat = reference.bodies.quat[:, anchor], bodies.quat[:, anchor]
    if config.orientation_rule == "gravity_z":
        # Projected gravity's z is minus the z of the body's up axis in the world, so yaw does not matter.
        up = jnp.zeros_like(bodies.pos[:, anchor]).at[:, 2].set(1.0)
        tilt = jnp.abs(rotation.rotate_inverse(ref_quat, up)[:, 2] - rotation.rotate_inverse(quat, up)[:, 2])
    else:
        tilt = rotation.angle_between(ref_quat, quat)
    heights = jnp.abs(aligned.pos[:, end_effectors, 2] - bodies.pos[:, end_effectors, 2])
    forces = jnp.linalg.norm(bodies.contact_force, axis=-1)
    return {
        "anchor_height": jnp.abs(reference.bodies.pos[:, anchor, 2] - bodies.pos[:, anchor, 2]) > config.anchor_height,
        "orientation": tilt > config.orientation,
        "end_effector_height": (heights > config.end_effector_height).any(-1),
        "contact_force": (forces > config.contact_force * robot.weight).any(-1),
    }
