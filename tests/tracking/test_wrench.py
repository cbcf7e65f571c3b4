import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scene import upright_scene
from scipy.spatial.transform import Rotation

from forgetmimic_jax.settings.config import WrenchConfig
from forgetmimic_jax.tracking.reference import AnchorMotion
from forgetmimic_jax.tracking.wrench import reference_wrench, wrench_gain

GRAVITY = np.array([0.0, 0.0, -9.81])
INERTIA = np.diag([1.0, 2.0, 3.0])  # an invented one, easy to turn by hand
QUARTER_TURN = Rotation.from_euler("z", np.pi / 2)


@pytest.fixture(scope="module")
def scene(robot):
    """The robot's constants with the invented inertia, an upright anchor at rest, and a robot that is there."""
    arrays = dataclasses.replace(robot.arrays, inertia=jnp.asarray(INERTIA, jnp.float32))
    _, bodies = upright_scene(robot)
    still = jnp.zeros((1, 3))
    pos, quat = bodies.pos[:, robot.anchor], bodies.quat[:, robot.anchor]
    return arrays, AnchorMotion(pos, quat, lin_vel=still, ang_vel=still, lin_acc=still, ang_acc=still), bodies


def wrench_of(robot, arrays, reference, bodies) -> tuple[np.ndarray, np.ndarray]:
    wrench = np.asarray(reference_wrench(WrenchConfig(), arrays, reference, bodies, robot.anchor))[0]
    return wrench[:3], wrench[3:]


def anchor_set(robot, bodies, **values):
    fields = {
        name: getattr(bodies, name).at[0, robot.anchor].set(jnp.asarray(value, jnp.float32))
        for name, value in values.items()
    }
    return dataclasses.replace(bodies, **fields)


def moving(reference: AnchorMotion, **values) -> AnchorMotion:
    return dataclasses.replace(reference, **{name: jnp.asarray([value], jnp.float32) for name, value in values.items()})


def quat(turn: Rotation) -> np.ndarray:
    return turn.as_quat(scalar_first=True)


@pytest.mark.parametrize(("level", "gain"), [(1.0, 0.6), (0.68, 0.6), (0.6, 0.5), (0.44, 0.3), (0.2, 0.0), (0.0, 0.0)])
def test_gain_by_hand(level, gain):
    assert float(wrench_gain(WrenchConfig(), jnp.array(level))) == pytest.approx(gain, abs=1e-6)


def test_no_gain_where_the_wrench_is_off():
    np.testing.assert_array_equal(wrench_gain(WrenchConfig(max_gain=0.0), jnp.linspace(0, 1, 5)), 0.0)


def test_a_reference_in_free_fall_needs_no_force(robot, scene):
    arrays, reference, bodies = scene
    force, torque = wrench_of(robot, arrays, moving(reference, lin_acc=GRAVITY), bodies)
    np.testing.assert_allclose(force, 0.0, atol=1e-3)
    np.testing.assert_allclose(torque, 0.0, atol=1e-6)


def test_a_reference_at_rest_needs_the_robots_weight_upwards(robot, scene):
    arrays, reference, bodies = scene
    mass = robot.model.body_mass.sum()
    force, torque = wrench_of(robot, arrays, reference, bodies)
    np.testing.assert_allclose(force, [0.0, 0.0, mass * 9.81], rtol=1e-5)
    np.testing.assert_allclose(torque, 0.0, atol=1e-6)


def test_position_and_velocity_errors_pull_towards_the_reference(robot, scene):
    arrays, reference, bodies = scene
    mass = robot.model.body_mass.sum()
    off = anchor_set(
        robot, bodies, pos=bodies.pos[0, robot.anchor] - jnp.array([0.02, 0.0, 0.0]), lin_vel=[0.0, 0.3, 0.0]
    )
    force, _ = wrench_of(robot, arrays, reference, off)
    np.testing.assert_allclose(force, mass * np.array([100 * 0.02, -20 * 0.3, 9.81]), rtol=1e-4)


def test_torque_turns_the_shortest_way_with_the_inertia_turned_to_the_world(robot, scene):
    arrays, reference, bodies = scene
    # The robot faces y: its x axis (inertia 1) lies along the world's y, its y axis (inertia 2) along minus x.
    ahead = quat(Rotation.from_rotvec([0.1, 0.0, 0.0]) * QUARTER_TURN)
    _, torque = wrench_of(
        robot, arrays, moving(reference, quat=ahead), anchor_set(robot, bodies, quat=quat(QUARTER_TURN))
    )
    np.testing.assert_allclose(torque, [2.0 * 100 * 0.1, 0.0, 0.0], atol=1e-3)


def test_torque_damps_feeds_forward_and_balances_the_gyroscopic_moment(robot, scene):
    arrays, reference, bodies = scene
    reference = moving(reference, quat=quat(QUARTER_TURN), ang_vel=[1.0, 1.0, 0.5], ang_acc=[3.0, 0.0, 0.0])
    bodies = anchor_set(robot, bodies, quat=quat(QUARTER_TURN), ang_vel=[1.0, 1.0, 0.0])
    _, torque = wrench_of(robot, arrays, reference, bodies)
    world_inertia = np.diag([2.0, 1.0, 3.0])
    spin = np.array([1.0, 1.0, 0.0])
    by_hand = world_inertia @ [3.0, 0.0, 20 * 0.5] + np.cross(spin, world_inertia @ spin)
    np.testing.assert_allclose(by_hand, [6.0, 0.0, 29.0])
    np.testing.assert_allclose(torque, by_hand, atol=1e-3)


def test_in_mujoco_the_wrench_of_a_reference_at_rest_holds_the_centre_of_mass(robot, scene):
    arrays, reference, bodies = scene
    force, torque = wrench_of(robot, arrays, reference, bodies)
    data = mujoco.MjData(robot.model)
    data.qpos[:] = [0, 0, 3, 1, 0, 0, 0, *np.asarray(robot.arrays.default_joint_pos)]
    data.ctrl[:] = data.qpos[7:]
    data.xfrc_applied[robot.anchor_body_id] = [*force, *torque]
    mujoco.mj_step(robot.model, data, 4)
    mujoco.mj_subtreeVel(robot.model, data)
    assert np.linalg.norm(data.subtree_linvel[1]) < 1e-4  # 0.2 m/s without the force


def test_the_robots_inertia_is_that_of_its_bodies_at_the_default_pose(robot):
    data = mujoco.MjData(robot.model)
    data.qpos[:] = [0, 0, 1, 1, 0, 0, 0, *np.asarray(robot.arrays.default_joint_pos)]
    mujoco.mj_forward(robot.model, data)
    dense = np.zeros((robot.model.nv, robot.model.nv))
    mujoco.mj_fullM(robot.model, data, dense)
    # The free joint's angular block is the inertia about the root; the parallel-axis theorem takes it to the centre.
    offset = data.subtree_com[1] - data.xpos[1]
    mass = robot.model.body_mass.sum()
    about_com = dense[3:6, 3:6] - mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    np.testing.assert_allclose(robot.arrays.inertia, about_com, atol=1e-4)
