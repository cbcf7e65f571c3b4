import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from forgetmimic_jax.physics import PhysicsState
from forgetmimic_jax.settings.config import NoiseConfig
from forgetmimic_jax.tracking.randomise import nominal_parameters, physics_parameters, push, push_interval, reset_state
from forgetmimic_jax.tracking.reference import lookup

ENVS = 4000


def assert_fills(values, half_width) -> None:
    """Uniform in ± half_width: inside it, near its edges, as many above as below."""
    values, half_width = np.asarray(values), np.asarray(half_width)
    assert (np.abs(values) <= half_width + 1e-5).all()
    assert (np.abs(values).max(0) >= 0.98 * half_width).all()
    np.testing.assert_allclose(values.std(0), np.broadcast_to(half_width, values.shape[1:]) / np.sqrt(3.0), rtol=0.06)


@partial(jax.jit, static_argnums=0)
def compiled_reset(root: int, arrays, reference, key):
    return reset_state(NoiseConfig(), arrays, reference, root, key)


def reset_with_noise(robot, reference, seed: int) -> PhysicsState:
    return compiled_reset(robot.root, robot.arrays, reference, jax.random.PRNGKey(seed))


@pytest.fixture(scope="module")
def reset(robot, library):
    """Many resets at one frame of a clip that walks and turns, and that frame."""
    reference = lookup(library, jnp.ones(ENVS, jnp.int32), jnp.full(ENVS, 30))
    state = reset_with_noise(robot, reference, 0)
    return reference, state


def turns(quat) -> Rotation:
    return Rotation.from_quat(np.asarray(quat), scalar_first=True)


def test_reset_moves_the_root_by_the_papers_ranges(robot, reset):
    reference, state = reset
    assert_fills(state.qpos[:, :3] - reference.bodies.pos[:, robot.root], (0.05, 0.05, 0.01))


def test_reset_turns_the_root_about_the_worlds_axes(robot, reset):
    reference, state = reset
    noise = turns(state.qpos[:, 3:7]) * turns(reference.bodies.quat[:, robot.root]).inv()
    assert_fills(noise.as_euler("xyz"), (0.1, 0.1, 0.2))
    np.testing.assert_allclose(np.linalg.norm(state.qpos[:, 3:7], axis=-1), 1.0, atol=1e-5)


def test_reset_changes_the_roots_velocities_in_the_world(robot, reset):
    reference, state = reset
    assert_fills(state.qvel[:, :3] - reference.bodies.lin_vel[:, robot.root], (0.5, 0.5, 0.2))
    in_world = turns(state.qpos[:, 3:7]).apply(np.asarray(state.qvel[:, 3:6]))
    assert_fills(in_world - np.asarray(reference.bodies.ang_vel[:, robot.root]), (0.52, 0.52, 0.78))


def test_reset_moves_joints_by_a_tenth_of_a_rad_and_keeps_their_velocities(robot, reset):
    reference, state = reset
    np.testing.assert_array_equal(state.qvel[:, 6:], reference.joint_vel)
    noise = np.asarray(state.qpos[:, 7:] - reference.joint_pos)
    free = (reference.joint_pos[0] - robot.arrays.soft_lower > 0.1) & (
        robot.arrays.soft_upper - reference.joint_pos[0] > 0.1
    )
    assert free.sum() > 20
    assert_fills(noise[:, np.asarray(free)], np.full(int(free.sum()), 0.1))


def test_reset_noise_keeps_joints_inside_their_soft_limits(robot, reset):
    reference, _ = reset
    edge = dataclasses.replace(reference, joint_pos=jnp.broadcast_to(robot.arrays.soft_upper, (ENVS, 29)))
    state = reset_with_noise(robot, edge, 1)
    assert (state.qpos[:, 7:] <= robot.arrays.soft_upper + 1e-6).all()


def test_a_reference_beyond_its_soft_limit_is_not_pulled_inside(robot, reset):
    reference, _ = reset
    beyond = robot.arrays.soft_upper + 0.05
    outside = dataclasses.replace(reference, joint_pos=jnp.broadcast_to(beyond, (ENVS, 29)))
    state = reset_with_noise(robot, outside, 1)
    assert float(state.qpos[:, 7:].max(0)[3]) == pytest.approx(float(beyond[3]), abs=1e-6)


def test_a_push_changes_the_roots_velocity_in_the_world_and_no_joints(robot):
    lying = Rotation.from_euler("xyz", [1.4, 0.2, 0.5]).as_quat(scalar_first=True)
    qpos = jnp.tile(jnp.asarray([0.0, 0.0, 0.2, *lying, *[0.0] * 29], jnp.float32), (ENVS, 1))
    qvel = jnp.tile(jnp.linspace(-1.0, 1.0, 35), (ENVS, 1))
    pushed = push(NoiseConfig(), jax.random.PRNGKey(2), PhysicsState(qpos, qvel, qvel))
    np.testing.assert_array_equal(pushed[:, 6:], qvel[:, 6:])
    change = np.asarray(pushed - qvel)
    assert_fills(change[:, :3], (0.5, 0.5, 0.2))
    assert_fills(turns(qpos[:, 3:7]).apply(change[:, 3:6]), (0.52, 0.52, 0.78))


def test_a_push_comes_every_one_to_three_seconds():
    steps = np.asarray(push_interval(NoiseConfig(), jax.random.PRNGKey(3), ENVS, 0.02))
    assert steps.dtype == np.int32
    assert (steps.min(), steps.max()) == (50, 150)
    assert abs(steps.mean() - 100) < 2


def test_friction_and_centre_of_mass_are_drawn_in_their_ranges():
    parameters = physics_parameters(NoiseConfig(), jax.random.PRNGKey(4), ENVS)
    assert_fills(parameters.torso_com, (0.025, 0.05, 0.05))
    assert_fills(parameters.foot_friction[:, None] - 0.9, (0.6,))


def test_nominal_parameters_are_the_models_own():
    parameters = nominal_parameters(0.6, 3)
    np.testing.assert_allclose(parameters.foot_friction, 0.6)
    assert not np.asarray(parameters.torso_com).any()
