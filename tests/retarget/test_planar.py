"""Steps from cycle to cycle and the tiling of a cycle, on hand-worked paths."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.kinematics import angular_velocity, heading
from forgetmimic_jax.retarget.planar import PlanarTransform, tile, wrap_angle


@pytest.mark.parametrize("yaw", [0.0, 0.5, np.pi])
def test_planar_transform_power(yaw):
    step = PlanarTransform(yaw, np.array([1.0, 2.0]))
    pos = np.array([[0.3, -0.4, 0.9]])
    np.testing.assert_allclose(step.power(3).apply(pos), step.apply(step.apply(step.apply(pos))))


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_tiling_a_motion_that_walks_a_circle_has_no_seam(robot, yaw):
    """A cycle of 25 frames on a circle (a line for yaw 0): tiled, speed and turn rate stay the same throughout."""
    frames, fps = 25, 50.0
    angle = yaw * np.arange(frames + 1) / frames
    path = np.stack([np.sin(angle), 1 - np.cos(angle)], axis=-1) if yaw else np.linspace([0, 0], [1, 0], frames + 1)
    clip = Clip(
        "circle",
        fps,
        robot.joint_names,
        np.concatenate([path[:-1], np.full((frames, 1), 0.8)], axis=-1),
        Rotation.from_rotvec(angle[:-1, None] * [0.0, 0.0, 1.0]).as_quat(scalar_first=True),
        np.tile(np.asarray(robot.arrays.default_joint_pos, np.float64), (frames, 1)),
    )
    clip.joint_pos[:, 0] += 0.1 * np.sin(2 * np.pi * np.arange(frames) / frames)
    tiled = tile(clip, PlanarTransform(yaw, path[-1]), 10.0)
    assert tiled.num_frames == 500
    step = np.linalg.norm(np.diff(tiled.root_pos[:, :2], axis=0), axis=-1)
    np.testing.assert_allclose(step, step[0], atol=1e-9)
    np.testing.assert_allclose(angular_velocity(tiled.root_quat, fps)[:, 2], yaw * fps / frames, atol=1e-6)
    expected = 0.1 * np.sin(2 * np.pi * np.arange(500) / frames)
    np.testing.assert_allclose(tiled.joint_pos[:, 0] - robot.arrays.default_joint_pos[0], expected, atol=1e-6)
    turned = wrap_angle(heading(tiled.root_quat) - yaw * np.arange(500) / frames)
    np.testing.assert_allclose(turned, 0.0, atol=1e-6)
