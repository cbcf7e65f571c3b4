"""What the actor and the critic see.

The actor sees the terms of its layout (`tracking.layouts`) and knows no clip's name; the critic is privileged. The
reference shown is the frame that the next action is to reach.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from forgetmimic_jax.basics import rotation
from forgetmimic_jax.robot.bodies import Bodies
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.tracking.layouts import Layout, Moment
from forgetmimic_jax.tracking.randomise import symmetric
from forgetmimic_jax.tracking.reward import TERMS as REWARD_TERMS


def actor_observation(layout: Layout, policy_joints: np.ndarray, moment: Moment) -> Array:
    """[env, features] the terms of a layout, without noise or encoder bias.

    Args:
        layout: which terms.
        policy_joints: i[joint] index of each joint of the policy's order.
        moment: robot and reference.
    """
    return jnp.concatenate(
        [
            in_policy_order(term.values(moment), policy_joints) if term.per_joint else term.values(moment)
            for term in layout.terms
        ],
        axis=-1,
    )


def in_policy_order(values: Array, policy_joints: np.ndarray) -> Array:
    """Values [env, n · joint], n lists of joints in the robot's order, in the policy's order of joints."""
    return values.reshape(len(values), -1, len(policy_joints))[..., policy_joints].reshape(values.shape)


def sensor_noise(layout: Layout, factor: float, key: Array, encoder_bias: Array) -> Array:
    """What sensors add to an actor observation [env, features]: uniform noise, and the bias of the joint encoders.

    Args:
        layout: with the half-width of each term's noise.
        factor: times these half-widths.
        key: of the noise.
        encoder_bias: [env, joint] rad, in the policy's order of joints.
    """
    num_envs, joints = encoder_bias.shape
    widths = [np.broadcast_to(layout.sensor_noise[term.name], term.size(joints)) for term in layout.terms]
    bias = [
        encoder_bias if term.encoder else jnp.zeros((num_envs, term.size(joints)), jnp.float32) for term in layout.terms
    ]
    return symmetric(key, num_envs, factor * np.concatenate(widths)) + jnp.concatenate(bias, axis=-1)


def critic_size(layout: Layout, robot: Robot) -> int:
    """Numbers in a critic observation: 20 of anchor, base, wrench and phase, and 33 of each key body."""
    return layout.size(robot.num_joints) + 20 + len(REWARD_TERMS) + 33 * len(robot.key_bodies)


def critic_observation(
    clean_actor: Array,
    moment: Moment,
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
        clean_actor: [env, features] the actor's, without noise.
        moment: robot and reference.
        wrench: [env, 6] N, N m.
        wrench_gain: [env] β.
        phase: [env] in [0, 1].
        terms: [env, term] kernels r_j of the last step, in the order of `reward.TERMS`.
    """
    reference, bodies, anchor, root = moment.reference, moment.bodies, moment.anchor, moment.root
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
