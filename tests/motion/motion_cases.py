"""An invented motion for tests of files and folders."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.kinematics import configuration
from forgetmimic_jax.motion.readers import read_motion
from forgetmimic_jax.motion.recording import Reading


def waving(robot, name, frames, yaw_rate=0.0, fps=50.0):
    """The default pose, walking at 0.3 m/s and turning at yaw_rate rad/s, every joint waving by 0.05 rad."""
    time = np.arange(frames) / fps
    joints = np.asarray(robot.arrays.default_joint_pos) + 0.05 * np.sin(
        2.0 * np.pi * time[:, None] + np.arange(robot.num_joints)
    )
    turns = Rotation.from_rotvec(yaw_rate * time[:, None] * [0.0, 0.0, 1.0])
    path = np.stack([0.3 * time, np.zeros(frames), np.full(frames, robot.default_height)], axis=-1)
    return Clip(name, fps, robot.joint_names, path, turns.as_quat(scalar_first=True), joints)


def body_positions(robot, clip):
    """Positions [frame, body, 3] in the world of every body of a clip."""
    data, found = mujoco.MjData(robot.model), []
    for qpos in configuration(clip, robot):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(robot.model, data)
        found.append(data.xpos[1:].copy())
    return np.array(found)


def refusal(robot, path, **options):
    """The one line with which a file is refused."""
    with pytest.raises(InputError) as caught:
        read_motion(robot, path, Reading(**options))
    assert "\n" not in str(caught.value)
    return str(caught.value)
