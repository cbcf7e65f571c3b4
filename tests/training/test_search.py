"""The search for a first success, in miniature: the anchor may be 5 cm off, and a random policy sinks further."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.reference import lookup
from forgetmimic_jax.tracking.rsi import Start
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.training.search import SearchConfig, first_failure, search, straight_lines
from forgetmimic_jax.training.start import fresh_policy

ROLLOUTS, JOINTS, BODIES, SWAY, TURN = 32, 29, 14, 0, 1
CONFIG = SearchConfig(before=10, window=12, after=4, rounds=8, noisy_rounds=6, starting_std=0.5)


class Stumble:
    """An engine whose robots stand still; a foot hits the ground hard in the fourth control step, and only then."""

    def step(self, state, parameters, joint_target, wrench):
        clock = state.warmstart.at[:, 0].add(1.0)  # zeros at the start of an episode
        force = jnp.where(clock[:, :1, None] == 4.0, 1e4, 0.0) * jnp.ones((len(clock), BODIES, 3))
        return dataclasses.replace(state, warmstart=clock), dataclasses.replace(self.bodies, contact_force=force)

    def forward(self, state, parameters, mask, bodies):
        self.bodies = bodies
        return bodies


@pytest.fixture(scope="module")
def setup(robot, library, tiny_config):
    termination = dataclasses.replace(tiny_config.termination, anchor_height=0.05)
    return Setup(dataclasses.replace(tiny_config, termination=termination), robot, library, "")


@pytest.fixture(scope="module")
def env(setup):
    return tracking.make_environment(setup, ROLLOUTS)


@pytest.fixture(scope="module")
def assets(setup):
    return tracking.make_assets(setup)


@pytest.fixture(scope="module")
def policy(setup, assets):
    return fresh_policy(setup, assets)


@pytest.fixture(scope="module")
def survived(env, assets, policy):
    """survived(clip, frame, added): control steps of the first robot from exactly the reference, stepped one by one."""
    step = jax.jit(lambda state, action: tracking.step(env, assets, state, action, jax.random.PRNGKey(0)))
    observe = jax.jit(lambda state: tracking.observe(env, assets, state, None)[0])

    def count(clip: int, frame: int, added: np.ndarray) -> int:
        clips, frames = jnp.full(ROLLOUTS, clip, jnp.int32), jnp.full(ROLLOUTS, frame, jnp.int32)
        start = Start(clips, 0 * clips, frames)
        state = tracking.start_episodes(env, assets, jax.random.PRNGKey(0), start, jnp.zeros(ROLLOUTS))
        reference, root = lookup(assets.library, clips, frames), env.robot.root
        quat = np.asarray(reference.bodies.quat[:, root])
        spin = Rotation.from_quat(quat, scalar_first=True).inv().apply(np.asarray(reference.bodies.ang_vel[:, root]))
        physics = dataclasses.replace(
            state.physics,
            qpos=jnp.concatenate([reference.bodies.pos[:, root], quat, reference.joint_pos], axis=-1),
            qvel=jnp.concatenate([reference.bodies.lin_vel[:, root], jnp.float32(spin), reference.joint_vel], axis=-1),
        )
        state = dataclasses.replace(state, physics=physics)
        for number, more in enumerate(added):
            state, result = step(state, policy.mean_action(observe(state)) + more)
            if result.terminated[0]:
                return number
        return len(added)

    return count


@pytest.fixture(scope="module")
def found(env, assets, policy):
    failure = first_failure(env, assets, policy, SWAY)
    return search(env, assets, policy, SWAY, failure, CONFIG)


def test_straight_lines_between_knots():
    added = straight_lines(3, 5) @ np.array([[0.0], [4.0], [0.0]])
    np.testing.assert_allclose(added[:, 0], [0, 2, 4, 2, 0])
    np.testing.assert_allclose(straight_lines(2, 4), [[1, 0], [2 / 3, 1 / 3], [1 / 3, 2 / 3], [0, 1]])


def test_the_first_failure_is_where_a_robot_that_starts_on_the_reference_ends(env, assets, policy, survived):
    nothing = np.zeros((60, JOINTS))
    expected = [survived(clip, 0, nothing) for clip in (SWAY, TURN)]
    assert all(5 < frame < 40 for frame in expected)
    assert [first_failure(env, assets, policy, clip) for clip in (SWAY, TURN)] == expected


def test_a_clip_that_is_completed_has_no_failure(env, assets, policy):
    short = dataclasses.replace(env, config=dataclasses.replace(env.config, max_episode_steps=5))
    assert first_failure(short, assets, policy, SWAY) == -1


def test_a_robot_that_has_failed_stays_failed(env, assets, policy):
    loose = dataclasses.replace(env.config.termination, anchor_height=9.0, orientation=9.0, end_effector_height=9.0)
    config = dataclasses.replace(env.config, termination=loose)
    stumbling = dataclasses.replace(env, config=config, engine=Stumble())
    assert first_failure(stumbling, assets, policy, SWAY) == 3


def test_search_passes_the_frame_at_which_the_policy_fails(env, assets, policy, found, survived):
    """Stepped one by one, what was found survives all steps, and the policy alone does not."""
    failure = first_failure(env, assets, policy, SWAY)
    assert (found.start, found.steps) == (failure - CONFIG.before, CONFIG.window + CONFIG.after)
    assert found.added.shape == (CONFIG.window, JOINTS)
    after = np.zeros((CONFIG.after, JOINTS))
    assert survived(SWAY, found.start, np.zeros((found.steps, JOINTS))) < found.steps
    assert survived(SWAY, found.start, np.concatenate([found.added, after])) == found.steps
    # Both see the same sixteen steps; a search that ignored the reset noise would pass hardly any of these.
    assert found.passed > 0.2


def test_lessons_are_the_rollouts_that_passed(assets, policy, found):
    rollouts = round(found.passed * ROLLOUTS)
    lessons = jax.tree.map(lambda x: np.asarray(x).reshape(found.steps, rollouts, *x.shape[1:]), found.lessons)
    added = lessons.action - np.asarray(policy.mean_action(lessons.actor_observation))
    np.testing.assert_allclose(added[: CONFIG.window], np.repeat(found.added[:, None], rollouts, 1), atol=1e-4)
    np.testing.assert_allclose(added[CONFIG.window :], 0.0, atol=1e-4)
    frames = jnp.arange(found.start + 1, found.start + 1 + found.steps)
    reference = lookup(assets.library, jnp.full(found.steps, SWAY), frames)
    np.testing.assert_array_equal(
        lessons.actor_observation[:, :, 10 : 10 + JOINTS], np.repeat(reference.joint_pos[:, None], rollouts, 1)
    )
    np.testing.assert_allclose(lessons.critic_observation[:, :, :132], lessons.actor_observation, atol=1e-6)
    assert np.ptp(lessons.actor_observation[0], axis=0).max() > 0.05  # the reset noise


def test_value_targets_are_returns(env, found):
    """V_t − γ V_{t+1} is the reward of a step, at most 8 of tracking and 1 of survival, and above 0."""
    target = np.asarray(found.lessons.value_target).reshape(found.steps, -1)
    reward = (target[:-1] - env.config.ppo.discount * target[1:]) / env.control_step
    assert (reward > 0.0).all()
    assert (reward < 9.0).all()
    assert reward.mean() > 6.0


def test_nothing_to_search(env, assets, policy):
    for failure in (-1, 200):
        with pytest.raises(ValueError, match=f"failure at frame {failure}, in a clip of 80 frames"):
            search(env, assets, policy, SWAY, failure, CONFIG)
