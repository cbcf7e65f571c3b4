"""Public policies: their joint targets in the environment and in a loop of their own (tests/loops.py).

One policy has mjlab's order of joints, one Isaac Lab's; the third adds its actions to the reference.
"""

import dataclasses
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from loops import (
    Deployed,
    Deployment,
    from_config_yaml,
    from_deploy_yaml,
    from_metadata,
    in_its_own_loop,
    in_the_environment,
)

from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.library import build_library
from forgetmimic_jax.motion.readers import read_motion
from forgetmimic_jax.motion.recording import Reading
from forgetmimic_jax.robot.model import Robot, load_robot
from forgetmimic_jax.settings.config import ActionConfig, ObservationConfig
from forgetmimic_jax.tracking.setup import Setup

STEPS = 50
LAYOUTS = {"spinkick": "mjlab154", "dance": "mjlab154", "wbc": "wbc132"}


def spinkick(folder: Path, robot: Robot) -> tuple[Deployment, Clip]:
    """Metadata, and the clip inside the file, a frame a call."""
    file = folder / "mjlab_spinkick" / "spinkick_safe.onnx"
    deployment = from_metadata(file)
    frames = [frame_of(file)(frame) for frame in range(STEPS + 20)]
    pos, quat, joints = (
        np.stack([frame[name] for frame in frames]).astype(np.float64)
        for name in ("body_pos_w", "body_quat_w", "joint_pos")
    )
    return deployment, Clip("spinkick", 50.0, tuple(deployment.joints), pos[:, 0], quat[:, 0], joints)


def frame_of(file: Path):
    session = onnxruntime.InferenceSession(file)
    names = ["joint_pos", "joint_vel", "body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w"]

    def frame(index: int) -> dict[str, np.ndarray]:
        feed = {"obs": np.zeros((1, 154), np.float32), "time_step": np.full((1, 1), index, np.float32)}
        return {name: value[0] for name, value in zip(names, session.run(names, feed), strict=True)}

    return frame


def dance(folder: Path, robot: Robot) -> tuple[Deployment, Clip]:
    folder = folder / "unitree_rl_lab_dance_102"
    clip = read_motion(robot, folder / "G1_Take_102.bvh_60hz.csv", Reading(fps=60.0)).clip
    return from_deploy_yaml(folder / "policy.onnx", folder / "deploy.yaml", robot), clip


def wbc(folder: Path, robot: Robot) -> tuple[Deployment, Clip]:
    """Its own clips were not handed over: it tracks a short dance of another source."""
    motion = folder.parent / "motions" / "M_ShortMove12.csv"
    folder = folder / "wbc_39eff8a"
    clip = read_motion(robot, motion, Reading(fps=60.0)).clip
    return from_config_yaml(folder / "policy.onnx", folder / "config.yaml"), clip


@pytest.fixture(scope="module", params=[spinkick, dance, wbc], ids=list(LAYOUTS))
def public(request, public_policies, robot):
    """Name, deployment and the library of one clip."""
    deployment, clip = request.param(public_policies, robot)
    return request.param.__name__, deployment, build_library(robot, [clip])


def test_joint_targets_are_those_of_the_policys_own_loop(public, robot, tiny_config):
    name, deployment, library = public
    expected = in_its_own_loop(deployment, robot, library, STEPS)
    assert np.ptp(expected, axis=0).max() > 0.2  # it moves
    tables = {name: getattr(deployment, name) for name in ("scale", "stiffness", "damping")}
    by_joint = {
        name: {joint: float(value) for joint, value in zip(deployment.joints, values, strict=True)}
        for name, values in (tables | {"default_pose": deployment.default}).items()
    }
    action = ActionConfig("residual" if deployment.residual else "offset", tuple(deployment.joints), **by_joint)
    config = dataclasses.replace(tiny_config, observation=ObservationConfig(LAYOUTS[name]), action=action)
    setup = Setup(config, load_robot("g1", config.physics, action), library, "")
    np.testing.assert_allclose(in_the_environment(setup, Deployed(deployment), STEPS), expected, atol=1e-4)


def test_the_clip_inside_the_file_has_the_velocities_and_bodies_that_the_library_makes_of_it(public_policies, robot):
    """Of the spin kick, whose file holds them: the library rebuilds all from root and joints."""
    _, clip = spinkick(public_policies, robot)
    frames = build_library(robot, [clip]).clip(0)
    frame_at = frame_of(public_policies / "mjlab_spinkick" / "spinkick_safe.onnx")
    for frame in (5, 30, 60):
        said, bodies = frame_at(frame), frames.bodies
        np.testing.assert_allclose(frames.joint_vel[frame], said["joint_vel"], atol=1e-3)
        np.testing.assert_allclose(bodies.pos[frame], said["body_pos_w"], atol=1e-4)
        dots = np.abs((bodies.quat[frame] * said["body_quat_w"]).sum(-1))
        np.testing.assert_allclose(dots, 1.0, atol=1e-6)
        np.testing.assert_allclose(bodies.lin_vel[frame], said["body_lin_vel_w"], atol=2e-3)
        np.testing.assert_allclose(bodies.ang_vel[frame], said["body_ang_vel_w"], atol=5e-3)
