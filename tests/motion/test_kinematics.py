"""Motion arithmetic against scipy and hand-worked motions."""

import dataclasses

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from forgetmimic_jax.motion.clip import Clip, continuous
from forgetmimic_jax.motion.kinematics import (
    angular_velocity,
    body_motion,
    configuration,
    generalized_velocity,
    rate,
    resample,
    rotation,
)


def moving(robot, frames=31, fps=30.0, velocity=(0.4, -0.2, 0.0), spin=(0.0, 0.0, 1.5)):
    """The default pose at constant velocity (m/s) and constant world rotation (rad/s)."""
    time = np.arange(frames)[:, None] / fps
    default = np.asarray(robot.arrays.default_joint_pos, np.float64)
    return Clip(
        "moving",
        fps,
        robot.joint_names,
        np.array([0.0, 0.0, 0.8]) + time * np.array(velocity),
        Rotation.from_rotvec(time * np.array(spin)).as_quat(scalar_first=True),
        np.tile(default, (frames, 1)),
    )


def test_rate_of_a_parabola():
    """d/dt t² = 2 t, exact for central differences inside; one-sided at both ends."""
    time = np.arange(6) / 50.0
    found = rate(time**2, 50.0)
    np.testing.assert_allclose(found[1:-1], 2 * time[1:-1])
    np.testing.assert_allclose(found[[0, -1]], [time[1], 2 * time[-1] - 0.02])


def test_angular_velocity_of_a_constant_rotation():
    spin = np.array([0.3, -1.0, 2.0])
    quat = Rotation.from_rotvec(np.arange(20)[:, None] / 50.0 * spin).as_quat(scalar_first=True)
    np.testing.assert_allclose(angular_velocity(quat, 50.0), np.tile(spin, (20, 1)), atol=1e-9)


def test_angular_velocity_does_not_see_the_quaternion_s_sign():
    quat = Rotation.from_rotvec(np.arange(9)[:, None] * [0.0, 0.0, 0.1]).as_quat(scalar_first=True)
    flipped = quat * np.where(np.arange(9) % 2, -1.0, 1.0)[:, None]
    np.testing.assert_allclose(angular_velocity(flipped, 50.0), angular_velocity(quat, 50.0), atol=1e-9)
    np.testing.assert_allclose(continuous(flipped), quat)


def test_resample_is_scipy_s_slerp(robot):
    rng = np.random.default_rng(0)
    clip = dataclasses.replace(
        moving(robot, frames=10), root_quat=Rotation.random(10, rng=rng).as_quat(scalar_first=True)
    )
    found = resample(clip, 50.0)
    times = np.arange(15) / 50.0  # 0 to 0.28 of 0.30 s
    assert found.num_frames == 16
    expected = Slerp(np.arange(10) / 30.0, Rotation.from_quat(clip.root_quat, scalar_first=True))(times)
    np.testing.assert_allclose((rotation(found.root_quat[:15]).inv() * expected).magnitude(), 0.0, atol=1e-7)


def test_body_motion_at_constant_velocity_and_rotation(robot):
    """Every body turns at the root's rate; its velocity is v + ω × r."""
    clip = moving(robot, fps=50.0)
    motion = body_motion(robot.model, configuration(clip, robot), 50.0, robot.key_body_ids)
    np.testing.assert_allclose(motion.ang_vel, np.broadcast_to([0.0, 0.0, 1.5], motion.ang_vel.shape), atol=1e-6)
    arm = motion.pos - clip.root_pos[:, None]
    expected = np.array([0.4, -0.2, 0.0]) + np.cross([0.0, 0.0, 1.5], arm)
    np.testing.assert_allclose(motion.lin_vel, expected, atol=1e-6)


def test_body_motion_is_mujoco_s_kinematics(robot):
    clip = moving(robot)
    data = mujoco.MjData(robot.model)
    data.qpos[:] = configuration(clip, robot)[7]
    mujoco.mj_kinematics(robot.model, data)
    motion = body_motion(robot.model, configuration(clip, robot), 30.0, robot.key_body_ids)
    np.testing.assert_allclose(motion.pos[7], data.xpos[robot.key_body_ids], atol=1e-12)
    data.qvel[:] = generalized_velocity(configuration(clip, robot), 30.0)[7]
    mujoco.mj_forward(robot.model, data)
    found = np.empty(6)
    for row, body in enumerate(robot.key_body_ids):
        mujoco.mj_objectVelocity(robot.model, data, mujoco.mjtObj.mjOBJ_XBODY, body, found, 0)
        np.testing.assert_allclose(motion.ang_vel[7, row], found[:3], atol=1e-12)
        np.testing.assert_allclose(motion.lin_vel[7, row], found[3:], atol=1e-12)
