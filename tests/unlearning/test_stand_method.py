"""What the teacher of `stand` sees and does: by hand, and beside an environment whose reference really is the stand."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from orders import isaac_order
from scene import key_bodies, physics_state
from scipy.spatial.transform import Rotation

from forgetmimic_jax.robot.model import Robot, load_robot
from forgetmimic_jax.settings.config import ActionConfig, ObservationConfig, UnlearnConfig
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.env import Assets, Environment, EnvState, make_assets
from forgetmimic_jax.tracking.layouts import LAYOUTS
from forgetmimic_jax.tracking.observation import actor_observation
from forgetmimic_jax.tracking.rsi import Start
from forgetmimic_jax.tracking.setup import Setup, instead_of_targets
from forgetmimic_jax.tracking.stand import stand_frame, stand_library
from forgetmimic_jax.unlearning.stand import taught_action, teacher_moment

KEY = jax.random.PRNGKey(0)
SWAY, TURN = 0, 1  # the clip to keep and the clip to forget, of 80 and 41 frames
FRAME = 7


def setup_of(robot: Robot, library, config, mode: str, layout: str, order=(), instead: str = "stand") -> Setup:
    """`turn` is to be forgotten, and `instead` done in its place."""
    action = ActionConfig(mode, order)
    config = dataclasses.replace(
        config,
        observation=ObservationConfig(layout),
        action=action,
        unlearn=UnlearnConfig(("turn",), "stand", {"keep": 4.0}, instead),
    )
    mine = load_robot("g1", action=action) if order else robot
    return Setup(config, mine, library, "", instead=instead_of_targets(config, mine, library))


def puppet(setup: Setup, physics, bodies, seen: list) -> Environment:
    """An environment whose engine takes the robot where the test says, and writes down the joint targets sent."""

    def step(state, parameters, target, wrench):
        seen.append(np.asarray(target))
        return physics, bodies

    return Environment(setup.config, setup.robot, SimpleNamespace(step=step), 1, noisy=False)


def started(env: Environment, assets: Assets, clip: int, frame: int) -> EnvState:
    clip_, frame_ = jnp.array([clip]), jnp.array([frame])
    return tracking.start_episodes(env, assets, KEY, Start(clip_, jnp.array([0]), frame_), jnp.zeros(1))


def leaning(robot: Robot, yaw: float, place: tuple[float, float]) -> tuple:
    """A moving robot that leans forwards by 0.2 rad, its anchor above the stand's, both turned and moved together."""
    rng = np.random.default_rng(1)
    data = mujoco.MjData(robot.model)
    joints = np.asarray(robot.arrays.default_joint_pos) + 0.1 * rng.standard_normal(robot.num_joints)
    joints[[name.startswith("waist") for name in robot.joint_names]] = 0.0
    turn = Rotation.from_euler("z", yaw)
    data.qpos[:7] = [0, 0, 0.7, *(turn * Rotation.from_euler("y", 0.2)).as_quat(scalar_first=True)]
    data.qpos[7:] = joints
    mujoco.mj_kinematics(robot.model, data)
    wanted = turn.apply(np.asarray(stand_frame(robot).bodies.pos[robot.anchor]))[:2] + place
    data.qpos[:2] += wanted - data.xpos[robot.anchor_body_id][:2]
    velocity = rng.standard_normal(robot.model.nv)
    data.qvel[:] = [*turn.apply(velocity[:3]), *velocity[3:]]
    mujoco.mj_forward(robot.model, data)
    return physics_state(data), key_bodies(robot, data)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_teacher_sees_what_a_policy_sees_whose_reference_is_the_stand(robot, library, tiny_config, layout):
    """The same joint targets were sent to both, and both robots are then in the same state; one of them elsewhere."""
    mode = "offset" if layout.startswith("mjlab") else "residual"
    forgetting = setup_of(robot, library, tiny_config, mode, layout)
    standing = dataclasses.replace(forgetting, library=stand_library(robot, 50))
    action = jnp.asarray(np.random.default_rng(0).standard_normal((1, 29)), jnp.float32)

    sent: list[np.ndarray] = []
    env, assets = puppet(forgetting, *leaning(robot, 1.1, (3.0, -2.0)), sent), make_assets(forgetting)
    after, _ = tracking.step(env, assets, started(env, assets, TURN, FRAME), action, KEY)
    seen = actor_observation(env.layout, robot.policy_joints, teacher_moment(env, assets, after))

    of_stand, assets = puppet(standing, *leaning(robot, 0.0, (0.0, 0.0)), sent), make_assets(standing)
    same = (sent[0] - np.asarray(robot.arrays.default_joint_pos)) / np.asarray(robot.arrays.action_scale)
    there, _ = tracking.step(of_stand, assets, started(of_stand, assets, 0, 0), jnp.asarray(same), KEY)
    np.testing.assert_allclose(sent[1], sent[0], atol=1e-6)
    np.testing.assert_allclose(seen, tracking.observe(of_stand, assets, there, None)[0], atol=2e-5)


@pytest.mark.parametrize("layout", ["root132", "mjlab154"])
def test_at_the_start_of_an_episode_there_is_no_last_action(robot, library, tiny_config, layout):
    mode = "offset" if layout.startswith("mjlab") else "residual"
    setup = setup_of(robot, library, tiny_config, mode, layout)
    env, assets = puppet(setup, None, None, []), make_assets(setup)
    np.testing.assert_array_equal(teacher_moment(env, assets, started(env, assets, TURN, FRAME)).last_action, 0.0)


@pytest.mark.parametrize("order", ["the robot's order", "Isaac Lab's order"])
@pytest.mark.parametrize("mode", ["residual", "offset"])
@pytest.mark.parametrize("frame", [FRAME, 45])
def test_the_taught_action_sends_the_joint_targets_that_the_teacher_would(
    robot, library, tiny_config, mode, order, frame
):
    """By hand: q* = q_default + s a of the teacher; the student's action is (q* − q̂)/s, or a itself as an offset."""
    names = isaac_order(robot) if order == "Isaac Lab's order" else robot.joint_names
    setup = setup_of(robot, library, tiny_config, mode, "mjlab154", names if order == "Isaac Lab's order" else ())
    env, assets = puppet(setup, None, None, []), make_assets(setup)
    action = np.random.default_rng(0).standard_normal(29).astype(np.float32)
    assets = dataclasses.replace(assets, teacher=SimpleNamespace(mean_action=lambda seen: jnp.asarray(action)[None]))
    found = np.asarray(taught_action(env, assets, started(env, assets, TURN, frame)))[0]
    default, scale = (np.asarray(x) for x in (robot.arrays.default_joint_pos, robot.arrays.action_scale))
    reference = library.clip(TURN).joint_pos[min(frame + 1, 40)]
    for joint, name in enumerate(robot.joint_names):
        place = list(names).index(name)
        target = default[joint] + scale[joint] * action[place]
        expected = (target - reference[joint]) / scale[joint] if mode == "residual" else action[place]
        assert found[place] == pytest.approx(expected, abs=1e-4), name


@pytest.mark.parametrize("mode", ["residual", "offset"])
def test_a_target_with_the_stand_as_reference_is_an_episode_of_the_stand(robot, library, tiny_config, mode):
    """The same action sends the same joint targets, and state, reward and observation are the same."""
    forgetting = setup_of(robot, library, tiny_config, mode, "wbc132")
    standing = dataclasses.replace(forgetting, library=stand_library(robot, 50))
    action = jnp.asarray(np.random.default_rng(0).standard_normal((1, 29)), jnp.float32)

    sent: list[np.ndarray] = []
    env = dataclasses.replace(puppet(forgetting, *leaning(robot, 1.1, (3.0, -2.0)), sent), replace_reference=True)
    assets = make_assets(forgetting)
    after, replaced = tracking.step(env, assets, started(env, assets, TURN, FRAME), action, KEY)
    seen = tracking.observe(env, assets, after, None)[0]

    of_stand, assets = puppet(standing, *leaning(robot, 0.0, (0.0, 0.0)), sent), make_assets(standing)
    there, plain = tracking.step(of_stand, assets, started(of_stand, assets, 0, 0), action, KEY)
    np.testing.assert_allclose(sent[0], sent[1], atol=1e-6)
    np.testing.assert_allclose(replaced.reward.normalized_tracking, plain.reward.normalized_tracking, atol=1e-5)
    np.testing.assert_allclose(seen, tracking.observe(of_stand, assets, there, None)[0], atol=2e-5)


def test_a_kept_clip_keeps_its_reference(robot, library, tiny_config):
    setup = setup_of(robot, library, tiny_config, "residual", "root132")
    env, assets = dataclasses.replace(puppet(setup, None, None, []), replace_reference=True), make_assets(setup)
    following = tracking.reference_of(env, assets, started(env, assets, SWAY, FRAME), ahead=1)
    np.testing.assert_array_equal(following.joint_pos[0], library.clip(SWAY).joint_pos[FRAME + 1])


def test_a_kept_clip_instead_is_shown_at_the_target_s_frame_and_held_with_it(robot, library, tiny_config):
    """`turn` ends at frame 40, `sway` in its place does not pass frame 40 either."""
    setup = setup_of(robot, library, tiny_config, "residual", "root132", instead="sway")
    env, assets = puppet(setup, None, None, []), make_assets(setup)
    for frame, shown in ((FRAME, FRAME + 1), (39, 40), (60, 40)):
        moment = teacher_moment(env, assets, started(env, assets, TURN, frame))
        np.testing.assert_array_equal(moment.reference.joint_pos[0], library.clip(SWAY).joint_pos[shown])


def test_against_a_kept_clip_the_last_action_is_of_the_joint_targets_sent(robot, library, tiny_config):
    """By hand: q* = q̂_turn(8) + s a, and the last action is (q* − q̂_sway(8))/s."""
    setup = setup_of(robot, library, tiny_config, "residual", "root132", instead="sway")
    sent: list[np.ndarray] = []
    env, assets = puppet(setup, *leaning(robot, 0.0, (0.0, 0.0)), sent), make_assets(setup)
    after, _ = tracking.step(env, assets, started(env, assets, TURN, FRAME), jnp.full((1, 29), 0.5), KEY)
    turn, sway = (library.clip(clip).joint_pos[FRAME + 1] for clip in (TURN, SWAY))
    scale = np.asarray(robot.arrays.action_scale)
    np.testing.assert_allclose(sent[0][0], turn + 0.5 * scale, atol=1e-6)
    found = teacher_moment(env, assets, after).last_action[0]
    np.testing.assert_allclose(found, (turn + 0.5 * scale - sway) / scale, atol=1e-4)
