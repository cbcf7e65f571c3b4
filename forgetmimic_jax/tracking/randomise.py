"""Reset noise, pushes and model randomisation: uniform draws in the ranges of NoiseConfig."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from forgetmimic_jax.basics import rotation
from forgetmimic_jax.motion.library import Frames
from forgetmimic_jax.physics import PhysicsParameters, PhysicsState
from forgetmimic_jax.robot.model import RobotArrays
from forgetmimic_jax.settings.config import NoiseConfig


def symmetric(key: Array, num_envs: int, half_width) -> Array:
    """Uniform in ± half_width: [env, len(half_width)]."""
    half_width = jnp.asarray(half_width, jnp.float32)
    return half_width * jax.random.uniform(key, (num_envs, half_width.size), minval=-1.0, maxval=1.0)


def reset_state(config: NoiseConfig, robot: RobotArrays, reference: Frames, root: int, key: Array) -> PhysicsState:
    """The reference frame as a physics state, with reset noise; the noise keeps joints inside their soft limits."""
    num_envs, num_joints = reference.joint_pos.shape
    keys = jax.random.split(key, 5)
    pos = reference.bodies.pos[:, root] + symmetric(keys[0], num_envs, config.reset_position)
    turn = rotation.from_euler(symmetric(keys[1], num_envs, config.reset_orientation))
    quat = rotation.multiply(turn, reference.bodies.quat[:, root])
    lin_vel = reference.bodies.lin_vel[:, root] + symmetric(keys[2], num_envs, config.reset_linear_velocity)
    ang_vel = reference.bodies.ang_vel[:, root] + symmetric(keys[3], num_envs, config.reset_angular_velocity)
    joints = reference.joint_pos + symmetric(keys[4], num_envs, (config.reset_joint_position,) * num_joints)
    # A reference that is itself outside its soft limits keeps its own value.
    lower = jnp.minimum(robot.soft_lower, reference.joint_pos)
    upper = jnp.maximum(robot.soft_upper, reference.joint_pos)
    qvel = jnp.concatenate([lin_vel, rotation.rotate_inverse(quat, ang_vel), reference.joint_vel], axis=-1)
    return PhysicsState(
        qpos=jnp.concatenate([pos, quat, jnp.clip(joints, lower, upper)], axis=-1),
        qvel=qvel,
        warmstart=jnp.zeros_like(qvel),
    )


def push(config: NoiseConfig, key: Array, state: PhysicsState) -> Array:
    """qvel [env, 6 + joint] after a random change of the base's velocity in the reset ranges, world frame."""
    linear_key, angular_key = jax.random.split(key)
    num_envs = len(state.qvel)
    linear = symmetric(linear_key, num_envs, config.reset_linear_velocity)
    angular = symmetric(angular_key, num_envs, config.reset_angular_velocity)
    angular = rotation.rotate_inverse(state.qpos[:, 3:7], angular)
    return state.qvel.at[:, :6].add(jnp.concatenate([linear, angular], axis=-1))


def push_interval(config: NoiseConfig, key: Array, num_envs: int, control_step: float) -> Array:
    """Control steps until the next push, i32[env]."""
    seconds = jax.random.uniform(key, (num_envs,), minval=config.push_interval[0], maxval=config.push_interval[1])
    return jnp.round(seconds / control_step).astype(jnp.int32)


def physics_parameters(config: NoiseConfig, key: Array, num_envs: int) -> PhysicsParameters:
    """Random sole friction and torso centre of mass."""
    friction_key, com_key = jax.random.split(key)
    low, high = config.foot_friction
    return PhysicsParameters(
        foot_friction=jax.random.uniform(friction_key, (num_envs,), minval=low, maxval=high),
        torso_com=symmetric(com_key, num_envs, config.torso_com),
    )


def nominal_parameters(friction: float, num_envs: int) -> PhysicsParameters:
    """The model's own values."""
    return PhysicsParameters(
        foot_friction=jnp.full((num_envs,), friction, jnp.float32), torso_com=jnp.zeros((num_envs, 3), jnp.float32)
    )
