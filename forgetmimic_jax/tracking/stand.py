"""The stand reference: the robot's default pose at its standing height, at rest. And what counts as a fall from it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from forgetmimic_jax.basics import rotation
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.library import Frames, MotionLibrary, build_library
from forgetmimic_jax.robot.bodies import Bodies
from forgetmimic_jax.robot.model import Robot

STAND = "stand"  # the name of its clip
FALL_HEIGHT = 0.5  # of the root's standing height
FALL_TILT = np.pi / 3  # rad, of the anchor from upright


def stand_library(robot: Robot, frames: int = 2, fps: float = 50.0) -> MotionLibrary:
    """A library whose only clip is the stand: at the world's origin, heading along x, for `frames` frames."""
    clip = Clip(
        name=STAND,
        fps=fps,
        joint_names=robot.joint_names,
        root_pos=np.tile([0.0, 0.0, robot.default_height], (frames, 1)),
        root_quat=np.tile([1.0, 0.0, 0.0, 0.0], (frames, 1)),
        joint_pos=np.tile(np.asarray(robot.arrays.default_joint_pos, np.float64), (frames, 1)),
    )
    return build_library(robot, [clip], fps)


def stand_frame(robot: Robot) -> Frames:
    """The stand as one frame, without a leading dimension: at the world's origin, heading along x."""
    return jax.tree.map(lambda values: values[0], stand_library(robot).frames)


def low(robot: Robot, bodies: Bodies) -> Array:
    """bool[env]: the root is below half of its standing height.

    Args:
        robot: whose bodies they are.
        bodies: [env, key_body].
    """
    return bodies.pos[:, robot.root, 2] < FALL_HEIGHT * robot.default_height


def tilted(robot: Robot, bodies: Bodies) -> Array:
    """bool[env]: the anchor is tilted by more than 60 degrees; arguments as in `low`."""
    quat = bodies.quat[:, robot.anchor]
    up = rotation.rotate(quat, jnp.zeros_like(bodies.pos[:, robot.anchor]).at[:, 2].set(1.0))
    return up[:, 2] < np.cos(FALL_TILT)


def tilted_unlike_clip(robot: Robot, bodies: Bodies, clip: Bodies) -> Array:
    """bool[env]: the anchor is tilted by more than 60 degrees and the clip's is not.

    A cartwheel or a high kick tilts the anchor itself, which is no fall.

    Args:
        robot: whose bodies they are.
        bodies: [env, key_body] the robot's.
        clip: [env, key_body] those of the clip's frame.
    """
    return tilted(robot, bodies) & ~tilted(robot, clip)


def falls(robot: Robot, before: Bodies, after: Bodies, clip_before: Bodies, clip_after: Bodies) -> Array:
    """bool[env]: a robot that was not low before a step is low after it, or begins to be tilted unlike the clip.

    A robot that lies does not fall, also where the clip gets up. One that leans in the middle of a kick falls when it
    is low, or when the clip no longer leans. Arguments as in `tilted_unlike_clip`.
    """
    stood = ~low(robot, before)
    tilts = tilted_unlike_clip(robot, after, clip_after) & ~tilted_unlike_clip(robot, before, clip_before)
    return stood & (low(robot, after) | tilts)
