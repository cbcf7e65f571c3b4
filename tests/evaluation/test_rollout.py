import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from forgetmimic_jax.evaluation.rollout import (
    CHUNK,
    Evaluator,
    Switched,
    episode_starts,
    evaluation_setup,
    step_errors,
)
from forgetmimic_jax.physics import BodyState
from forgetmimic_jax.policy.policy import Policy, init_policy
from forgetmimic_jax.ppo.rule import Rule
from forgetmimic_jax.settings.config import UnlearnConfig
from forgetmimic_jax.tracking.env import EnvState
from forgetmimic_jax.tracking.layouts import LAYOUTS
from forgetmimic_jax.tracking.reference import align_to_anchor, lookup
from forgetmimic_jax.tracking.reward import Pair
from forgetmimic_jax.tracking.setup import Setup, instead_of_targets

EPISODES = 4  # a clip; the library has two


@pytest.fixture(scope="module")
def evaluator(tiny_setup) -> Evaluator:
    return Evaluator(tiny_setup, episodes=EPISODES, seed=0)


@pytest.fixture(scope="module")
def zero_action(evaluator):
    return evaluator.rollout(None)


@pytest.fixture(scope="module")
def policy(robot, tiny_config) -> Policy:
    return init_policy(
        tiny_config.ppo, robot.num_joints, LAYOUTS["wbc132"].size(robot.num_joints), 623, jax.random.PRNGKey(0)
    )


def test_half_of_a_clips_episodes_start_at_its_beginning_and_half_are_spread_over_it():
    clip, frame = episode_starts(np.array([526, 226]), 20, seed=0)
    np.testing.assert_array_equal(clip, np.repeat([0, 1], 20))
    for index, span in ((0, 500), (1, 200)):  # a start leaves at least 25 steps
        starts = frame[clip == index]
        assert (starts[:10] == 0).all()
        np.testing.assert_array_equal(np.floor(starts[10:] / (span / 10)), np.arange(10))  # one in each tenth


def test_an_episode_keeps_25_steps_where_the_clip_has_them():
    lengths = np.array([30, 100, 400])
    clip, frame = episode_starts(lengths, 50, seed=3)
    assert (lengths[clip] - 1 - frame >= 25).all()


def test_a_very_short_clip_starts_at_its_beginning():
    assert not episode_starts(np.array([2, 20]), 6, seed=0)[1].any()


def test_starts_depend_on_the_seed_alone():
    lengths = np.array([300, 200])
    first, again, other = (episode_starts(lengths, 10, seed)[1] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_a_single_episode_starts_at_the_beginning():
    assert not episode_starts(np.array([300]), 1, seed=0)[1].any()


def test_evaluation_has_no_randomisation_and_no_wrench_but_the_reset_noise_and_full_episodes(tiny_config, tiny_setup):
    wrench = dataclasses.replace(tiny_config.wrench, max_gain=0.6)
    trained = dataclasses.replace(tiny_config, wrench=wrench, max_episode_steps=120)
    config = evaluation_setup(dataclasses.replace(tiny_setup, config=trained)).config
    assert config.wrench.max_gain == 0.0
    assert config.max_episode_steps == 500
    assert config.noise == dataclasses.replace(trained.noise, enabled=False)


def test_an_episode_can_live_to_its_clips_end(zero_action, library):
    length = np.asarray(library.length)[zero_action.clip]
    np.testing.assert_array_equal(zero_action.horizon, length - 1 - zero_action.start_frame)
    assert zero_action.tracking_reward.shape == (2 * EPISODES, zero_action.horizon.max())


def test_the_zero_action_falls_at_last_and_has_tracked_until_then(zero_action):
    assert (zero_action.length >= 1).all()
    assert (zero_action.length < zero_action.horizon).any()
    first = zero_action.tracking_reward[:, 0]
    assert ((first > 0.3) & (first <= 1.0)).all()
    assert zero_action.nan_resets == 0


def test_the_same_policy_meets_the_same_fate(evaluator, zero_action):
    again = evaluator.rollout(None)
    np.testing.assert_array_equal(again.length, zero_action.length)
    np.testing.assert_array_equal(again.tracking_reward, zero_action.tracking_reward)


def test_a_policy_that_outputs_zero_is_the_zero_action(evaluator, zero_action, policy):
    silent = dataclasses.replace(policy, actor=jax.tree.map(jnp.zeros_like, policy.actor))
    rollout = evaluator.rollout(silent)  # its standard deviation is 1: sampled actions would be far from zero
    np.testing.assert_array_equal(rollout.length, zero_action.length)
    np.testing.assert_allclose(rollout.tracking_reward, zero_action.tracking_reward, atol=1e-6)


def test_a_policy_that_is_switched_off_is_the_zero_action(evaluator, zero_action, echo):
    policy = echo(0.2, 0.0)
    off, on = (evaluator.rollout(Switched(policy, jnp.asarray(value))) for value in (False, True))
    np.testing.assert_array_equal(off.tracking_reward, zero_action.tracking_reward)
    np.testing.assert_array_equal(on.tracking_reward, evaluator.rollout(policy).tracking_reward)
    assert not np.array_equal(on.tracking_reward, off.tracking_reward)


def test_under_a_rule_a_target_has_another_reference_and_runs_on(tiny_setup, library):
    """`turn` runs on for 0.5 s, which is 25 steps; with the stand as its reference the zero action stands."""
    unlearn = UnlearnConfig(("turn",), "stand", {}, "stand")
    config = dataclasses.replace(tiny_setup.config, unlearn=unlearn)
    setup = dataclasses.replace(
        tiny_setup, config=config, instead=instead_of_targets(config, tiny_setup.robot, library)
    )
    plain = Evaluator(setup, episodes=EPISODES, seed=0)
    other_rule = Evaluator(setup, episodes=EPISODES, seed=0, rule=Rule(runs_on=0.5, replace_reference=True))
    longer = np.asarray(other_rule.start().horizon) - np.asarray(plain.start().horizon)
    np.testing.assert_array_equal(longer, 25 * (plain.clip == library.names.index("turn")))
    one, other = plain.rollout(None), other_rule.rollout(None)
    target = plain.clip == library.names.index("turn")
    np.testing.assert_array_equal(one.tracking_reward[~target, 0], other.tracking_reward[~target, 0])
    assert (one.tracking_reward[target, 0] != other.tracking_reward[target, 0]).all()


@pytest.fixture(scope="module")
def echo(policy, robot) -> Callable[[float, float], Policy]:
    """A policy that gives every joint `bias` plus `gain` times the last action of the first joint, if that was above 0.

    Units of ELU are linear above 0, so one of each layer carries the last action through, and all else is zero.
    """

    def of(bias: float, gain: float) -> Policy:
        actor = jax.tree.map(jnp.zeros_like, policy.actor)
        first, middle, last = (actor["params"]["MLP_0"][f"Dense_{layer}"] for layer in range(3))
        first["kernel"] = first["kernel"].at[-robot.num_joints, 0].set(1.0)
        middle["kernel"] = middle["kernel"].at[0, 0].set(1.0)
        last["kernel"] = last["kernel"].at[0].set(gain)
        last["bias"] = jnp.full_like(last["bias"], bias)
        return dataclasses.replace(policy, actor=actor)

    return of


def start_of(evaluator: Evaluator, policy: Policy | None) -> EnvState:
    """The state in which the rollout of a policy begins; it ends right there."""
    states = []

    def advance(assets, policy, state, begin):
        states.append(jax.device_get(state))
        ended = np.ones((CHUNK, 2 * EPISODES), bool)
        return state, {"tracking_reward": np.zeros(ended.shape), "terminated": ended, "diverged": ~ended, "causes": {}}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluator, "_advance", advance)
        evaluator.rollout(policy)
    return states[0]


def test_every_policy_meets_the_same_starts_and_the_same_reset_noise(evaluator, library, echo):
    first, *others = (start_of(evaluator, policy) for policy in (None, echo(0.1, 0.0), echo(-0.1, 0.5)))
    for other in others:
        for one, two in zip(jax.tree.leaves(first), jax.tree.leaves(other), strict=True):
            np.testing.assert_array_equal(one, two)
    noise = first.physics.qpos[:, 7:] - library.at(evaluator.clip, evaluator.start_frame).joint_pos
    assert 0.09 < np.abs(noise).max() <= 0.1 + 1e-6  # rad
    assert len(np.unique(noise, axis=0)) == 2 * EPISODES  # episodes of one clip and frame too have each their own


def noisy(setup: Setup, **settings) -> Evaluator:
    """With the noise of these settings alone."""
    still = dict.fromkeys(("encoder_bias", "sensors"), 0.0) | {
        "torso_com": (0.0, 0.0, 0.0),
        "push_interval": (9.0, 9.0),
    }
    noise = dataclasses.replace(setup.config.noise, **still | {"foot_friction": (0.6, 0.6)} | settings)
    config = dataclasses.replace(setup.config, noise=noise)
    return Evaluator(dataclasses.replace(setup, config=config), episodes=EPISODES, seed=0, noise=True)


def test_with_noise_every_robot_is_another_one(tiny_setup):
    friction = np.asarray(noisy(tiny_setup, foot_friction=(0.3, 1.5)).start().parameters.foot_friction)
    assert len(np.unique(friction)) == 2 * EPISODES


def test_with_noise_robots_are_pushed_and_every_policy_alike(tiny_setup):
    pushed, still = noisy(tiny_setup, push_interval=(0.02, 0.02)), noisy(tiny_setup)
    first, again = pushed.rollout(None), pushed.rollout(None)
    np.testing.assert_array_equal(first.tracking_reward, again.tracking_reward)
    assert (np.abs(first.tracking_reward - still.rollout(None).tracking_reward)[:, 4] > 0.01).all()


def test_with_noise_a_policy_reads_its_sensors_wrongly(tiny_setup, policy):
    misread, read = (noisy(tiny_setup, sensors=sensors).rollout(policy).tracking_reward for sensors in (1.0, 0.0))
    assert (misread[:, 0] != read[:, 0]).all()


def test_a_policy_changes_the_robot_only_after_its_first_action(evaluator, echo):
    """Two policies that agree in their first action and part in the second, beside one that never acts."""
    still, steady, rising = (evaluator.rollout(echo(*policy)) for policy in ((0.0, 0.0), (0.2, 0.0), (0.2, 1.0)))
    one, two, three = (rollout.errors["joint_velocity_error"] for rollout in (still, steady, rising))
    np.testing.assert_allclose(three[:, 0], two[:, 0], rtol=1e-5)
    assert (np.abs(two[:, 0] - one[:, 0]) > 1e-3).all()
    assert (np.abs(three[:, 1] - two[:, 1]) > 1e-3).all()


def scripted(evaluator: Evaluator, terminated: dict[int, list[int]], diverged: dict[int, list[int]]):
    """A rollout in which environment `e` breaks a bound, or blows up, at the steps listed; r̄ is the step's number."""
    envs = 2 * EPISODES

    def advance(assets, policy, state, begin):
        steps = begin + np.arange(CHUNK)

        def marks(events: dict[int, list[int]]) -> np.ndarray:
            return np.stack([np.isin(steps, events.get(env, [])) for env in range(envs)], axis=1)

        broken = marks(terminated) | marks(diverged)
        reward = np.repeat(steps[:, None], envs, axis=1).astype(np.float32)
        causes = {"orientation": marks(terminated), "contact_force": marks({0: [20], 1: [60]})}
        return state, {
            "tracking_reward": reward,
            "terminated": broken,
            "diverged": marks(diverged),
            "causes": causes,
        }

    original, evaluator._advance = evaluator._advance, advance
    try:
        return evaluator.rollout(None)
    finally:
        evaluator._advance = original


def test_an_episode_lasts_until_its_first_termination(evaluator):
    rollout = scripted(evaluator, {0: [7, 9], 1: [60], 2: [0]}, {})
    np.testing.assert_array_equal(rollout.length[:3], [7, 60, 1])
    np.testing.assert_array_equal(rollout.length[3:], rollout.horizon[3:])
    np.testing.assert_array_equal(rollout.tracking_reward[1, :60], np.arange(60))


def test_a_fall_in_the_last_step_is_no_success_and_after_the_end_none_counts(evaluator):
    last = int(scripted(evaluator, {}, {}).horizon[0]) - 1
    rollout = scripted(evaluator, {0: [last], 1: [last + 1]}, {})
    assert rollout.length[0] == rollout.horizon[0] - 1
    assert rollout.length[1] == rollout.horizon[1]


def test_episodes_that_blow_up_are_counted_once_each_and_only_while_they_live(evaluator):
    rollout = scripted(evaluator, {2: [3]}, {0: [5, 6], 1: [10], 2: [8]})
    assert rollout.nan_resets == 2
    np.testing.assert_array_equal(rollout.length[:3], [5, 10, 3])


def test_the_bounds_that_end_an_episode_are_those_broken_in_its_last_step(evaluator):
    rollout = scripted(evaluator, {0: [7, 9], 1: [60]}, {2: [3]})
    assert {bound: list(np.flatnonzero(at)) for bound, at in rollout.ended_by.items()} == {
        "orientation": [0, 1],
        "contact_force": [1],
    }


def test_step_errors_by_hand(evaluator, robot):
    """The robot stands 1 m east of the reference, turned by 90°, 2 cm too high, and stands on one foot."""
    envs = 2 * EPISODES
    assets = evaluator._assets
    reference = lookup(assets.library, jnp.zeros(envs, jnp.int32), jnp.full(envs, 10))
    turn = Rotation.from_euler("z", np.pi / 2)
    pos = turn.apply(np.asarray(reference.bodies.pos).reshape(-1, 3)).reshape(reference.bodies.pos.shape)
    pos += [1.0, 0.0, 0.02]
    quat = (turn * Rotation.from_quat(np.asarray(reference.bodies.quat).reshape(-1, 4), scalar_first=True)).as_quat(
        scalar_first=True
    )
    wrist = robot.key_bodies.index("left_wrist_yaw_link")
    pos[:, wrist, 2] += 0.08
    force = np.zeros_like(pos)
    force[:, robot.feet[0]] = [0.0, 0.0, 150.0]
    force[:, robot.feet[1]] = [0.0, 0.0, 0.9]
    bodies = BodyState(*(jnp.asarray(x, jnp.float32) for x in (pos, quat.reshape(*pos.shape[:2], 4), pos, pos, force)))
    joint_pos = np.array(reference.joint_pos)
    knee = robot.joint_names.index("left_knee_joint")
    joint_pos[:, knee] = 2.85  # beyond 0.9 of its range
    off = joint_pos[0, knee] - float(reference.joint_pos[0, knee])
    aligned = align_to_anchor(reference, robot.anchor, bodies.pos[:, robot.anchor], bodies.quat[:, robot.anchor])
    joint_vel = reference.joint_vel + 0.5
    pair = Pair(reference, aligned, bodies, jnp.asarray(joint_pos), joint_vel, robot.anchor)
    errors = {name: float(x[0]) for name, x in step_errors(robot, pair).items()}

    world = np.linalg.norm(pos[0] - np.asarray(reference.bodies.pos[0]), axis=-1)
    assert errors["mpkpe"] == pytest.approx(world.mean(), rel=1e-4)
    assert errors["anchor_position_error"] == pytest.approx(world[robot.anchor], rel=1e-4)
    assert errors["root_relative_mpkpe"] == pytest.approx((13 * 0.02 + 0.10) / 14, rel=1e-3)
    assert errors["end_effector_error"] == pytest.approx((3 * 0.02 + 0.10) / 4, rel=1e-3)
    assert errors["max_key_body_position_error"] == pytest.approx(0.10, rel=1e-3)
    assert errors["anchor_orientation_error"] == pytest.approx(np.pi / 2, rel=1e-4)
    assert errors["joint_position_error"] == pytest.approx(off / np.sqrt(29), rel=1e-4)
    assert errors["joint_velocity_error"] == pytest.approx(0.5, rel=1e-4)
    assert errors["foot_contact"] == 0.5
    assert errors["joint_limit_violation"] == pytest.approx(1 / 29)
