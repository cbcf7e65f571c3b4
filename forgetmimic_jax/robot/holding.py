"""Whether a robot holds its default pose under its own PD gains: the first thing to know of a new one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from forgetmimic_jax.robot.model import Robot

# The G1 tilts by 15 degrees in 1 s, the H2 by 13: without a policy a humanoid slowly falls.
MAX_TILT = 30.0  # degrees
MAX_DROP = 0.15  # of the default height
MAX_ERROR = 0.8  # rad
SECONDS = 1.0
# MuJoCo finds these where a simulation diverges. Then it starts again at time 0.
DIVERGED = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)


@dataclass(frozen=True)
class Held:
    """Where a robot is after a second of holding its default pose."""

    tilt: float  # degrees of the root from upright; it and the next two are NaN where the simulation diverges
    drop: float  # m of the root
    error: float  # rad, the joint furthest from its target
    stands: bool

    def __str__(self) -> str:
        if math.isnan(self.tilt):
            return "the simulation diverges; masses, inertias, places of bodies or gains may be wrong"
        return (
            f"root tilted by {self.tilt:.0f} degrees, {self.drop:.3f} m lower, joints at most {self.error:.2f} rad off"
        )


def hold(robot: Robot) -> Held:
    """Simulate a second of the default pose, standing on the ground, as the joint targets of the PD gains."""
    model, data = robot.model, mujoco.MjData(robot.model)
    joint_target = np.asarray(robot.arrays.default_joint_pos, np.float64)
    data.qpos[:7], data.qpos[7:] = [0.0, 0.0, robot.default_height, 1.0, 0.0, 0.0, 0.0], joint_target
    data.ctrl[:] = joint_target
    mujoco.set_mju_user_warning(lambda message: None)  # else it writes a file where the command runs
    for _ in range(math.ceil(SECONDS / model.opt.timestep)):
        mujoco.mj_step(model, data)
        if any(data.warning[warning].number for warning in DIVERGED):
            return Held(math.nan, math.nan, math.nan, stands=False)
    upright = float(np.clip(data.xmat[1].reshape(3, 3)[2, 2], -1.0, 1.0))
    tilt, drop = float(np.degrees(np.arccos(upright))), robot.default_height - float(data.qpos[2])
    error = float(np.abs(data.qpos[7:] - joint_target).max())
    stands = tilt < MAX_TILT and abs(drop) < MAX_DROP * robot.default_height and error < MAX_ERROR
    return Held(tilt, drop, error, stands)
