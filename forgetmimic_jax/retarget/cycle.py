"""Put a human motion onto even frames in the robot's time, and close the seam of a cyclic one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from forgetmimic_jax.motion.kinematics import heading
from forgetmimic_jax.retarget.deepmimic import HumanMotion
from forgetmimic_jax.retarget.planar import PlanarTransform, turn, wrap_angle

# A recorded gait that should go straight ends a few degrees off; a deliberate turn is larger than this.
STRAIGHT_YAW = np.radians(30.0)


def resampled(motion: HumanMotion, fps: float, time_scale: float) -> tuple[HumanMotion, PlanarTransform | None]:
    """The motion at `fps` after stretching time by `time_scale`, and the planar step from cycle to cycle.

    A cyclic motion is given a whole number of frames a cycle (its last frame, which repeats the first, is left out),
    so that tiling needs no further interpolation. A motion that does not repeat returns no step. Interpolation is
    cubic: the keyframed clips come at 16 to 30 frames per s, where straight lines would kink.
    """
    if motion.cyclic:
        motion, step = _closed(motion)
        count = max(2, round(motion.times[-1] * time_scale * fps))
        times = np.arange(count) * motion.times[-1] / count
    else:
        step = None
        count = int(np.floor(motion.times[-1] * time_scale * fps + 1e-6)) + 1
        times = np.minimum(np.arange(count) / (fps * time_scale), motion.times[-1])
    return replace(
        motion,
        times=np.arange(count) / fps,
        root_pos=CubicSpline(motion.times, motion.root_pos)(times),
        rotations={name: RotationSpline(motion.times, turns)(times) for name, turns in motion.rotations.items()},
    ), step


def _closed(motion: HumanMotion) -> tuple[HumanMotion, PlanarTransform]:
    """Spread what the last frame misses of the first, moved by the cycle's step, evenly over the cycle."""
    root = motion.rotations["root"]
    yaw = float(wrap_angle(heading((root[-1] * root[0].inv()).as_quat(scalar_first=True))))
    yaw = 0.0 if abs(yaw) < STRAIGHT_YAW else yaw
    step = PlanarTransform(yaw, motion.root_pos[-1, :2] - turn(yaw, motion.root_pos[0, :2]))

    phase = motion.times / motion.times[-1]
    rotations = {}
    for name, turns in motion.rotations.items():
        first = step.turn(turns[0]) if name == "root" else turns[0]
        missing = (turns[-1].inv() * first).as_rotvec()
        # Half of it at either end: the least change of any frame.
        rotations[name] = turns * Rotation.from_rotvec((phase - 0.5)[:, None] * missing)
    root_pos = motion.root_pos.copy()
    root_pos[:, 2] += (phase - 0.5) * (root_pos[0, 2] - root_pos[-1, 2])
    return replace(motion, root_pos=root_pos, rotations=rotations), step
