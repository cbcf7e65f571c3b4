"""Quaternion algebra in JAX. Quaternions are scalar first (w, x, y, z); leading dimensions are free."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array


def normalize(quat: Array) -> Array:
    """Unit quaternion [..., 4]; a zero quaternion stays finite."""
    return quat / jnp.maximum(jnp.linalg.norm(quat, axis=-1, keepdims=True), 1e-9)


def multiply(a: Array, b: Array) -> Array:
    """Hamilton product a ∘ b of [..., 4]: first b, then a."""
    aw, ax, ay, az = jnp.moveaxis(a, -1, 0)
    bw, bx, by, bz = jnp.moveaxis(b, -1, 0)
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def conjugate(quat: Array) -> Array:
    """Inverse of a unit quaternion [..., 4]."""
    return quat * jnp.array([1.0, -1.0, -1.0, -1.0], quat.dtype)


def rotate(quat: Array, vector: Array) -> Array:
    """Vector [..., 3] turned by quat [..., 4] (body to world)."""
    w, xyz = quat[..., :1], quat[..., 1:]
    t = 2.0 * jnp.cross(xyz, vector)
    return vector + w * t + jnp.cross(xyz, t)


def rotate_inverse(quat: Array, vector: Array) -> Array:
    """Vector [..., 3] turned by the inverse of quat [..., 4] (world to body)."""
    return rotate(conjugate(quat), vector)


def from_rotation_vector(vector: Array) -> Array:
    """Quaternion [..., 4] of a rotation vector [..., 3] in rad."""
    angle = jnp.linalg.norm(vector, axis=-1, keepdims=True)
    half = 0.5 * angle
    scale = jnp.where(angle > 1e-6, jnp.sin(half) / jnp.maximum(angle, 1e-6), 0.5 - angle**2 / 48.0)
    return jnp.concatenate([jnp.cos(half), scale * vector], axis=-1)


def to_rotation_vector(quat: Array) -> Array:
    """Shortest rotation vector [..., 3] in rad of a unit quaternion [..., 4]."""
    quat = jnp.where(quat[..., :1] < 0.0, -quat, quat)
    sine = jnp.linalg.norm(quat[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * jnp.arctan2(sine, quat[..., :1])
    return quat[..., 1:] * jnp.where(sine > 1e-6, angle / jnp.maximum(sine, 1e-6), 2.0)


def difference(a: Array, b: Array) -> Array:
    """World-frame rotation vector [..., 3] in rad that takes b to a."""
    return to_rotation_vector(multiply(a, conjugate(b)))


def slerp(a: Array, b: Array, fraction: Array | float) -> Array:
    """Orientation [..., 4] on the shortest way from a to b at constant speed: `fraction` [..., 1] 0 is a, 1 is b."""
    return multiply(from_rotation_vector(fraction * difference(b, a)), a)


def angle_between(a: Array, b: Array) -> Array:
    """Angle [...] in rad, 0 to π, between two orientations."""
    relative = multiply(a, conjugate(b))
    return 2.0 * jnp.arctan2(jnp.linalg.norm(relative[..., 1:], axis=-1), jnp.abs(relative[..., 0]))


def from_euler(rpy: Array) -> Array:
    """Quaternion [..., 4] of roll, pitch, yaw [..., 3] in rad: first about x, then y, then z, the fixed axes."""
    cr, cp, cy = jnp.moveaxis(jnp.cos(rpy / 2), -1, 0)
    sr, sp, sy = jnp.moveaxis(jnp.sin(rpy / 2), -1, 0)
    return jnp.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        axis=-1,
    )


def yaw_only(quat: Array) -> Array:
    """The rotation about the world's z [..., 4] contained in quat (its twist; exact for a pure yaw)."""
    w, z = quat[..., 0], quat[..., 3]
    zero = jnp.zeros_like(w)
    length = jnp.sqrt(w**2 + z**2)
    identity = length < 1e-6
    return jnp.stack(
        [
            jnp.where(identity, 1.0, w / jnp.maximum(length, 1e-6)),
            zero,
            zero,
            jnp.where(identity, 0.0, z / jnp.maximum(length, 1e-6)),
        ],
        axis=-1,
    )


def to_matrix_columns(quat: Array) -> Array:
    """First two columns of the rotation matrix, flattened to [..., 6]: a continuous orientation feature."""
    x = rotate(quat, jnp.broadcast_to(jnp.array([1.0, 0.0, 0.0], quat.dtype), (*quat.shape[:-1], 3)))
    y = rotate(quat, jnp.broadcast_to(jnp.array([0.0, 1.0, 0.0], quat.dtype), (*quat.shape[:-1], 3)))
    return jnp.concatenate([x, y], axis=-1)
