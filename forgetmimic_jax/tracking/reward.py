"""Reward terms (paper, equation of the exponential kernels and table of reward terms).

Tracking: R_track = Σ_j w_j r_j with r_j = exp(−κ_j e_j / σ_j²). Terms the paper calls "per keybody (sum)" or
"/ joint" have σ_eff = σ √n on the summed error, which is the mean squared error over σ².
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from flax import struct
from jax import Array

from forgetmimic_jax.basics import rotation
from forgetmimic_jax.motion.library import Frames
from forgetmimic_jax.physics import BodyState, PhysicsState
from forgetmimic_jax.robot.model import RobotArrays
from forgetmimic_jax.settings.config import RewardConfig
from forgetmimic_jax.tracking.reference import AlignedBodies


@struct.dataclass
class Pair:
    """A robot and the reference frame that it is compared with."""

    reference: Frames
    aligned: AlignedBodies  # the reference's key bodies, moved to the robot's anchor
    bodies: BodyState  # the robot's
    joint_pos: Array  # [env, joint] rad, the robot's
    joint_vel: Array  # [env, joint] rad/s
    anchor: int = struct.field(pytree_node=False)  # index of the anchor among the key bodies


class TrackingTerm(NamedTuple):
    """One tracking term r = exp(−κ e / σ²). Its weight is the field of the same name in RewardConfig."""

    name: str
    kappa: float
    sigma: float
    error: Callable[[Pair], Array]  # e [env], in the square of σ's unit


def _square(error: Array) -> Array:
    return jnp.sum(error**2, axis=-1)


def _angle(a: Array, b: Array) -> Array:
    return rotation.angle_between(a, b) ** 2


# "Body frame" in the paper's root velocities is the robot's for both sides, which leaves the norm of the world-frame
# difference.
TERMS: tuple[TrackingTerm, ...] = (
    TrackingTerm("root_position", 0.25, 0.4,  # m
                 lambda p: _square(p.reference.bodies.pos - p.bodies.pos)[:, p.anchor]),
    TrackingTerm("root_orientation", 0.25, 0.5,  # rad
                 lambda p: _angle(p.reference.bodies.quat, p.bodies.quat)[:, p.anchor]),
    TrackingTerm("root_linear_velocity", 0.25, 0.6,  # m/s
                 lambda p: _square(p.reference.bodies.lin_vel - p.bodies.lin_vel)[:, p.anchor]),
    TrackingTerm("root_angular_velocity", 0.25, 1.5,  # rad/s
                 lambda p: _square(p.reference.bodies.ang_vel - p.bodies.ang_vel)[:, p.anchor]),
    TrackingTerm("body_position", 0.25, 0.2,  # m
                 lambda p: _square(p.aligned.pos - p.bodies.pos).mean(-1)),
    TrackingTerm("body_orientation", 0.25, 0.4,  # rad
                 lambda p: _angle(p.aligned.quat, p.bodies.quat).mean(-1)),
    TrackingTerm("body_linear_velocity", 1.0, 1.0,  # m/s
                 lambda p: _square(p.reference.bodies.lin_vel - p.bodies.lin_vel).mean(-1)),
    TrackingTerm("body_angular_velocity", 1.0, 3.14,  # rad/s
                 lambda p: _square(p.reference.bodies.ang_vel - p.bodies.ang_vel).mean(-1)),
    TrackingTerm("joint_position", 0.25, 0.3,  # rad
                 lambda p: ((p.reference.joint_pos - p.joint_pos) ** 2).mean(-1)),
    TrackingTerm("joint_velocity", 0.25, 2.0,  # rad/s
                 lambda p: ((p.reference.joint_vel - p.joint_vel) ** 2).mean(-1)),
)  # fmt: skip


@struct.dataclass
class Reward:
    """The parts of one step's reward, per second of simulated time (PPO multiplies them by the control step)."""

    tracking: Array  # [env] R_track
    regularisation: Array  # [env] R_reg
    normalized_tracking: Array  # [env] r̄ in [0, 1]
    terms: dict[str, Array]  # [env] r_j of every tracking term, also of those with weight 0


def tracking_weights(config: RewardConfig) -> dict[str, float]:
    """Weights w_j > 0 of the tracking terms."""
    weights = {term.name: getattr(config, term.name) for term in TERMS}
    return {name: weight for name, weight in weights.items() if weight > 0}


def total_tracking_weight(config: RewardConfig) -> float:
    """W = Σ_{w_j > 0} w_j; 8 with the paper's weights."""
    return sum(tracking_weights(config).values())


def tracking_kernels(pair: Pair) -> dict[str, Array]:
    """r_j [env] in [0, 1] of every tracking term."""
    return {term.name: jnp.exp(-term.kappa * term.error(pair) / term.sigma**2) for term in TERMS}


def tracking_reward(kernels: dict[str, Array], config: RewardConfig) -> tuple[Array, Array]:
    """R_track = Σ_j w_j r_j [env] and r̄ = R_track / W [env] in [0, 1]."""
    weights = tracking_weights(config)
    tracking = jnp.stack([weight * kernels[name] for name, weight in weights.items()]).sum(0)
    return tracking, tracking / total_tracking_weight(config)


def regularisation_reward(
    robot: RobotArrays,
    config: RewardConfig,
    *,
    action: Array,
    last_action: Array,
    joint_target: Array,
    physics: PhysicsState,
) -> Array:
    """R_reg [env] (paper, 'Regularization Rewards').

    Args:
        robot: constants.
        config: weights.
        action: [env, joint] this step's.
        last_action: [env, joint] the step before.
        joint_target: [env, joint] rad, of the PD loops in this step.
        physics: after the step.
    """
    joint_pos, joint_vel, joint_acc = physics.qpos[:, 7:], physics.qvel[:, 6:], physics.warmstart[:, 6:]
    torque = jnp.clip(
        robot.stiffness * (joint_target - joint_pos) - robot.damping * joint_vel, -robot.effort, robot.effort
    )
    over_limit = jnp.maximum(robot.soft_lower - joint_pos, 0.0) + jnp.maximum(joint_pos - robot.soft_upper, 0.0)
    over_torque = jnp.maximum(jnp.abs(torque) / robot.effort - config.torque_soft_ratio, 0.0)
    return (
        config.survival
        + config.action_rate_l1 * jnp.abs(action - last_action).sum(-1)
        + config.joint_acceleration * jnp.abs(joint_acc).sum(-1)
        + config.joint_limit * over_limit.sum(-1)
        + config.torque_limit * over_torque.sum(-1)
    )
