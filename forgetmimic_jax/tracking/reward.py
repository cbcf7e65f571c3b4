"""Reward terms (paper, equation of the exponential kernels and table of reward terms).

Tracking: R_track = Σ_j w_j r_j with r_j = exp(−κ_j e_j / σ_j²). Terms the paper calls "per keybody (sum)" or
"/ joint" have σ_eff = σ √n on the summed error, which is the mean squared error over σ².
"""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jax import Array

from forgetmimic_jax.basics import rotation
from forgetmimic_jax.physics import BodyState
from forgetmimic_jax.robot.model import RobotArrays
from forgetmimic_jax.settings.config import RewardConfig
from forgetmimic_jax.tracking.reference import AlignedBodies, Reference

# (κ, σ) of every tracking term; its weight is the field of the same name in RewardConfig.
KERNELS: dict[str, tuple[float, float]] = {
    "root_position": (0.25, 0.4),  # m
    "root_orientation": (0.25, 0.5),  # rad
    "root_linear_velocity": (0.25, 0.6),  # m/s
    "root_angular_velocity": (0.25, 1.5),  # rad/s
    "body_position": (0.25, 0.2),  # m
    "body_orientation": (0.25, 0.4),  # rad
    "body_linear_velocity": (1.0, 1.0),  # m/s
    "body_angular_velocity": (1.0, 3.14),  # rad/s
    "joint_position": (0.25, 0.3),  # rad
    "joint_velocity": (0.25, 2.0),  # rad/s
}


@struct.dataclass
class Reward:
    """The parts of one step's reward, per second of simulated time (PPO multiplies them by the control step)."""

    tracking: Array  # [env] R_track
    regularisation: Array  # [env] R_reg
    normalized_tracking: Array  # [env] r̄ in [0, 1]
    terms: dict[str, Array]  # [env] r_j of the tracking terms


def tracking_weights(config: RewardConfig) -> dict[str, float]:
    """Weights w_j > 0 of the tracking terms."""
    weights = {name: getattr(config, name) for name in KERNELS}
    return {name: weight for name, weight in weights.items() if weight > 0}


def total_tracking_weight(config: RewardConfig) -> float:
    """W = Σ_{w_j > 0} w_j."""
    return sum(tracking_weights(config).values())


def tracking_errors(reference: Reference, aligned: AlignedBodies, bodies: BodyState, anchor: int, joint_pos: Array,
                    joint_vel: Array) -> dict[str, Array]:  # fmt: skip
    """Squared errors e_j [env] of every tracking term.

    Args:
        reference: the frame tracked.
        aligned: its key bodies, moved to the robot's anchor.
        bodies: the robot's key bodies.
        anchor: index of the anchor among the key bodies.
        joint_pos: [env, joint] rad.
        joint_vel: [env, joint] rad/s.
    """

    def squared(error: Array) -> Array:
        return jnp.sum(error**2, axis=-1)

    def of_anchor(error: Array) -> Array:
        return squared(error[:, anchor])

    return {
        "root_position": of_anchor(reference.body_pos - bodies.pos),
        "root_orientation": rotation.angle_between(reference.body_quat[:, anchor], bodies.quat[:, anchor]) ** 2,
        # "Body frame" in the paper is the robot's for both sides, which leaves the norm of the world-frame difference.
        "root_linear_velocity": of_anchor(reference.body_lin_vel - bodies.lin_vel),
        "root_angular_velocity": of_anchor(reference.body_ang_vel - bodies.ang_vel),
        "body_position": squared(aligned.pos - bodies.pos).mean(-1),
        "body_orientation": (rotation.angle_between(aligned.quat, bodies.quat) ** 2).mean(-1),
        "body_linear_velocity": squared(reference.body_lin_vel - bodies.lin_vel).mean(-1),
        "body_angular_velocity": squared(reference.body_ang_vel - bodies.ang_vel).mean(-1),
        "joint_position": ((reference.joint_pos - joint_pos) ** 2).mean(-1),
        "joint_velocity": ((reference.joint_vel - joint_vel) ** 2).mean(-1),
    }


def tracking_reward(errors: dict[str, Array], config: RewardConfig) -> tuple[Array, Array, dict[str, Array]]:
    """R_track [env], r̄ [env] and the kernels r_j [env] of the terms with a positive weight."""
    weights = tracking_weights(config)
    terms = {name: jnp.exp(-KERNELS[name][0] * errors[name] / KERNELS[name][1] ** 2) for name in weights}
    tracking = jnp.stack([weight * terms[name] for name, weight in weights.items()]).sum(0)
    return tracking, tracking / total_tracking_weight(config), terms


def regularisation_reward(
    robot: RobotArrays,
    config: RewardConfig,
    *,
    action: Array,
    last_action: Array,
    joint_pos: Array,
    joint_vel: Array,
    joint_acc: Array,
    target: Array,
) -> Array:
    """R_reg [env] (paper, 'Regularization Rewards').

    Args:
        robot: constants.
        config: weights.
        action: [env, joint] this step's.
        last_action: [env, joint] the step before.
        joint_pos: [env, joint] rad, after the step.
        joint_vel: [env, joint] rad/s, after the step.
        joint_acc: [env, joint] rad/s².
        target: [env, joint] rad, the PD target applied.
    """
    torque = jnp.clip(robot.stiffness * (target - joint_pos) - robot.damping * joint_vel, -robot.effort, robot.effort)
    over_limit = jnp.maximum(robot.soft_lower - joint_pos, 0.0) + jnp.maximum(joint_pos - robot.soft_upper, 0.0)
    over_torque = jnp.maximum(jnp.abs(torque) / robot.effort - config.torque_soft_ratio, 0.0)
    return (
        config.survival
        + config.action_rate_l1 * jnp.abs(action - last_action).sum(-1)
        + config.joint_acceleration * jnp.abs(joint_acc).sum(-1)
        + config.joint_limit * over_limit.sum(-1)
        + config.torque_limit * over_torque.sum(-1)
    )
