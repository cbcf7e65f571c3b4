import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scene import as_reference, on_reference, posed, turned
from scipy.spatial.transform import Rotation

from forgetmimic_jax.robot.model import load_robot
from forgetmimic_jax.tracking import stand
from forgetmimic_jax.tracking.reference import at_anchor
from forgetmimic_jax.tracking.stand import stand_frame, stand_library


@pytest.mark.parametrize("name", ["g1", "h2"])
def test_the_stand_is_the_default_pose_at_rest_as_mujoco_has_it(name):
    robot = load_robot(name)
    data = mujoco.MjData(robot.model)
    data.qpos[:7] = [0, 0, robot.default_height, 1, 0, 0, 0]
    data.qpos[7:] = np.asarray(robot.arrays.default_joint_pos)
    mujoco.mj_forward(robot.model, data)
    stand = stand_frame(robot)
    np.testing.assert_allclose(stand.joint_pos, data.qpos[7:], atol=1e-6)
    np.testing.assert_allclose(stand.bodies.pos, data.xpos[robot.key_body_ids], atol=1e-6)
    np.testing.assert_allclose(stand.bodies.quat, data.xquat[robot.key_body_ids], atol=1e-6)
    for still in (stand.joint_vel, stand.bodies.lin_vel, stand.bodies.ang_vel, stand.anchor_lin_acc):
        np.testing.assert_array_equal(still, 0.0)


def test_the_stand_has_as_many_frames_as_given(robot):
    library = stand_library(robot, frames=7)
    assert (library.names, int(library.length[0])) == (("stand",), 7)
    np.testing.assert_array_equal(library.frames.joint_pos[6], library.frames.joint_pos[0])


def fallen(robot, bodies):
    """By one of the two rules of a fall."""
    return stand.low(robot, bodies) | stand.tilted(robot, bodies)


def test_a_robot_in_its_default_pose_has_not_fallen(robot):
    assert not fallen(robot, standing(robot))[0]


def standing(robot):
    return on_reference(jax.tree.map(lambda values: values[None], stand_frame(robot)))


@pytest.mark.parametrize(("height", "falls"), [(0.381, False), (0.379, True)])
def test_a_root_below_half_of_its_standing_height_is_a_fall(robot, height, falls):
    """The G1's pelvis stands at 0.76 m."""
    bodies = standing(robot)
    bodies = dataclasses.replace(bodies, pos=bodies.pos.at[0, robot.root, 2].set(height))
    assert bool(fallen(robot, bodies)[0]) == falls


def test_no_other_body_s_height_is_a_fall(robot):
    bodies = standing(robot)
    others = jnp.array([body for body in range(14) if body != robot.root])
    assert not fallen(robot, dataclasses.replace(bodies, pos=bodies.pos.at[0, others, 2].set(0.01)))[0]


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize(("degrees", "falls"), [(59.0, False), (61.0, True), (-61.0, True), (180.0, True)])
def test_an_anchor_tilted_by_more_than_60_degrees_is_a_fall(robot, axis, degrees, falls):
    bodies = standing(robot)
    heading = Rotation.from_euler("z", 2.0) * Rotation.from_euler(axis, degrees, degrees=True)
    quat = jnp.asarray(heading.as_quat(scalar_first=True), jnp.float32)
    tilted = dataclasses.replace(bodies, quat=bodies.quat.at[0, robot.anchor].set(quat))
    assert bool(fallen(robot, tilted)[0]) == falls
    other = dataclasses.replace(bodies, quat=bodies.quat.at[0, robot.root].set(quat))
    assert not fallen(robot, other)[0]


def test_a_reference_at_the_anchor_is_the_one_that_was_turned_and_moved_away(robot):
    """Turned by 1.3 rad and moved by (4, -2) m, and then brought back to where its anchor was."""
    reference = as_reference(robot, posed(robot, 3))
    away = turned(on_reference(reference), 1.3, (4.0, -2.0))
    bodies = dataclasses.replace(
        reference.bodies, pos=away.pos, quat=away.quat, lin_vel=away.lin_vel, ang_vel=away.ang_vel
    )
    moved = dataclasses.replace(reference, bodies=bodies, anchor_lin_acc=jnp.array([[0.0, 1.0, 2.0]]))
    anchor = robot.anchor
    back = at_anchor(moved, anchor, reference.bodies.pos[:, anchor], reference.bodies.quat[:, anchor])
    for name in ("pos", "lin_vel", "ang_vel"):
        np.testing.assert_allclose(getattr(back.bodies, name), getattr(reference.bodies, name), atol=1e-5)
    same = np.abs(np.sum(np.asarray(back.bodies.quat * reference.bodies.quat), axis=-1))
    np.testing.assert_allclose(same, 1.0, atol=1e-6)
    np.testing.assert_array_equal(back.joint_pos, reference.joint_pos)
    expected = Rotation.from_euler("z", -1.3).apply([0.0, 1.0, 2.0])
    np.testing.assert_allclose(back.anchor_lin_acc[0], expected, atol=1e-6)
