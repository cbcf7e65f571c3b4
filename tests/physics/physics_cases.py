"""Five robots that no engine may get wrong, in one batch, and plain MuJoCo's answer for each."""

from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from forgetmimic_jax.physics import Engine, PhysicsParameters, PhysicsState
from forgetmimic_jax.robot.model import Robot

SUBSTEPS = 4
TIMESTEP = 0.005  # s
GRAVITY = 9.81  # m/s^2
STANDING, FLIGHT, CRAWLING, SLIDING, LIFTED = range(5)
CASES = {"standing": STANDING, "flight": FLIGHT, "crawling": CRAWLING, "sliding": SLIDING, "lifted": LIFTED}
SETTLING_STEPS = 20


class Inputs(NamedTuple):
    """Arguments of `Engine.step`."""

    state: PhysicsState
    parameters: PhysicsParameters
    target: Array
    wrench: Array


def make_inputs(robot: Robot, engine: Engine) -> Inputs:
    """Standing; in flight with far targets and a wrench; on hands and knees; sliding; hanging on a wrench of M g.

    `engine` only lets the robots on the floor settle into contact.
    """
    rng = np.random.default_rng(0)
    rows, model = len(CASES), robot.model
    qpos = np.tile(rest_qpos(robot), (rows, 1))
    qpos[CRAWLING, 2], qpos[CRAWLING, 3:7] = 0.55, [np.sqrt(0.5), 0, np.sqrt(0.5), 0]
    # The hands' capsules lean: where one stands within 30 degrees of upright on the floor, MJX turns the axes of the
    # friction pyramid otherwise than C, and the forces differ by newtons.
    legs, arms = {"hip_pitch": -1.55, "knee": 1.6, "ankle_pitch": 0.4}, {"shoulder_pitch": -1.5, "shoulder_roll": 0.0}
    qpos[CRAWLING, 7:] = pose(robot, **legs, **arms, elbow=1.2, wrist_pitch=-0.1)
    target, wrench, com = qpos[:, 7:].copy(), np.zeros((rows, 6)), np.zeros((rows, 3))
    com[FLIGHT], com[SLIDING], com[LIFTED] = [0.02, -0.04, 0.03], [-0.02, 0.03, 0.05], [0.025, 0.05, -0.05]
    parameters = PhysicsParameters(single([0.8, 0.8, 0.8, 0.3, 0.8]), single(com))
    settled = make_state(qpos, np.zeros((rows, model.nv)))
    for _ in range(SETTLING_STEPS):
        settled, _ = engine.step(settled, parameters, single(target), single(wrench))

    start, qvel, warmstart = (np.array(x) for x in (settled.qpos, settled.qvel, settled.warmstart))
    for row in (FLIGHT, LIFTED):
        start[row] = qpos[row]
        start[row, :7] = [0.3, -0.2, 1.5, 0.8, 0.36, -0.48, 0.0]
        qvel[row] = warmstart[row] = 0.0
    qvel[FLIGHT] = rng.normal(size=model.nv)
    qvel[SLIDING, :2] += [0.8, -0.5]
    target[FLIGHT] += rng.uniform(-2.0, 2.0, model.nu)  # beyond the torque limits of many joints
    wrench[STANDING] = [5.0, 3.0, 0.0, 0.5, 0.0, 0.2]
    wrench[FLIGHT] = [120.0, -80.0, 200.0, 15.0, -10.0, 5.0]
    wrench[LIFTED] = [0.0, 0.0, GRAVITY * float(robot.arrays.mass), 2.0, -1.0, 3.0]
    return Inputs(
        PhysicsState(single(start), single(qvel), single(warmstart)), parameters, single(target), single(wrench)
    )


def rest_inputs(robot: Robot, rows: int) -> Inputs:
    """The default pose just above the floor, at rest, everything else neutral."""
    qpos = np.tile(rest_qpos(robot), (rows, 1))
    return Inputs(
        make_state(qpos, np.zeros((rows, robot.model.nv))),
        PhysicsParameters(jnp.full((rows,), 0.8), jnp.zeros((rows, 3))),
        single(qpos[:, 7:]),
        jnp.zeros((rows, 6)),
    )


def rest_qpos(robot: Robot) -> np.ndarray:
    return np.concatenate([[0.0, 0.0, robot.default_height, 1.0, 0.0, 0.0, 0.0], pose(robot)])


def pose(robot: Robot, **angles: float) -> np.ndarray:
    """The default pose with every joint whose name contains a keyword at that angle, rad."""
    joint_pos = np.array(robot.arrays.default_joint_pos)
    for part, angle in angles.items():
        joint_pos[[part in name for name in robot.joint_names]] = angle
    return joint_pos


def make_state(qpos: np.ndarray, qvel: np.ndarray) -> PhysicsState:
    return PhysicsState(single(qpos), single(qvel), jnp.zeros(qvel.shape))


def single(values) -> Array:
    return jnp.asarray(values, jnp.float32)


def plain_model(robot: Robot, inputs: Inputs, row: int) -> mujoco.MjModel:
    """A model of its own with the row's randomised values."""
    model = robot.spec.copy().compile()
    model.geom_friction[robot.foot_geom_ids, 0] = inputs.parameters.foot_friction[row]
    model.body_ipos[robot.anchor_body_id] += np.asarray(inputs.parameters.torso_com[row], np.float64)
    return model


def plain_data(robot: Robot, model: mujoco.MjModel, inputs: Inputs, row: int) -> mujoco.MjData:
    """MuJoCo's data at the row's state, not yet forwarded."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = inputs.state.qpos[row], inputs.state.qvel[row]
    data.qacc_warmstart[:] = inputs.state.warmstart[row]
    data.ctrl[:] = inputs.target[row]
    data.xfrc_applied[robot.anchor_body_id] = inputs.wrench[row]
    return data


def key_body_velocities(robot: Robot, model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """Linear m/s and angular rad/s velocity [key_body, 3] at the body frames' origins, world frame."""
    velocities = np.zeros((len(robot.key_body_ids), 6))
    for body, velocity in zip(robot.key_body_ids, velocities, strict=True):
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
    return velocities[:, 3:], velocities[:, :3]


def floor_forces(robot: Robot, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Force [key_body, 3] N of the floor on each key body, world frame, from the contacts one by one."""
    floor, total, force = model.geom("floor").id, np.zeros((model.nbody, 3)), np.zeros(6)
    for index, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, index, force)
        on_second = contact.frame.reshape(3, 3).T @ force[:3]
        first, second = contact.geom
        if first == floor:
            total[model.geom_bodyid[second]] += on_second
        elif second == floor:
            total[model.geom_bodyid[first]] -= on_second
    return total[robot.key_body_ids]
