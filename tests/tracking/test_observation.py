import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scene import body_velocity, on_reference, posed, turned
from scipy.spatial.transform import Rotation

from forgetmimic_jax.motion.library import Frames
from forgetmimic_jax.physics import BodyState, PhysicsState
from forgetmimic_jax.robot.bodies import Bodies
from forgetmimic_jax.settings.config import NoiseConfig
from forgetmimic_jax.tracking.observation import actor_observation, actor_size, critic_observation, observation_noise
from forgetmimic_jax.tracking.reference import lookup

# The actor's layout for 29 joints, from the design document.
SLICES = {
    "reference_base_height": slice(0, 1),
    "reference_base_linear_velocity": slice(1, 4),
    "reference_base_angular_velocity": slice(4, 7),
    "reference_projected_gravity": slice(7, 10),
    "reference_joint_position": slice(10, 39),
    "gyro": slice(39, 42),
    "projected_gravity": slice(42, 45),
    "joint_position": slice(45, 74),
    "joint_velocity": slice(74, 103),
    "last_action": slice(103, 132),
}
HALF_WIDTHS = {
    "reference_base_height": 0.01,
    "reference_base_linear_velocity": (0.1, 0.1, 0.05),
    "reference_base_angular_velocity": (0.2, 0.2, 0.3),
    "reference_projected_gravity": 0.02,
    "reference_joint_position": 0.05,
    "gyro": 0.2,
    "projected_gravity": 0.05,
    "joint_position": 0.01,
    "joint_velocity": 1.5,
    "last_action": 0.0,
}


def physics_state(data: mujoco.MjData) -> PhysicsState:
    qpos, qvel = (jnp.asarray(values[None], jnp.float32) for values in (data.qpos, data.qvel))
    return PhysicsState(qpos, qvel, jnp.zeros_like(qvel))


def key_bodies(robot, data: mujoco.MjData) -> BodyState:
    velocity = [body_velocity(robot, data, body) for body in robot.key_body_ids]
    linear, angular = (np.array(column)[None] for column in zip(*velocity, strict=True))
    pos, quat = data.xpos[robot.key_body_ids][None], data.xquat[robot.key_body_ids][None]
    arrays = [jnp.asarray(values, jnp.float32) for values in (pos, quat, linear, angular)]
    return BodyState(*arrays, contact_force=jnp.zeros_like(arrays[0]))


def as_reference(robot, data: mujoco.MjData) -> Frames:
    bodies, joints = key_bodies(robot, data), jnp.asarray(data.qpos[None, 7:], jnp.float32)
    zero = jnp.zeros((1, 3))
    of_reference = Bodies(bodies.pos, bodies.quat, bodies.lin_vel, bodies.ang_vel)
    return Frames(joints, joints, of_reference, zero, zero)


@pytest.fixture(scope="module")
def scene(robot):
    """A robot in one random pose, a reference in another, both by MuJoCo, and the actor's observation of them."""
    here, there = posed(robot, seed=1), posed(robot, seed=2)
    last_action = jnp.linspace(-1.0, 1.0, 29)[None]
    observation = actor_observation(
        robot.arrays, as_reference(robot, there), robot.root, physics_state(here), last_action
    )
    return here, there, np.asarray(observation)[0]


def in_pelvis_frame(robot, data: mujoco.MjData, vector) -> np.ndarray:
    return data.xmat[robot.model.body("pelvis").id].reshape(3, 3).T @ vector


def test_the_actor_sees_132_numbers_on_the_g1(robot, scene):
    assert actor_size(robot.num_joints) == scene[2].size == 132


@pytest.mark.parametrize("part", SLICES)
def test_every_part_of_the_actors_observation_is_what_mujoco_says(robot, scene, part):
    here, there, observation = scene
    pelvis = robot.model.body("pelvis").id
    linear, angular = body_velocity(robot, there, pelvis)
    gyro = np.zeros(6)
    mujoco.mj_objectVelocity(robot.model, here, mujoco.mjtObj.mjOBJ_XBODY, pelvis, gyro, 1)
    default = [robot.arrays.default_joint_pos[robot.joint_names.index(name)] for name in robot.joint_names]
    joint = {name: robot.model.joint(name) for name in robot.joint_names}
    expected = {
        "reference_base_height": there.xpos[pelvis, 2:],
        "reference_base_linear_velocity": in_pelvis_frame(robot, there, linear),
        "reference_base_angular_velocity": in_pelvis_frame(robot, there, angular),
        "reference_projected_gravity": in_pelvis_frame(robot, there, [0.0, 0.0, -1.0]),
        "reference_joint_position": [there.qpos[j.qposadr[0]] for j in joint.values()],
        "gyro": gyro[:3],
        "projected_gravity": in_pelvis_frame(robot, here, [0.0, 0.0, -1.0]),
        "joint_position": np.array([here.qpos[j.qposadr[0]] for j in joint.values()]) - np.array(default),
        "joint_velocity": [here.qvel[j.dofadr[0]] for j in joint.values()],
        "last_action": np.linspace(-1.0, 1.0, 29),
    }
    np.testing.assert_allclose(observation[SLICES[part]], expected[part], atol=1e-5)


def test_gravity_points_down_for_an_upright_robot(robot, library):
    reference = lookup(library, jnp.array([1]), jnp.array([0]))
    qpos = jnp.concatenate([jnp.array([[0.0, 0.0, 0.76, 1.0, 0.0, 0.0, 0.0]]), reference.joint_pos], axis=-1)
    physics = PhysicsState(qpos, jnp.zeros((1, 35)), jnp.zeros((1, 35)))
    observation = actor_observation(robot.arrays, reference, robot.root, physics, jnp.zeros((1, 29)))[0]
    np.testing.assert_allclose(observation[SLICES["projected_gravity"]], [0.0, 0.0, -1.0], atol=1e-6)


def test_the_actor_knows_neither_place_nor_heading(robot, scene):
    here, there, observation = scene
    reference = as_reference(robot, there)
    bodies = turned(on_reference(reference), 1.3, (4.0, -2.0))
    moved_reference = dataclasses.replace(
        reference, bodies=Bodies(bodies.pos, bodies.quat, bodies.lin_vel, bodies.ang_vel)
    )
    turn = Rotation.from_euler("z", -0.8)
    moved = physics_state(here)
    quat = (turn * Rotation.from_quat(here.qpos[3:7], scalar_first=True)).as_quat(scalar_first=True)
    root = np.concatenate([[7.0, 7.0, here.qpos[2]], quat])
    moved = dataclasses.replace(
        moved,
        qpos=moved.qpos.at[0, :7].set(jnp.asarray(root, jnp.float32)),
        qvel=moved.qvel.at[0, :3].set(jnp.asarray(turn.apply(here.qvel[:3]), jnp.float32)),
    )
    last_action = jnp.linspace(-1.0, 1.0, 29)[None]
    again = actor_observation(robot.arrays, moved_reference, robot.root, moved, last_action)[0]
    np.testing.assert_allclose(again, observation, atol=1e-5)


@pytest.mark.parametrize("part", SLICES)
def test_noise_is_uniform_in_its_half_width(part):
    noise = np.asarray(observation_noise(NoiseConfig(), jax.random.PRNGKey(0), 4000, 29))[:, SLICES[part]]
    half_width = np.broadcast_to(HALF_WIDTHS[part], noise.shape[1:])
    assert (np.abs(noise) <= half_width).all()
    assert (np.abs(noise).max(0) >= 0.99 * half_width).all()
    np.testing.assert_allclose(noise.mean(0), 0.0, atol=0.05 * half_width.max() + 1e-9)
    np.testing.assert_allclose(noise.std(0), half_width / np.sqrt(3.0), rtol=0.06)


def critic_of(robot, reference: Frames, bodies: BodyState, **changes) -> np.ndarray:
    arguments = dict(wrench=jnp.zeros((1, 6)), wrench_gain=jnp.zeros(1), phase=jnp.zeros(1), terms=jnp.ones((1, 10)))
    clean = jnp.zeros((1, 132))
    return np.asarray(critic_observation(clean, reference, bodies, robot.anchor, robot.root, **arguments | changes))[0]


# After the actor's 132: 3 + 6 anchor error, 14 bodies × (3 + 6 + 3 + 3) of reference and robot, 3 base velocity,
# 6 wrench, gain, phase, 10 terms, 14 × 3 contact forces.
ANCHOR, REFERENCE, ROBOT, BASE = slice(132, 141), slice(141, 351), slice(351, 561), slice(561, 564)
WRENCH, GAIN, PHASE, TERMS, CONTACT = slice(564, 570), 570, 571, slice(572, 582), slice(582, 624)


def test_the_critic_sees_624_numbers_on_the_g1(robot, library):
    reference = lookup(library, jnp.array([0]), jnp.array([5]))
    assert critic_of(robot, reference, on_reference(reference)).size == CONTACT.stop


def test_the_critic_sees_no_error_when_the_robot_is_the_reference(robot, library):
    reference = lookup(library, jnp.array([0]), jnp.array([5]))
    critic = critic_of(robot, reference, on_reference(reference))
    np.testing.assert_allclose(critic[ANCHOR], [0, 0, 0, 1, 0, 0, 0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(critic[REFERENCE], critic[ROBOT], atol=1e-6)


def test_the_critics_body_features_are_mujocos_in_each_ones_own_torso_frame(robot, scene):
    here, there, _ = scene
    critic = critic_of(robot, as_reference(robot, there), key_bodies(robot, here))
    torso = robot.model.body("torso_link").id
    for part, data in ((REFERENCE, there), (ROBOT, here)):
        frame = data.xmat[torso].reshape(3, 3).T
        ids = robot.key_body_ids
        pos = [frame @ (data.xpos[body] - data.xpos[torso]) for body in ids]
        columns = [(frame @ data.xmat[body].reshape(3, 3))[:, :2].T for body in ids]
        velocity = [body_velocity(robot, data, body) for body in ids]
        linear, angular = ([frame @ vector for vector in column] for column in zip(*velocity, strict=True))
        expected = np.concatenate([np.ravel(values) for values in (pos, columns, linear, angular)])
        np.testing.assert_allclose(critic[part], expected, atol=1e-4)


def test_the_critics_anchor_error_is_in_the_robots_torso_frame(robot, scene):
    here, there, _ = scene
    critic = critic_of(robot, as_reference(robot, there), key_bodies(robot, here))
    torso = robot.model.body("torso_link").id
    frame = here.xmat[torso].reshape(3, 3).T
    relative = frame @ there.xmat[torso].reshape(3, 3)
    expected = [*(frame @ (there.xpos[torso] - here.xpos[torso])), *relative[:, 0], *relative[:, 1]]
    np.testing.assert_allclose(critic[ANCHOR], expected, atol=1e-5)


def test_the_critics_base_velocity_is_in_the_pelvis_frame(robot, scene):
    here, there, _ = scene
    critic = critic_of(robot, as_reference(robot, there), key_bodies(robot, here))
    linear, _ = body_velocity(robot, here, robot.model.body("pelvis").id)
    np.testing.assert_allclose(critic[BASE], in_pelvis_frame(robot, here, linear), atol=1e-5)


def test_the_critics_other_features_stand_where_they_belong(robot, library):
    reference = lookup(library, jnp.array([0]), jnp.array([5]))
    force = jnp.zeros((1, 14, 3)).at[0, 3].set(jnp.array([np.e - 1.0, -(np.e**2 - 1.0), 0.0]))
    bodies = dataclasses.replace(on_reference(reference), contact_force=force)
    wrench, terms = jnp.arange(6.0)[None], jnp.linspace(0.1, 1.0, 10)[None]
    critic = critic_of(
        robot, reference, bodies, wrench=wrench, wrench_gain=jnp.array([0.3]), phase=jnp.array([0.7]), terms=terms
    )
    np.testing.assert_allclose(critic[WRENCH], np.arange(6.0))
    np.testing.assert_allclose(critic[[GAIN, PHASE]], [0.3, 0.7], rtol=1e-6)
    np.testing.assert_allclose(critic[TERMS], np.linspace(0.1, 1.0, 10), rtol=1e-5)
    contact = critic[CONTACT].reshape(14, 3)
    np.testing.assert_allclose(contact[3], [1.0, -2.0, 0.0], rtol=1e-5)
    assert not np.delete(contact, 3, axis=0).any()
