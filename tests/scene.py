"""References and robots for the tracking tests: invented ones, and ones posed by MuJoCo itself."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from forgetmimic_jax.motion.library import Frames
from forgetmimic_jax.physics import BodyState, PhysicsState
from forgetmimic_jax.robot.bodies import Bodies
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.tracking.layouts import Moment


def upright_scene(robot: Robot, num_envs: int = 1) -> tuple[Frames, BodyState]:
    """A reference at rest whose bodies hang anywhere, all upright, and a robot that is exactly there."""
    rng = np.random.default_rng(0)
    bodies = len(robot.key_bodies)
    pos = np.tile(rng.uniform([-0.5, -0.5, 0.1], [0.5, 0.5, 1.3], (bodies, 3)), (num_envs, 1, 1))
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (num_envs, bodies, 1))
    zeros = np.zeros((num_envs, bodies, 3))
    joints = np.zeros((num_envs, robot.num_joints))
    still = np.zeros((num_envs, 3))
    frames = Frames(joints, joints, Bodies(pos, quat, zeros, zeros), still, still)
    reference = jax.tree.map(lambda values: jnp.asarray(values, jnp.float32), frames)
    return reference, on_reference(reference)


def on_reference(reference: Frames) -> BodyState:
    """A robot whose key bodies are the reference's, touching nothing."""
    return BodyState(**vars(reference.bodies), contact_force=jnp.zeros_like(reference.bodies.pos))


def turned(bodies: BodyState, yaw: float, shift: tuple[float, float]) -> BodyState:
    """The whole robot, its velocities included, turned about the world's z and then shifted in the plane."""
    turn = Rotation.from_euler("z", yaw)

    def vectors(values) -> np.ndarray:
        return turn.apply(np.asarray(values).reshape(-1, 3)).reshape(values.shape)

    quat = (turn * Rotation.from_quat(np.asarray(bodies.quat).reshape(-1, 4), scalar_first=True)).as_quat(
        scalar_first=True
    )
    moved = _float32(
        pos=vectors(bodies.pos) + np.array([*shift, 0.0]),
        quat=quat.reshape(bodies.quat.shape),
        lin_vel=vectors(bodies.lin_vel),
        ang_vel=vectors(bodies.ang_vel),
        contact_force=vectors(bodies.contact_force),
    )
    return BodyState(**moved)


def shaken(bodies: BodyState, seed: int, scale: float = 0.1) -> BodyState:
    """Every pose and velocity off by some `scale` (m, rad, m/s, rad/s)."""
    rng = np.random.default_rng(seed)
    count = bodies.pos.shape[0] * bodies.pos.shape[1]
    turn = Rotation.from_rotvec(scale * rng.standard_normal((count, 3)))
    quat = (turn * Rotation.from_quat(np.asarray(bodies.quat).reshape(-1, 4), scalar_first=True)).as_quat(
        scalar_first=True
    )
    noise = [scale * rng.standard_normal(bodies.pos.shape) for _ in range(3)]
    return dataclasses.replace(
        bodies,
        **_float32(
            pos=bodies.pos + noise[0],
            quat=quat.reshape(bodies.quat.shape),
            lin_vel=bodies.lin_vel + noise[1],
            ang_vel=bodies.ang_vel + noise[2],
        ),
    )


def posed(robot: Robot, seed: int) -> mujoco.MjData:
    """MuJoCo's own data of the robot in a random pose with random velocities, after mj_forward."""
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(robot.model)
    data.qpos[:3] = rng.uniform([-1, -1, 0.8], [1, 1, 1.5])
    data.qpos[3:7] = Rotation.random(random_state=seed).as_quat(scalar_first=True)
    data.qpos[7:] = rng.uniform(robot.joint_lower, robot.joint_upper)
    data.qvel[:] = rng.standard_normal(robot.model.nv)
    mujoco.mj_forward(robot.model, data)
    return data


def body_velocity(robot: Robot, data: mujoco.MjData, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Linear and angular velocity of a body's origin in the world frame, by mj_objectVelocity."""
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(robot.model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
    return velocity[3:], velocity[:3]


def physics_state(data: mujoco.MjData) -> PhysicsState:
    """MuJoCo's data as the engine's state [1, ...]."""
    qpos, qvel = (jnp.asarray(values[None], jnp.float32) for values in (data.qpos, data.qvel))
    return PhysicsState(qpos, qvel, jnp.zeros_like(qvel))


def key_bodies(robot: Robot, data: mujoco.MjData) -> BodyState:
    """MuJoCo's key bodies [1, key_body, ...]."""
    velocity = [body_velocity(robot, data, body) for body in robot.key_body_ids]
    linear, angular = (np.array(column)[None] for column in zip(*velocity, strict=True))
    pos, quat = data.xpos[robot.key_body_ids][None], data.xquat[robot.key_body_ids][None]
    arrays = [jnp.asarray(values, jnp.float32) for values in (pos, quat, linear, angular)]
    return BodyState(*arrays, contact_force=jnp.zeros_like(arrays[0]))


def as_reference(robot: Robot, data: mujoco.MjData) -> Frames:
    """A robot's pose and velocity as a frame [1] to track."""
    bodies = key_bodies(robot, data)
    joint_pos, joint_vel = (jnp.asarray(values[None], jnp.float32) for values in (data.qpos[7:], data.qvel[6:]))
    zero = jnp.zeros((1, 3))
    of_reference = Bodies(bodies.pos, bodies.quat, bodies.lin_vel, bodies.ang_vel)
    return Frames(joint_pos, joint_vel, of_reference, zero, zero)


def moved(moment: Moment, yaw: float, shift: tuple[float, float], *, robot: bool) -> Moment:
    """The reference, and with `robot` the robot too, turned about the world's z and moved in x and y."""
    reference = turned(on_reference(moment.reference), yaw, shift)
    bodies = Bodies(reference.pos, reference.quat, reference.lin_vel, reference.ang_vel)
    moment = dataclasses.replace(moment, reference=dataclasses.replace(moment.reference, bodies=bodies))
    if not robot:
        return moment
    turn = Rotation.from_euler("z", yaw)
    qpos, qvel = np.array(moment.physics.qpos[0]), np.array(moment.physics.qvel[0])
    qpos[:3] = turn.apply(qpos[:3]) + np.array([*shift, 0.0])
    qpos[3:7] = (turn * Rotation.from_quat(qpos[3:7], scalar_first=True)).as_quat(scalar_first=True)
    qvel[:3] = turn.apply(qvel[:3])
    physics = dataclasses.replace(moment.physics, **_float32(qpos=qpos[None], qvel=qvel[None]))
    return dataclasses.replace(moment, bodies=turned(moment.bodies, yaw, shift), physics=physics)


def _float32(**arrays) -> dict:
    return {name: jnp.asarray(np.asarray(value), jnp.float32) for name, value in arrays.items()}
