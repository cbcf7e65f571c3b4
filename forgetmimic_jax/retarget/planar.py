"""Motion in the plane: headings, the step from cycle to cycle, and the tiling of a cycle."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.kinematics import quaternion, rotation


def wrap_angle(angle: np.ndarray) -> np.ndarray:
    """Angle mapped to [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


class PlanarTransform(NamedTuple):
    """A turn by `yaw` rad about the world's z, then a shift [2] m in the plane."""

    yaw: float
    shift: np.ndarray

    def power(self, count: int) -> PlanarTransform:
        """The transform applied `count` times."""
        result = PlanarTransform(0.0, np.zeros(2))
        for _ in range(count):
            result = PlanarTransform(result.yaw + self.yaw, turn(self.yaw, result.shift) + self.shift)
        return result

    def apply(self, pos: np.ndarray) -> np.ndarray:
        """Positions [..., 3] moved."""
        return np.concatenate([turn(self.yaw, pos[..., :2]) + self.shift, pos[..., 2:]], axis=-1)

    def turn(self, turns: Rotation) -> Rotation:
        """Orientations turned."""
        return Rotation.from_rotvec([0.0, 0.0, self.yaw]) * turns


def turn(yaw: float, plane: np.ndarray) -> np.ndarray:
    """Planar vectors [..., 2] turned by yaw rad."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return plane @ np.array([[cosine, sine], [-sine, cosine]])


def tile(clip: Clip, step: PlanarTransform, seconds: float) -> Clip:
    """Repeat one cycle until `seconds` are full.

    The cycle holds frames 0 … n-1; frame n would be frame 0 moved by `step`. Each further cycle is the first one
    moved by `step` once more, so a cycle whose motion is smooth across that seam is smooth for the whole clip.
    """
    count = round(seconds * clip.fps)
    cycles = -(-count // clip.num_frames)
    moves = [step.power(cycle) for cycle in range(cycles)]
    turns = rotation(clip.root_quat)
    return Clip(
        name=clip.name,
        fps=clip.fps,
        joint_names=clip.joint_names,
        root_pos=np.concatenate([move.apply(clip.root_pos) for move in moves])[:count],
        root_quat=quaternion(Rotation.concatenate([move.turn(turns) for move in moves])[:count]),
        joint_pos=np.tile(clip.joint_pos, (cycles, 1))[:count],
    )
