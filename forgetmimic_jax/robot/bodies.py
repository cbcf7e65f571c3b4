"""The motion of a robot's bodies: one type for the clips, the reference and the simulation."""

from __future__ import annotations

from typing import Any, TypeAlias

from flax import struct

Values: TypeAlias = Any  # a JAX array; in the motion tools a NumPy array


@struct.dataclass
class Bodies:
    """Poses and velocities of bodies, world frame; velocities at the body's origin. Leading dimensions are free."""

    pos: Values  # [..., body, 3] m
    quat: Values  # [..., body, 4] wxyz
    lin_vel: Values  # [..., body, 3] m/s
    ang_vel: Values  # [..., body, 3] rad/s
