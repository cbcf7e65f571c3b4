import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scene import on_reference, shaken, turned, upright_scene
from scipy.spatial.transform import Rotation

from forgetmimic_jax.physics import PhysicsState
from forgetmimic_jax.settings.config import RewardConfig
from forgetmimic_jax.tracking.reference import align_to_anchor, lookup
from forgetmimic_jax.tracking.reward import (
    TERMS,
    Pair,
    regularisation_reward,
    total_tracking_weight,
    tracking_kernels,
    tracking_reward,
    tracking_weights,
)

# The paper's table of reward terms: w > 0 of the tracking terms.
PAPER_WEIGHTS = {
    "root_position": 1.0,
    "root_orientation": 1.0,
    "root_linear_velocity": 1.0,
    "root_angular_velocity": 1.0,
    "body_position": 1.0,
    "body_orientation": 1.0,
    "body_linear_velocity": 0.5,
    "body_angular_velocity": 0.5,
    "joint_position": 1.0,
}
ROOT_TERMS = [name for name in PAPER_WEIGHTS if name.startswith("root")]
QUARTER = np.exp(-0.25)  # a kernel with κ = 1/4 whose error is exactly σ
WITH_JOINT_VELOCITY = RewardConfig(joint_velocity=1.0)


@partial(jax.jit, static_argnums=(0, 1))
def compiled_reward(config, anchor, reference, bodies, joint_pos, joint_vel):
    aligned = align_to_anchor(reference, anchor, bodies.pos[:, anchor], bodies.quat[:, anchor])
    kernels = tracking_kernels(Pair(reference, aligned, bodies, joint_pos, joint_vel, anchor))
    return *tracking_reward(kernels, config), kernels


def terms_of(robot, reference, bodies, joint_pos=None, joint_vel=None) -> dict[str, np.ndarray]:
    joint_pos = reference.joint_pos if joint_pos is None else joint_pos
    joint_vel = reference.joint_vel if joint_vel is None else joint_vel
    terms = compiled_reward(RewardConfig(), robot.anchor, reference, bodies, joint_pos, joint_vel)[2]
    return {name: np.asarray(value) for name, value in terms.items()}


def test_weights_are_the_papers_and_sum_to_eight():
    assert tracking_weights(RewardConfig()) == PAPER_WEIGHTS
    assert total_tracking_weight(RewardConfig()) == sum(PAPER_WEIGHTS.values()) == 8.0


def test_every_term_has_a_weight_in_the_settings_and_zero_leaves_the_sum():
    assert {term.name for term in TERMS} == {*PAPER_WEIGHTS, "joint_velocity"}
    assert {term.name for term in TERMS} <= {field.name for field in dataclasses.fields(RewardConfig)}
    assert total_tracking_weight(WITH_JOINT_VELOCITY) == 9.0


def test_reward_is_full_when_the_robot_is_the_reference(robot, library):
    clip, frame = jnp.array([0, 1, 0]), jnp.array([0, 20, 79])
    reference = lookup(library, clip, frame)
    bodies, joints = on_reference(reference), (reference.joint_pos, reference.joint_vel)
    total, normalized, _ = compiled_reward(RewardConfig(), robot.anchor, reference, bodies, *joints)
    np.testing.assert_allclose(total, 8.0, atol=1e-5)
    np.testing.assert_allclose(normalized, 1.0, atol=1e-6)


def test_root_position_kernel_at_one_sigma_of_0_4_m(robot):
    reference, bodies = upright_scene(robot)
    terms = terms_of(robot, reference, dataclasses.replace(bodies, pos=bodies.pos + jnp.array([0.0, 0.4, 0.0])))
    np.testing.assert_allclose(terms["root_position"], QUARTER, rtol=1e-5)
    np.testing.assert_allclose(terms["body_position"], 1.0, atol=1e-6)


def test_root_orientation_kernel_at_one_sigma_of_half_a_rad(robot):
    reference, bodies = upright_scene(robot)
    terms = terms_of(robot, reference, turned(bodies, 0.5, (0.0, 0.0)))
    np.testing.assert_allclose(terms["root_orientation"], QUARTER, rtol=1e-5)


def test_linear_velocity_kernels_by_hand(robot):
    reference, bodies = upright_scene(robot)
    terms = terms_of(robot, reference, dataclasses.replace(bodies, lin_vel=bodies.lin_vel + jnp.array([0.36, 0.48, 0])))
    np.testing.assert_allclose(terms["root_linear_velocity"], QUARTER, rtol=1e-5)  # 0.6 m/s over σ = 0.6
    np.testing.assert_allclose(terms["body_linear_velocity"], np.exp(-0.36), rtol=1e-5)  # κ = 1, σ = 1


def test_angular_velocity_kernels_by_hand(robot):
    reference, bodies = upright_scene(robot)
    terms = terms_of(robot, reference, dataclasses.replace(bodies, ang_vel=bodies.ang_vel + jnp.array([0.0, 0.0, 1.5])))
    np.testing.assert_allclose(terms["root_angular_velocity"], QUARTER, rtol=1e-5)
    np.testing.assert_allclose(terms["body_angular_velocity"], np.exp(-((1.5 / 3.14) ** 2)), rtol=1e-5)


def test_body_position_kernel_when_every_body_is_20_cm_too_high(robot):
    reference, bodies = upright_scene(robot)
    terms = terms_of(robot, reference, dataclasses.replace(bodies, pos=bodies.pos + jnp.array([0.0, 0.0, 0.2])))
    np.testing.assert_allclose(terms["body_position"], QUARTER, rtol=1e-5)
    np.testing.assert_allclose(terms["root_position"], np.exp(-0.25 * 0.25), rtol=1e-5)  # (0.2 / 0.4)²


def test_body_orientation_kernel_when_every_body_is_pitched(robot):
    reference, bodies = upright_scene(robot)
    pitch = jnp.asarray(Rotation.from_euler("y", 0.4).as_quat(scalar_first=True), jnp.float32)
    terms = terms_of(robot, reference, dataclasses.replace(bodies, quat=jnp.broadcast_to(pitch, bodies.quat.shape)))
    np.testing.assert_allclose(terms["body_orientation"], QUARTER, rtol=1e-5)
    np.testing.assert_allclose(terms["root_orientation"], np.exp(-0.25 * 0.64), rtol=1e-5)  # (0.4 / 0.5)²


def test_joint_kernels_when_every_joint_is_one_sigma_off(robot):
    reference, bodies = upright_scene(robot)
    terms = terms_of(robot, reference, bodies, reference.joint_pos - 0.3, reference.joint_vel + 2.0)
    np.testing.assert_allclose(terms["joint_position"], QUARTER, rtol=1e-5)
    np.testing.assert_allclose(terms["joint_velocity"], QUARTER, rtol=1e-5)


def test_sigma_per_body_is_sigma_root_n_on_the_summed_error(robot):
    reference, bodies = upright_scene(robot)
    rng = np.random.default_rng(1)
    offsets = 0.2 * rng.standard_normal(bodies.pos.shape)
    offsets[:, robot.anchor] = 0.0
    terms = terms_of(robot, reference, dataclasses.replace(bodies, pos=bodies.pos + jnp.asarray(offsets, jnp.float32)))
    summed = sum(float(offset @ offset) for offset in offsets[0])
    sigma_eff = 0.2 * np.sqrt(14)
    np.testing.assert_allclose(terms["body_position"], np.exp(-0.25 * summed / sigma_eff**2), rtol=1e-4)


def test_sigma_per_joint_is_sigma_root_n_on_the_summed_error(robot):
    reference, bodies = upright_scene(robot)
    offsets = np.random.default_rng(2).standard_normal(29)
    terms = terms_of(robot, reference, bodies, reference.joint_pos + jnp.asarray(offsets, jnp.float32))
    np.testing.assert_allclose(terms["joint_position"], np.exp(-0.25 * (offsets @ offsets) / (0.09 * 29)), rtol=1e-4)


def test_body_poses_do_not_see_where_the_robot_stands_nor_its_heading(robot, library):
    reference = lookup(library, jnp.array([1]), jnp.array([25]))
    bodies = shaken(on_reference(reference), seed=3)
    here = terms_of(robot, reference, bodies)
    for yaw, shift in [(0.7, (2.0, -1.0)), (-2.5, (0.0, 0.3)), (3.1, (-5.0, 5.0))]:
        there = terms_of(robot, reference, turned(bodies, yaw, shift))
        for name in ("body_position", "body_orientation", "joint_position"):
            np.testing.assert_allclose(there[name], here[name], atol=2e-5, err_msg=name)


def test_root_terms_see_where_the_robot_stands_and_its_heading(robot, library):
    reference = lookup(library, jnp.array([1]), jnp.array([25]))
    there = terms_of(robot, reference, turned(on_reference(reference), 1.5, (1.0, 0.0)))
    for name in ROOT_TERMS:
        assert there[name] < 0.999, name


def test_root_velocity_is_compared_in_the_world(robot, library):
    reference = lookup(library, jnp.array([0]), jnp.array([40]))
    bodies = turned(on_reference(reference), np.pi / 2, (0.0, 0.0))
    velocity = np.asarray(reference.bodies.lin_vel[0, robot.anchor])
    difference = velocity - Rotation.from_euler("z", np.pi / 2).apply(velocity)
    expected = np.exp(-0.25 * (difference @ difference) / 0.36)
    np.testing.assert_allclose(terms_of(robot, reference, bodies)["root_linear_velocity"], expected, rtol=1e-4)


def test_a_heading_error_of_half_a_rad_costs_in_the_body_velocities(robot):
    """wbc-mjlab compares them in the world. A turn by θ moves a horizontal v by 2 v sin(θ/2): 0.9896 m/s of 2 m/s, and
    1.4844 rad/s of 3 rad/s. Kernels with κ = 1: exp(−0.9896²) = 0.3756 and exp(−(1.4844 / 3.14)²) = 0.7997."""
    reference, _ = upright_scene(robot)
    reference = dataclasses.replace(
        reference,
        bodies=dataclasses.replace(
            reference.bodies,
            lin_vel=reference.bodies.lin_vel + jnp.array([2.0, 0.0, 0.0]),
            ang_vel=reference.bodies.ang_vel + jnp.array([0.0, 3.0, 0.0]),
        ),
    )
    straight = terms_of(robot, reference, on_reference(reference))
    astray = terms_of(robot, reference, turned(on_reference(reference), 0.5, (0.0, 0.0)))
    by_hand = {"body_linear_velocity": 0.3756, "body_angular_velocity": 0.7997}
    for name, value in by_hand.items():
        np.testing.assert_allclose(straight[name], 1.0, atol=1e-6)
        np.testing.assert_allclose(astray[name], value, atol=1e-4)


def test_height_is_not_aligned_away(robot):
    reference, bodies = upright_scene(robot)
    lower = dataclasses.replace(bodies, pos=bodies.pos - jnp.array([0.0, 0.0, 0.3]))
    assert terms_of(robot, reference, lower)["body_position"] < 0.6


def test_tracking_reward_is_the_weighted_sum_and_its_mean_lies_in_the_unit_interval():
    kernels = {term.name: jnp.array([0.5, 1.0, 0.0]) for term in TERMS} | {
        "body_linear_velocity": jnp.array([0.1, 1, 0])
    }
    total, normalized = tracking_reward(kernels, RewardConfig())
    np.testing.assert_allclose(total, [7.5 * 0.5 + 0.5 * 0.1, 8.0, 0.0], rtol=1e-6)
    np.testing.assert_allclose(normalized, [3.8 / 8.0, 1.0, 0.0], rtol=1e-6)


def test_a_term_of_weight_zero_has_a_kernel_but_no_part_in_the_reward():
    kernels = {term.name: jnp.ones(1) for term in TERMS} | {"joint_velocity": jnp.zeros(1)}
    assert [float(value[0]) for value in tracking_reward(kernels, RewardConfig())] == [8.0, 1.0]
    assert [float(value[0]) for value in tracking_reward(kernels, WITH_JOINT_VELOCITY)] == [8.0, pytest.approx(8 / 9)]


def regularisation(robot, config=RewardConfig(), **changes) -> float:  # noqa: B008 (a frozen dataclass)
    """R_reg of a robot at rest in its default pose, with the values given changed."""
    still = jnp.zeros((1, robot.num_joints))
    default = robot.arrays.default_joint_pos[None]
    values = dict(
        action=still, last_action=still, joint_pos=default, joint_vel=still, joint_acc=still, joint_target=default
    )
    values |= changes
    joints, roots = [values.pop(name) for name in ("joint_pos", "joint_vel", "joint_acc")], (7, 6, 6)
    physics = PhysicsState(*(jnp.pad(x, ((0, 0), (root, 0))) for x, root in zip(joints, roots, strict=True)))
    return float(regularisation_reward(robot.arrays, config, physics=physics, **values)[0])


def test_a_robot_at_rest_gets_the_survival_bonus_alone(robot):
    assert regularisation(robot) == 1.0


def test_action_rate_costs_a_tenth_of_the_absolute_change(robot):
    action = jnp.full((1, 29), -0.5).at[0, 0].set(1.0)
    assert regularisation(robot, action=action) == pytest.approx(1.0 - 0.1 * (28 * 0.5 + 1.0))
    assert regularisation(robot, action=action, last_action=action) == pytest.approx(1.0)


def test_joint_acceleration_costs_by_its_absolute_value(robot):
    acceleration = jnp.full((1, 29), -1000.0)
    assert regularisation(robot, joint_acc=acceleration) == pytest.approx(1.0 - 5e-6 * 29_000)


@pytest.mark.parametrize("side", ["upper", "lower"])
def test_joint_limit_costs_the_angle_beyond_nine_tenths_of_the_range(robot, side):
    knee = robot.joint_names.index("left_knee_joint")
    low, high = robot.model.joint("left_knee_joint").range
    limit = 0.5 * (low + high) + (0.9 if side == "upper" else -0.9) * 0.5 * (high - low)
    beyond = limit + (0.07 if side == "upper" else -0.07)
    joint_pos = robot.arrays.default_joint_pos[None].at[0, knee].set(beyond)
    assert regularisation(robot, joint_pos=joint_pos, joint_target=joint_pos) == pytest.approx(1.0 - 0.07, abs=1e-5)


def test_torque_beyond_nine_tenths_costs_its_share_of_the_motors_limit(robot):
    knee = robot.joint_names.index("left_knee_joint")
    kp, effort = 0.025101925 * (20 * np.pi) ** 2, 139.0
    default = robot.arrays.default_joint_pos[None]

    def cost(torque: float) -> float:
        return 1.0 - regularisation(robot, joint_target=default.at[0, knee].add(torque / kp))

    assert cost(0.89 * effort) == pytest.approx(0.0, abs=1e-6)
    assert cost(-0.95 * effort) == pytest.approx(0.1 * 0.05, abs=1e-5)
    assert cost(5.0 * effort) == pytest.approx(0.1 * 0.1, abs=1e-6)  # the motor saturates


def test_torque_includes_the_damping(robot):
    kd, effort = 4.0 * 0.025101925 * 20 * np.pi, 139.0
    knee = robot.joint_names.index("right_knee_joint")
    joint_vel = jnp.zeros((1, 29)).at[0, knee].set(0.95 * effort / kd)
    assert regularisation(robot, joint_vel=joint_vel) == pytest.approx(1.0 - 0.1 * 0.05, abs=1e-5)
