"""What the actor and the critic see.

The actor knows no clip's name and no global position; the critic is privileged.
The reference shown is the frame that the next action is to reach.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from forgetmimic_jax.basics import rotation
from forgetmimic_jax.motion.library import Frames
from forgetmimic_jax.physics import BodyState, PhysicsState
from forgetmimic_jax.robot.bodies import Bodies
from forgetmimic_jax.robot.model import RobotArrays
from forgetmimic_jax.settings.config import NoiseConfig
from forgetmimic_jax.tracking.randomise import symmetric


def actor_layout(num_joints: int) -> dict[str, int]:
    """Terms of the actor's observation in their order, name → size. The names are wbc-mjlab's for the same terms."""
    return {
        "ref_base_height": 1,
        "ref_base_lin_vel_b": 3,
        "ref_base_ang_vel_b": 3,
        "ref_gravity_b": 3,
        "ref_joint_pos": num_joints,
        "base_ang_vel": 3,
        "projected_gravity": 3,
        "joint_pos": num_joints,
        "joint_vel": num_joints,
        "actions": num_joints,
    }


def actor_size(num_joints: int) -> int:
    """Size of the actor's observation: 132 for 29 joints."""
    return sum(actor_layout(num_joints).values())


def actor_observation(
    robot: RobotArrays, reference: Frames, root: int, physics: PhysicsState, last_action: Array
) -> Array:
    """[env, 16 + 4 joint], without noise or encoder bias.

    Args:
        robot: constants.
        reference: the frame to reach next.
        root: index of the floating base among the key bodies.
        physics: the robot's state.
        last_action: [env, joint].
    """
    ref_quat = reference.bodies.quat[:, root]
    quat = physics.qpos[:, 3:7]
    down = jnp.zeros_like(physics.qpos[:, :3]).at[:, 2].set(-1.0)
    return jnp.concatenate(
        [
            reference.bodies.pos[:, root, 2:],
            rotation.rotate_inverse(ref_quat, reference.bodies.lin_vel[:, root]),
            rotation.rotate_inverse(ref_quat, reference.bodies.ang_vel[:, root]),
            rotation.rotate_inverse(ref_quat, down),
            reference.joint_pos,
            physics.qvel[:, 3:6],
            rotation.rotate_inverse(rotation.normalize(quat), down),
            physics.qpos[:, 7:] - robot.default_joint_pos,
            physics.qvel[:, 6:],
            last_action,
        ],
        axis=-1,
    )


def observation_noise(config: NoiseConfig, key: Array, num_envs: int, num_joints: int) -> Array:
    """Uniform sensor noise [env, 16 + 4 joint] in the actor's layout."""
    joints = (num_joints,)
    half_width = jnp.concatenate(
        [
            jnp.asarray([config.observation_reference_height]),
            jnp.asarray(config.observation_reference_linear_velocity),
            jnp.asarray(config.observation_reference_angular_velocity),
            jnp.full((3,), config.observation_reference_gravity),
            jnp.full(joints, config.observation_reference_joints),
            jnp.full((3,), config.observation_gyro),
            jnp.full((3,), config.observation_gravity),
            jnp.full(joints, config.observation_joint_position),
            jnp.full(joints, config.observation_joint_velocity),
            jnp.zeros(joints),
        ]
    )
    return symmetric(key, num_envs, half_width)


def critic_observation(
    clean_actor: Array,
    reference: Frames,
    bodies: BodyState,
    anchor: int,
    root: int,
    *,
    wrench: Array,
    wrench_gain: Array,
    phase: Array,
    terms: Array,
) -> Array:
    """Privileged observation [env, features].

    The clean actor observation; position and orientation error of the anchor; key-body poses and velocities of
    reference and robot, each in its own anchor's frame; base linear velocity; the wrench and its gain; the clip's
    phase; the last tracking terms; contact forces of the key bodies as sign·log1p.

    Args:
        clean_actor: [env, 16 + 4 joint].
        reference: the frame to reach next.
        bodies: the robot's key bodies.
        anchor: index of the anchor among the key bodies.
        root: index of the floating base among the key bodies.
        wrench: [env, 6] N, N m.
        wrench_gain: [env] β.
        phase: [env] in [0, 1].
        terms: [env, term] kernels r_j of the last step, in the order of `reward.TERMS`.
    """
    pos, quat = bodies.pos[:, anchor], bodies.quat[:, anchor]
    ref_pos, ref_quat = reference.bodies.pos[:, anchor], reference.bodies.quat[:, anchor]

    def in_frame(origin: Array, frame: Array, of: Bodies) -> list[Array]:
        frame = frame[:, None]
        return [
            rotation.rotate_inverse(frame, of.pos - origin[:, None]).reshape(len(pos), -1),
            rotation.to_matrix_columns(rotation.multiply(rotation.conjugate(frame), of.quat)).reshape(len(pos), -1),
            rotation.rotate_inverse(frame, of.lin_vel).reshape(len(pos), -1),
            rotation.rotate_inverse(frame, of.ang_vel).reshape(len(pos), -1),
        ]

    force = bodies.contact_force.reshape(len(pos), -1)
    return jnp.concatenate(
        [
            clean_actor,
            rotation.rotate_inverse(quat, ref_pos - pos),
            rotation.to_matrix_columns(rotation.multiply(rotation.conjugate(quat), ref_quat)),
            *in_frame(ref_pos, ref_quat, reference.bodies),
            *in_frame(pos, quat, bodies),
            rotation.rotate_inverse(bodies.quat[:, root], bodies.lin_vel[:, root]),
            wrench,
            wrench_gain[:, None],
            phase[:, None],
            terms,
            jnp.sign(force) * jnp.log1p(jnp.abs(force)),
        ],
        axis=-1,
    )
