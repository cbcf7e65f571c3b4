import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from physics_cases import (
    CASES,
    CRAWLING,
    FLIGHT,
    GRAVITY,
    LIFTED,
    SETTLING_STEPS,
    STANDING,
    SUBSTEPS,
    TIMESTEP,
    floor_forces,
    key_body_velocities,
    plain_data,
    plain_model,
    rest_inputs,
)
from trees import assert_same

from forgetmimic_jax.physics import BodyState
from forgetmimic_jax.physics.native import NativeEngine
from forgetmimic_jax.robot.model import load_robot
from forgetmimic_jax.settings.config import PhysicsConfig

SINGLE = {"rtol": 2e-6, "atol": 2e-6}  # the engine computes in double precision and rounds its outputs once


def some_bodies(robot, rows):
    """Key bodies that no simulation gives: to be kept or overwritten."""
    rng = np.random.default_rng(1)
    shapes = {"pos": 3, "quat": 4, "lin_vel": 3, "ang_vel": 3, "contact_force": 3}
    return BodyState(
        **{k: jnp.asarray(rng.normal(size=(rows, len(robot.key_bodies), n)), jnp.float32) for k, n in shapes.items()}
    )


@pytest.mark.parametrize("row", CASES.values(), ids=CASES)
def test_step_is_a_plain_loop_of_mj_step(robot, inputs, native_result, row):
    model = plain_model(robot, inputs, row)
    data = plain_data(robot, model, inputs, row)
    for _ in range(SUBSTEPS):
        mujoco.mj_step(model, data)
    state, bodies = native_result
    np.testing.assert_allclose(state.qpos[row], data.qpos, **SINGLE)
    np.testing.assert_allclose(state.qvel[row], data.qvel, **SINGLE)
    np.testing.assert_allclose(state.warmstart[row], data.qacc_warmstart, **SINGLE)
    np.testing.assert_allclose(bodies.contact_force[row], floor_forces(robot, model, data), rtol=2e-6, atol=1e-4)

    mujoco.mj_forward(model, data)
    lin_vel, ang_vel = key_body_velocities(robot, model, data)
    np.testing.assert_allclose(bodies.pos[row], data.xpos[robot.key_body_ids], **SINGLE)
    np.testing.assert_allclose(bodies.quat[row], data.xquat[robot.key_body_ids], **SINGLE)
    np.testing.assert_allclose(bodies.lin_vel[row], lin_vel, **SINGLE)
    np.testing.assert_allclose(bodies.ang_vel[row], ang_vel, **SINGLE)


def test_cases_touch_the_floor_as_their_names_say(robot, native_result):
    touching = np.linalg.norm(native_result[1].contact_force, axis=-1) > 1.0
    names = [{robot.key_bodies[i] for i in np.flatnonzero(row)} for row in touching]
    assert names[STANDING] == {robot.key_bodies[i] for i in robot.feet}
    assert names[FLIGHT] == names[LIFTED] == set()
    assert {"left_knee_link", "right_knee_link", "left_wrist_yaw_link", "right_wrist_yaw_link"} <= names[CRAWLING]


def test_contact_force_of_a_standing_robot_is_its_weight_upwards(robot, native):
    state, parameters, target, wrench = rest_inputs(robot, len(CASES))
    for _ in range(SETTLING_STEPS):
        state, bodies = native.step(state, parameters, target, wrench)
    force = np.asarray(bodies.contact_force[0])
    others = np.delete(force, robot.feet, axis=0)
    weight = GRAVITY * float(robot.arrays.mass)
    assert weight == pytest.approx({"g1": 327.1, "h2": 741.5}[robot.name], abs=0.1)
    # It still sways a little: 0.3 m/s^2 of vertical acceleration is 3 % of its weight.
    assert force[robot.feet, 2].sum() == pytest.approx(weight, rel=0.03)
    assert (force[robot.feet, 2] > 100.0).all()
    assert not others.any()


def test_contact_forces_make_the_centre_of_mass_accelerate(robot, inputs):
    """Newton's second law for the whole robot, over one physics step in which all contacts are on key bodies."""
    engine = NativeEngine(robot, 1, len(CASES))
    state, bodies = engine.step(*inputs)
    for row in (STANDING, CRAWLING):
        model = plain_model(robot, inputs, row)
        data = plain_data(robot, model, inputs, row)
        before = momentum(model, data)
        data.qpos[:], data.qvel[:] = state.qpos[row], state.qvel[row]
        after = momentum(model, data)
        mass = float(robot.arrays.mass)
        outside = np.asarray(bodies.contact_force[row]).sum(0) + np.asarray(inputs.wrench[row, :3])
        outside[2] -= mass * GRAVITY
        np.testing.assert_allclose((after - before)[0] / TIMESTEP, outside, atol=1.0)


def momentum(model, data) -> np.ndarray:
    """Linear momentum and angular momentum about the centre of mass of the whole robot [2, 3], kg m/s and kg m^2/s."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_comVel(model, data)
    mujoco.mj_subtreeVel(model, data)
    return np.stack([data.subtree_linvel[1] * model.body_subtreemass[1], data.subtree_angmom[1]])


def test_wrench_is_a_force_and_torque_on_the_anchors_centre_of_mass_in_the_world_frame(robot, inputs):
    """A wrench of M g holds the centre of mass in free fall; its torque and lever arm turn the robot."""
    fine, substeps = 1e-4, 10  # s: momentum is kept but for the integrator's error, which is of the order of the step
    robot = load_robot(robot.name, PhysicsConfig(timestep=fine))
    model = plain_model(robot, inputs, LIFTED)
    data = plain_data(robot, model, inputs, LIFTED)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    wrench = np.asarray(inputs.wrench[LIFTED], np.float64)
    arm = data.xipos[robot.anchor_body_id] - data.subtree_com[1]
    torque = wrench[3:] + np.cross(arm, wrench[:3])
    state, _ = NativeEngine(robot, substeps, len(CASES)).step(*inputs)
    data.qpos[:], data.qvel[:] = state.qpos[LIFTED], state.qvel[LIFTED]
    linear, angular = momentum(model, data) / (fine * substeps)
    weight = float(robot.arrays.mass) * GRAVITY
    np.testing.assert_allclose(linear, 0.0, atol=1e-4 * weight)
    np.testing.assert_allclose(angular, torque, atol=1e-3 * np.linalg.norm(torque))


def test_forward_is_mj_forward_in_masked_rows_and_touches_no_other(robot, native, inputs):
    mask = jnp.asarray([True, False, True, False, True])
    old = some_bodies(robot, len(CASES))
    bodies = native.forward(inputs.state, inputs.parameters, mask, old)
    for row in np.flatnonzero(mask):
        model = plain_model(robot, inputs, row)
        data = plain_data(robot, model, inputs, row)
        mujoco.mj_forward(model, data)
        lin_vel, ang_vel = key_body_velocities(robot, model, data)
        np.testing.assert_allclose(bodies.pos[row], data.xpos[robot.key_body_ids], **SINGLE)
        np.testing.assert_allclose(bodies.quat[row], data.xquat[robot.key_body_ids], **SINGLE)
        np.testing.assert_allclose(bodies.lin_vel[row], lin_vel, **SINGLE)
        np.testing.assert_allclose(bodies.ang_vel[row], ang_vel, **SINGLE)
        assert not np.any(bodies.contact_force[row])
    kept = np.flatnonzero(~mask)
    assert_same(jax.tree.map(lambda x: x[kept], bodies), jax.tree.map(lambda x: x[kept], old))


def test_calls_in_between_leave_no_trace(robot, native, inputs, native_result):
    other = rest_inputs(robot, len(CASES))
    broken = other.state.replace(qvel=other.state.qvel.at[1].set(jnp.nan))
    bodies = some_bodies(robot, len(CASES))
    mask = jnp.asarray([False, True, True, False, False])
    before = native.forward(inputs.state, inputs.parameters, mask, bodies)
    native.step(*other)
    native.step(broken, *other[1:])
    native.forward(other.state, other.parameters, ~mask, bodies)
    assert_same(native.step(*inputs), native_result)
    # The state is that of the last step here: only the randomised values differ.
    native.step(inputs.state, other.parameters, inputs.target, inputs.wrench)
    assert_same(native.step(*inputs), native_result)
    assert_same(native.forward(inputs.state, inputs.parameters, mask, bodies), before)


@pytest.mark.parametrize("threads", [1, 3])
def test_thread_count_does_not_matter(robot, inputs, native_result, threads):
    engine = NativeEngine(robot, SUBSTEPS, len(CASES), num_threads=threads)
    assert_same(engine.step(*inputs), native_result)


def test_rollout_inside_jit_equals_a_loop(native, inputs):
    """The callback neither moves nor merges under jit and scan."""

    @jax.jit
    def rollout(state):
        return jax.lax.scan(lambda s, _: native.step(s, *inputs[1:]), state, length=3)

    final, bodies = rollout(inputs.state)
    state = inputs.state
    for step in range(3):
        state, one = native.step(state, *inputs[1:])
        np.testing.assert_allclose(bodies.lin_vel[step], one.lin_vel, atol=1e-6)
    assert_same(final, state)


def test_members_of_a_vmap_are_stepped_as_if_alone(robot, native, inputs, native_result):
    """Whole trainings can be vmapped, for which each member's batch is stepped in turn."""
    other = rest_inputs(robot, len(CASES))
    both = jax.vmap(native.step)(*jax.tree.map(lambda *leaves: jnp.stack(leaves), inputs, other))
    assert_same(jax.tree.map(lambda x: x[0], both), native_result)
    assert_same(jax.tree.map(lambda x: x[1], both), native.step(*other))


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e12])
def test_a_diverged_row_is_not_finite_and_alone(native, inputs, native_result, value, capfd, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    state = inputs.state.replace(qvel=inputs.state.qvel.at[FLIGHT, 9].set(value))
    result = native.step(state, *inputs[1:])
    jax.block_until_ready(result)
    sound = np.delete(np.arange(len(CASES)), FLIGHT)
    assert_same(*(jax.tree.map(lambda x: x[sound], r) for r in (result, native_result)))
    assert not all(np.isfinite(leaf[FLIGHT]).all() for leaf in jax.tree.leaves(result))
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())


def test_the_robots_own_model_is_left_as_it_was(robot):
    autoreset = int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    NativeEngine(robot, SUBSTEPS, 1)
    assert not robot.model.opt.disableflags & autoreset
