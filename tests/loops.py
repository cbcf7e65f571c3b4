"""Policies in two closed loops: one written here from the definition of the layouts, and the environment.

The first is NumPy, MuJoCo and the policy's own file. Nothing in it is of the project but the robot's MJCF and the
frames of the clip. Layouts: wbc132, mjlab160, mjlab154, as their projects define them, and root132.
"""

import copy
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import onnxruntime
import yaml

from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.env import Environment, make_assets, make_environment
from forgetmimic_jax.tracking.rsi import Start
from forgetmimic_jax.tracking.setup import Setup

KEY = jax.random.PRNGKey(0)
SAME = {"motion_command": "command", "joint_pos_rel": "joint_pos", "joint_vel_rel": "joint_vel"}  # Isaac Lab's names
SAME["last_action"] = "actions"


@dataclass
class Deployment:
    """What a deployer knows of a policy; arrays are of joints in the policy's order."""

    act: Callable[[np.ndarray], np.ndarray]
    terms: list[str]
    body: str  # that terms of one body are of
    residual: bool
    joints: list[str]
    default: np.ndarray
    scale: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray


def onnx_actions(file: Path) -> Callable[[np.ndarray], np.ndarray]:
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    others = {value.name: np.zeros((1, 1), np.float32) for value in session.get_inputs() if value.name != "obs"}
    return lambda seen: session.run(["actions"], {"obs": seen.astype(np.float32)[None], **others})[0][0]


def from_metadata(file: Path) -> Deployment:
    """As mjlab's deployers read it."""
    said = onnxruntime.InferenceSession(file).get_modelmeta().custom_metadata_map
    numbers = ("default_joint_pos", "action_scale", "joint_stiffness", "joint_damping")
    return Deployment(
        onnx_actions(file),
        said["observation_names"].split(","),
        said["anchor_body_name"],
        said.get("action_mode") == "reference_residual",
        said["joint_names"].split(","),
        *(np.array(said[key].split(","), float) for key in numbers),
    )


def from_deploy_yaml(file: Path, table: Path, robot: Robot) -> Deployment:
    """As unitree_rl_lab's deployer reads it: pose and scale in the policy's order, gains in the robot's."""
    said = yaml.safe_load(table.read_text())
    order, action = said["joint_ids_map"], said["actions"]["JointPositionAction"]
    assert action["offset"] == said["default_joint_pos"]
    return Deployment(
        onnx_actions(file),
        [SAME.get(name, name) for name in said["observations"]],
        "torso_link",
        False,
        [robot.joint_names[joint] for joint in order],
        np.array(said["default_joint_pos"]),
        np.array(action["scale"]),
        np.array(said["stiffness"])[order],
        np.array(said["damping"])[order],
    )


def from_config_yaml(file: Path, table: Path) -> Deployment:
    """As wbc-g1-deploy reads it."""
    said = yaml.safe_load(table.read_text())
    return Deployment(
        onnx_actions(file),
        list(said["actor_observations"]),
        said["tracking"]["anchor_body_name"],
        said["action"]["action_mode"] == "reference_residual",
        said["joint_names"],
        *(np.array(values) for values in (said["default_joint_pos"], said["action"]["scale"])),
        *(np.array(said[key]) for key in ("stiffness", "damping")),
    )


def in_its_own_loop(deployment: Deployment, robot: Robot, library, steps: int, clip: int = 0) -> np.ndarray:
    """Joint targets [step, joint] in the robot's order, from the clip's first frame on."""
    place = np.array([robot.joint_names.index(joint) for joint in deployment.joints])
    reference = jax.tree.map(lambda values: values.astype(np.float64), library.clip(clip))
    model = copy.copy(robot.model)
    model.actuator_gainprm[place, 0] = deployment.stiffness
    model.actuator_biasprm[place, 1], model.actuator_biasprm[place, 2] = -deployment.stiffness, -deployment.damping
    data, body = mujoco.MjData(model), model.body(deployment.body).id
    of = robot.key_bodies.index(deployment.body)
    pos, quat, lin, ang = (getattr(reference.bodies, name) for name in ("pos", "quat", "lin_vel", "ang_vel"))
    data.qpos[:3], data.qpos[3:7], data.qpos[7:] = pos[0, 0], quat[0, 0], reference.joint_pos[0]
    data.qvel[:3], data.qvel[3:6] = lin[0, 0], matrix(quat[0, 0]).T @ ang[0, 0]
    data.qvel[6:] = reference.joint_vel[0]
    down, targets, last = np.array([0.0, 0.0, -1.0]), [], np.zeros(len(place))
    for frame in range(1, steps + 1):
        mujoco.mj_kinematics(model, data)
        here, there, base = data.xmat[body].reshape(3, 3), matrix(quat[frame, of]), matrix(data.qpos[3:7])
        relative = here.T @ there
        joints = reference.joint_pos[frame][place]
        seen = {
            "command": [*joints, *reference.joint_vel[frame][place]],
            "motion_anchor_pos_b": here.T @ (pos[frame, of] - data.xpos[body]),
            "motion_anchor_ori_b": [relative[row, column] for row in range(3) for column in range(2)],
            "base_lin_vel": base.T @ data.qvel[:3],
            "base_ang_vel": data.qvel[3:6],
            "projected_gravity": base.T @ down,
            "joint_pos": data.qpos[7:][place] - deployment.default,
            "joint_vel": data.qvel[6:][place],
            "actions": last,
            "ref_joint_pos": joints,
        }
        of_body = {
            "height": pos[frame, of, 2:],
            "lin_vel_b": there.T @ lin[frame, of],
            "ang_vel_b": there.T @ ang[frame, of],
            "gravity_b": there.T @ down,
        }
        seen |= {f"ref_{kind}_{name}": value for kind in ("base", "root") for name, value in of_body.items()}
        seen["ref_gravity_b"] = of_body["gravity_b"]
        last = deployment.act(np.concatenate([seen[name] for name in deployment.terms])).astype(np.float64)
        origin = joints if deployment.residual else deployment.default
        data.ctrl[place] = origin + deployment.scale * last
        targets.append(data.ctrl.copy())
        mujoco.mj_step(model, data, 4)
    return np.array(targets)


def matrix(quat: np.ndarray) -> np.ndarray:
    """The rotation matrix of a quaternion wxyz: its columns are the turned axes."""
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


class Deployed:
    """The action of a policy's own file in the environment, which shows it the observation."""

    def __init__(self, deployment: Deployment):
        self.deployment = deployment

    def __call__(self, assets, state, observation):
        return jnp.asarray(self.deployment.act(np.asarray(observation)[0]))[None]


def in_the_environment(setup: Setup, act: Callable, steps: int, clip: int = 0) -> np.ndarray:
    """The same of the environment, which starts exactly on the reference: no noise at all.

    Args:
        setup: of the policy, on the native engine.
        act: act(assets, state, observation [1, features]) → action [1, joint].
        steps: control steps.
        clip: index.
    """
    nothing = (0.0, 0.0, 0.0)
    noise = dataclasses.replace(
        setup.config.noise,
        enabled=False,
        reset_position=nothing,
        reset_orientation=nothing,
        reset_linear_velocity=nothing,
        reset_angular_velocity=nothing,
        reset_joint_position=0.0,
    )
    config = dataclasses.replace(setup.config, noise=noise, max_episode_steps=500)
    setup = dataclasses.replace(setup, config=config)
    env, assets = make_environment(setup, 1, noisy=False), make_assets(setup)

    @jax.jit
    def step(assets, state, action):
        sent = []

        def stepped(physics, parameters, target, wrench):
            sent.append(target)
            return env.engine.step(physics, parameters, target, wrench)

        watched = Environment(config, setup.robot, SimpleNamespace(step=stepped), 1, noisy=False)
        after, _ = tracking.step(watched, assets, state, action, KEY)
        return after, sent[0]

    observe = jax.jit(lambda assets, state: tracking.observe(env, assets, state, None)[0])
    act = act if isinstance(act, Deployed) else jax.jit(act)
    zeros = jnp.zeros(1, jnp.int32)
    state = tracking.start_episodes(env, assets, KEY, Start(zeros + clip, zeros, zeros), jnp.zeros(1))
    state = tracking.refresh_bodies(env, state, jnp.ones(1, bool))
    targets = []
    for _ in range(steps):
        action = act(assets, state, observe(assets, state))
        state, target = step(assets, state, action)
        targets.append(np.asarray(target)[0])
    return np.array(targets)
