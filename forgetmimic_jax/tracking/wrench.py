"""The assistive wrench: a computed-torque pull of the anchor towards the reference (paper, 'Standard AW')."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from forgetmimic_jax.basics import rotation
from forgetmimic_jax.physics import BodyState
from forgetmimic_jax.robot.model import RobotArrays
from forgetmimic_jax.settings.config import WrenchConfig
from forgetmimic_jax.tracking.reference import AnchorMotion


def wrench_gain(config: WrenchConfig, failure_level: Array) -> Array:
    """β = clamp(1 − (1 − L)/η, 0, β_max), of any shape."""
    return jnp.clip(1.0 - (1.0 - failure_level) / config.sensitivity, 0.0, config.max_gain)


def reference_wrench(
    config: WrenchConfig, robot: RobotArrays, reference: AnchorMotion, bodies: BodyState, anchor: int
) -> Array:
    """Force and torque [env, 6] (N, N m; world frame) that would carry the anchor along the reference.

    F = M (a_ref + k_p e_p + k_d e_v − g); τ = I_w (α_ref + k_R e_R + k_ω e_ω) + ω × I_w ω, with M the robot's mass and
    I_w its inertia, turned to the world by the anchor. The paper names a computed-torque controller and gives no
    formula; docs/method.md says how wbc-mjlab's differs.
    """
    quat, ang_vel = bodies.quat[:, anchor], bodies.ang_vel[:, anchor]
    position_pull = config.position_stiffness * (reference.pos - bodies.pos[:, anchor])
    position_pull += config.position_damping * (reference.lin_vel - bodies.lin_vel[:, anchor])
    orientation_pull = config.orientation_stiffness * rotation.difference(reference.quat, quat)
    orientation_pull += config.orientation_damping * (reference.ang_vel - ang_vel)

    def inertia(vector: Array) -> Array:
        return rotation.rotate(quat, rotation.rotate_inverse(quat, vector) @ robot.inertia.T)

    torque = inertia(reference.ang_acc + orientation_pull) + jnp.cross(ang_vel, inertia(ang_vel))
    force = robot.mass * (reference.lin_acc + position_pull - robot.gravity)
    return jnp.concatenate([force, torque], axis=-1)
