"""Public policies of the BeyondMimic family: their joint targets in the environment and in a loop of their own.

The loop is written here from the definition of layout 154, in NumPy and MuJoCo. Nothing in it is of the environment but
the robot's MJCF. One policy has mjlab's order of joints, the other Isaac Lab's.
"""

import copy
import dataclasses
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import onnxruntime
import pytest
import yaml

from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.library import build_library
from forgetmimic_jax.motion.readers import read_motion
from forgetmimic_jax.motion.recording import Reading
from forgetmimic_jax.robot.model import Robot, load_robot
from forgetmimic_jax.settings.config import ActionConfig, ObservationConfig
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.env import Environment, make_assets, make_environment
from forgetmimic_jax.tracking.setup import Setup

STEPS = 50
KEY = jax.random.PRNGKey(0)
POLICIES = ["mjlab_spinkick", "unitree_rl_lab_dance_102"]


@dataclass
class Public:
    """A policy with what its file says, all of joints in its own order, and its clip."""

    session: onnxruntime.InferenceSession
    joints: list[str]
    default: np.ndarray
    scale: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    clip: Clip

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        feed = {"obs": observation.astype(np.float32)[None]}
        if len(self.session.get_inputs()) == 2:  # the frame of the clip inside, which no action depends on
            feed["time_step"] = np.zeros((1, 1), np.float32)
        return self.session.run(["actions"], feed)[0][0]

    @property
    def action(self) -> ActionConfig:
        tables = {
            "default_pose": self.default,
            "scale": self.scale,
            "stiffness": self.stiffness,
            "damping": self.damping,
        }
        by_joint = {
            name: {joint: float(value) for joint, value in zip(self.joints, values, strict=True)}
            for name, values in tables.items()
        }
        return ActionConfig("offset", tuple(self.joints), **by_joint)


def spinkick(folder: Path, robot: Robot) -> Public:
    """Metadata, and the clip inside the file, a frame a call."""
    session = onnxruntime.InferenceSession(folder / "mjlab_spinkick" / "spinkick_safe.onnx")
    said = {key: value.split(",") for key, value in session.get_modelmeta().custom_metadata_map.items()}
    frames = []
    for frame in range(STEPS + 20):
        feed = {"obs": np.zeros((1, 154), np.float32), "time_step": np.full((1, 1), frame, np.float32)}
        frames.append(session.run(["body_pos_w", "body_quat_w", "joint_pos"], feed))
    pos, quat, joints = (np.concatenate(values).astype(np.float64) for values in zip(*frames, strict=True))
    numbers = ("default_joint_pos", "action_scale", "joint_stiffness", "joint_damping")
    clip = Clip("spinkick", 50.0, tuple(said["joint_names"]), pos[:, 0], quat[:, 0], joints)
    return Public(session, said["joint_names"], *(np.array(said[key], float) for key in numbers), clip)


def dance(folder: Path, robot: Robot) -> Public:
    """deploy.yaml: pose and scale in the policy's order, gains in the robot's; the clip as CSV at 60 Hz."""
    folder = folder / "unitree_rl_lab_dance_102"
    said = yaml.safe_load((folder / "deploy.yaml").read_text())
    order = said["joint_ids_map"]
    clip = read_motion(robot, folder / "G1_Take_102.bvh_60hz.csv", Reading(fps=60.0)).clip
    return Public(
        session=onnxruntime.InferenceSession(folder / "policy.onnx"),
        joints=[robot.joint_names[joint] for joint in order],
        default=np.array(said["default_joint_pos"]),
        scale=np.array(said["actions"]["JointPositionAction"]["scale"]),
        stiffness=np.array(said["stiffness"])[order],
        damping=np.array(said["damping"])[order],
        clip=clip,
    )


@pytest.fixture(scope="module", params=[spinkick, dance], ids=POLICIES)
def public(request, public_policies, robot) -> Public:
    return request.param(public_policies, robot)


@pytest.fixture(scope="module")
def library(public, robot):
    return build_library(robot, [public.clip])


def in_its_own_loop(public: Public, robot: Robot, library) -> np.ndarray:
    """Joint targets [step, joint] in the robot's order: layout 154, offset action, four physics steps."""
    place = np.array([robot.joint_names.index(joint) for joint in public.joints])
    reference = jax.tree.map(lambda values: np.asarray(values, np.float64)[0], library.frames)
    model = copy.copy(robot.model)
    model.actuator_gainprm[place, 0] = public.stiffness
    model.actuator_biasprm[place, 1], model.actuator_biasprm[place, 2] = -public.stiffness, -public.damping
    data, torso = mujoco.MjData(model), model.body("torso_link").id
    pelvis, anchor = 0, 7  # among the reference's bodies
    data.qpos[:3], data.qpos[3:7] = reference.bodies.pos[0, pelvis], reference.bodies.quat[0, pelvis]
    data.qpos[7:] = reference.joint_pos[0]
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, data.qpos[3:7])
    data.qvel[:3] = reference.bodies.lin_vel[0, pelvis]
    data.qvel[3:6] = turn.reshape(3, 3).T @ reference.bodies.ang_vel[0, pelvis]
    data.qvel[6:] = reference.joint_vel[0]
    targets, last = [], np.zeros(29)
    for step in range(STEPS):
        mujoco.mj_kinematics(model, data)
        mujoco.mju_quat2Mat(turn, reference.bodies.quat[step + 1, anchor])
        relative = data.xmat[torso].reshape(3, 3).T @ turn.reshape(3, 3)
        observation = [
            reference.joint_pos[step + 1][place],
            reference.joint_vel[step + 1][place],
            [relative[0, 0], relative[0, 1], relative[1, 0], relative[1, 1], relative[2, 0], relative[2, 1]],
            data.qvel[3:6],
            data.qpos[7:][place] - public.default,
            data.qvel[6:][place],
            last,
        ]
        last = public(np.concatenate(observation)).astype(np.float64)
        data.ctrl[place] = public.default + public.scale * last
        targets.append(data.ctrl.copy())
        mujoco.mj_step(model, data, 4)
    return np.array(targets)


def in_the_environment(public: Public, config, library) -> np.ndarray:
    """The same of the environment, which starts exactly on the reference and has no noise."""
    still = {field.name: 0.0 for field in dataclasses.fields(config.noise) if field.name == "reset_joint_position"}
    still |= {f"reset_{name}": (0.0, 0.0, 0.0) for name in ("position", "orientation", "linear_velocity")}
    noise = dataclasses.replace(config.noise, enabled=False, reset_angular_velocity=(0.0, 0.0, 0.0), **still)
    config = dataclasses.replace(
        config, noise=noise, observation=ObservationConfig("mjlab154"), action=public.action, max_episode_steps=500
    )
    setup = Setup(config, load_robot("g1", config.physics, config.action), library, "")
    env, assets = make_environment(setup, 1), make_assets(setup)

    @jax.jit
    def step(assets, state, action):
        asked = []

        def told(physics, parameters, target, wrench):
            asked.append(target)
            return env.engine.step(physics, parameters, target, wrench)

        watched = Environment(config, setup.robot, SimpleNamespace(step=told), 1, noisy=False)
        after, _ = tracking.step(watched, assets, state, action, KEY)
        return after, asked[0]

    observe = jax.jit(lambda assets, state: tracking.observe(env, assets, state, None)[0])
    zeros = jnp.zeros(1, jnp.int32)
    state = tracking.start_episodes(env, assets, KEY, zeros, zeros, zeros, jnp.zeros(1))
    state = tracking.refresh_bodies(env, state, jnp.ones(1, bool))
    targets = []
    for _ in range(STEPS):
        action = public(np.asarray(observe(assets, state))[0])
        state, target = step(assets, state, jnp.asarray(action)[None])
        targets.append(np.asarray(target)[0])
    return np.array(targets)


def test_joint_targets_are_those_of_the_policys_own_loop(public, robot, library, tiny_config):
    expected = in_its_own_loop(public, robot, library)
    assert np.ptp(expected, axis=0).max() > 0.2  # it moves
    found = in_the_environment(public, tiny_config, library)
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_the_clip_inside_the_file_has_the_velocities_and_bodies_that_the_library_makes_of_it(public_policies, robot):
    """Of the spin kick, whose file holds them: the library rebuilds all from root and joints."""
    public = spinkick(public_policies, robot)
    frames = jax.tree.map(lambda values: np.asarray(values)[0], build_library(robot, [public.clip]).frames)
    names = ["joint_vel", "body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w"]
    for frame in (5, 30, 60):
        feed = {"obs": np.zeros((1, 154), np.float32), "time_step": np.full((1, 1), frame, np.float32)}
        said = dict(zip(names, (value[0] for value in public.session.run(names, feed)), strict=True))
        bodies = frames.bodies
        np.testing.assert_allclose(frames.joint_vel[frame], said["joint_vel"], atol=1e-3)
        np.testing.assert_allclose(bodies.pos[frame], said["body_pos_w"], atol=1e-4)
        dots = np.abs((bodies.quat[frame] * said["body_quat_w"]).sum(-1))
        np.testing.assert_allclose(dots, 1.0, atol=1e-6)
        np.testing.assert_allclose(bodies.lin_vel[frame], said["body_lin_vel_w"], atol=2e-3)
        np.testing.assert_allclose(bodies.ang_vel[frame], said["body_ang_vel_w"], atol=5e-3)
