"""Regression of teachers into a student, on tiny networks."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import serialization, struct
from trees import assert_same

from forgetmimic_jax.policy.policy import init_policy
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.reference import lookup
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.training import distil as module
from forgetmimic_jax.training.distil import DistilConfig, Score, begin, distil, is_enough, make_round, roll, score_of
from forgetmimic_jax.training.teaching import Lesson, PolicyTeacher, fresh_episodes, make_teaching

ENVS, STEPS, HORIZON, JOINTS = 8, 4, 20, 29
SWAY, TURN = 0, 1  # the clips of the library: 79 and 40 frames that an episode may start at
LAST_ACTION = slice(-JOINTS, None)  # in the actor's observation
# Rounds 0 to 3: the teachers with noise on half of the robots, the teachers, half of the robots each, the student.
CONFIG = DistilConfig(
    rounds=4,
    steps=STEPS,
    expert_share=(1.0, 1.0, 0.5, 0.0),
    noise_rounds=1,
    normalizer_rounds=2,
    epochs=1,
    minibatches=2,
)


@struct.dataclass
class Witness:
    """A teacher whose action is a part of what it sees, and whether it got a key for noise."""

    def action(self, assets, episodes, observation, noise_key):
        return observation[:, :JOINTS] + (0.0 if noise_key is None else 100.0)


@pytest.fixture(scope="module")
def env(robot, library, tiny_config):
    config = dataclasses.replace(tiny_config, max_episode_steps=HORIZON)
    return tracking.make_environment(Setup(config, robot, library, ""), ENVS)


@pytest.fixture(scope="module")
def assets(env, robot, library):
    return tracking.make_assets(Setup(env.config, robot, library, ""))


@pytest.fixture(scope="module")
def policy(env, assets):
    """policy(seed, bias, scale): random networks with actions around a bias, and wild ones with a large scale."""

    def of(seed: int, bias: float = 0.0, scale: float = 20.0):
        teaching = make_teaching(assets, [(Witness(), (SWAY, TURN))])
        episodes = fresh_episodes(env, assets, teaching, jax.random.PRNGKey(0))
        actor_obs, critic_obs = tracking.observe(env, assets, episodes, None)
        fresh = init_policy(
            env.config.ppo, JOINTS, actor_obs.shape[1], critic_obs.shape[1], jax.random.PRNGKey(100 + seed)
        )
        perceptron = fresh.actor["params"]["MLP_0"]
        last = {"kernel": scale * perceptron["Dense_2"]["kernel"], "bias": perceptron["Dense_2"]["bias"] + bias}
        actor = {"params": {**fresh.actor["params"], "MLP_0": {**perceptron, "Dense_2": last}}}
        return dataclasses.replace(fresh, actor=actor)

    return of


@pytest.fixture(scope="module")
def two(assets, policy):
    """Two policies, a clip each."""
    return make_teaching(assets, [(PolicyTeacher(policy(1, 0.3)), (SWAY,)), (PolicyTeacher(policy(2, -0.3)), (TURN,))])


@pytest.fixture(scope="module")
def rolled(env, assets, two, policy):
    """rolled(round): the state before it, and after it with the lessons and metrics."""
    run = jax.jit(lambda assets, teaching, state: roll(env, assets, teaching, state, CONFIG))
    start = begin(env, assets, two, policy(3), jax.random.PRNGKey(0))

    def of(number: int):
        before = dataclasses.replace(start, round=jnp.asarray(number, jnp.int32))
        return before, *run(assets, two, before)

    return of


@pytest.fixture(scope="module")
def step(env, assets):
    """step(state, action): a control step; without noise its key is not used."""
    return jax.jit(lambda state, action: tracking.step(env, assets, state, action, jax.random.PRNGKey(0)))


@pytest.fixture(scope="module")
def one_round(env):
    return make_round(env, CONFIG)


def test_share_of_the_experts_is_spread_over_the_rounds():
    config = DistilConfig(rounds=14, expert_share=(1.0, 0.5, 0.0))
    assert [float(config.share(done)) for done in range(14)] == 5 * [1.0] + 5 * [0.5] + 4 * [0.0]


def test_step_size_falls_to_zero_at_the_end():
    config = DistilConfig(rounds=10, learning_rate=0.1, anneal=0.4)
    expected = [0.1] * 7 + [0.075, 0.05, 0.025]
    np.testing.assert_allclose([config.step_size(done) for done in range(10)], expected, rtol=1e-6)
    unchanged = dataclasses.replace(config, anneal=0.0)
    np.testing.assert_allclose([unchanged.step_size(done) for done in range(10)], 0.1, rtol=1e-6)


def test_is_enough_looks_at_the_worst_clip():
    config = DistilConfig(success_tolerance=0.02, reward_tolerance=0.05)
    teachers = Score(jnp.array([1.0, 0.5]), jnp.array([0.9, 0.8]))
    assert is_enough(config, Score(jnp.array([0.99, 0.5]), jnp.array([0.86, 0.9])), teachers)
    assert not is_enough(config, Score(jnp.array([1.0, 0.47]), jnp.array([0.9, 0.8])), teachers)
    assert not is_enough(config, Score(jnp.array([1.0, 0.5]), jnp.array([1.0, 0.7])), teachers)


def test_teaching_starts_every_taught_clip_alike(assets):
    teaching = make_teaching(assets, [(Witness(), (SWAY, TURN))])
    np.testing.assert_allclose(teaching.probabilities.sum(-1), [0.5, 0.5], rtol=1e-6)
    # Bins of 20 frames; the last takes what is left of the 79 and 40 starts.
    np.testing.assert_allclose(teaching.probabilities[SWAY] * 2 * 79, [20, 20, 20, 19], rtol=1e-6)
    np.testing.assert_allclose(teaching.probabilities[TURN] * 2 * 40, [20, 20, 0, 0], rtol=1e-6)
    alone = make_teaching(assets, [(Witness(), (TURN,))])
    np.testing.assert_allclose(alone.probabilities.sum(-1), [0.0, 1.0], rtol=1e-6)


@pytest.mark.parametrize("noisy", [False, True])
def test_noise_follows_the_environment(env, assets, policy, noisy):
    """Without noise both see the clean observation, to the last digit; with noise both see the same noisy one."""
    env = dataclasses.replace(env, noisy=noisy)
    teaching = make_teaching(assets, [(Witness(), (SWAY, TURN))])
    state = begin(env, assets, teaching, policy(3), jax.random.PRNGKey(0))
    config = dataclasses.replace(CONFIG, steps=1)
    _, lesson, _ = jax.jit(lambda *given: roll(env, *given, config))(assets, teaching, state)
    seen, label = np.asarray(lesson.actor_observation[0]), np.asarray(lesson.action[0])
    clean = np.asarray(tracking.observe(env, assets, state.env, None)[0])
    if noisy:
        joint_vel = slice(16 + 2 * JOINTS, 16 + 3 * JOINTS)  # noise of up to 1.5 rad/s
        assert np.abs(seen - clean)[:, joint_vel].mean() > 0.5
        np.testing.assert_array_equal(label, seen[:, :JOINTS] + np.float32(100.0))
    else:
        np.testing.assert_allclose(seen, clean, atol=1e-6)
        reference = lookup(assets.library, state.env.clip, state.env.frame + 1)
        np.testing.assert_array_equal(seen[:, 10 : 10 + JOINTS], reference.joint_pos)
        np.testing.assert_array_equal(label, seen[:, :JOINTS])


def acted(after, lesson):
    """What the robots did in the first STEPS - 1 steps, [time, env, joint], as the next observation says it."""
    return np.asarray(lesson.actor_observation[1:, :, LAST_ACTION])


def running(lesson):
    """bool[time, env] where the next observation is of the same episode: a fresh one has no last action."""
    return np.any(np.asarray(lesson.actor_observation[1:, :, LAST_ACTION]) != 0.0, axis=-1)


def test_robots_act_by_their_teacher_by_the_student_or_half_of_them_each(rolled, policy):
    for number, expected in ((1, 1.0), (2, 0.5), (3, 0.0)):
        before, after, lesson, metrics = rolled(number)
        did, same = acted(after, lesson), running(lesson)
        assert same.mean() > 0.5
        student = np.asarray(before.student.mean_action(lesson.actor_observation[:-1]))
        by_teacher = np.abs(did - np.asarray(lesson.action[:-1])).max(-1) < 1e-4
        by_student = np.abs(did - student).max(-1) < 1e-4
        assert (by_teacher ^ by_student)[same].all()
        # One mover a robot, for the whole round.
        share = [by_teacher[same[:, robot], robot].mean() for robot in range(ENVS) if same[:, robot].any()]
        assert set(share) <= {0.0, 1.0}
        if expected == 0.5:
            assert 0.0 < np.mean(share) < 1.0
        else:
            assert np.mean(share) == metrics["teacher_share"] == expected


def test_a_lesson_is_the_action_of_the_clips_teacher(rolled, policy):
    before, _, lesson, _ = rolled(1)
    clip = np.asarray(before.env.clip)
    assert set(clip) == {SWAY, TURN}
    for index, seed, bias in ((SWAY, 1, 0.3), (TURN, 2, -0.3)):
        mine = clip == index
        expected = policy(seed, bias).mean_action(lesson.actor_observation[0, mine])
        np.testing.assert_allclose(lesson.action[0, mine], expected, atol=1e-5)


def test_first_round_has_noise_on_half_of_the_robots(rolled):
    _, after, lesson, _ = rolled(0)
    same = running(lesson)
    noise = np.abs(acted(after, lesson) - np.asarray(lesson.action[:-1])).mean(-1)
    np.testing.assert_allclose(noise[:, ENVS // 2 :][same[:, ENVS // 2 :]], 0.0, atol=1e-5)
    # The mean size of a Gaussian of 0.1 is 0.08; the mean over 29 joints stays near.
    assert (np.abs(noise[:, : ENVS // 2][same[:, : ENVS // 2]] - 0.08) < 0.04).all()


def test_statistics_are_learned_and_then_frozen(rolled, one_round, assets, two):
    before, _, lesson, _ = rolled(0)
    after, _ = one_round(assets, two, before)
    seen = np.asarray(lesson.actor_observation, np.float64).reshape(ENVS * STEPS, -1)
    learned = after.student.actor_normalizer
    np.testing.assert_allclose(learned.mean, seen.mean(0), atol=1e-4)
    assert seen.var(0).min() < 5e-5  # the reference's height hardly varies
    np.testing.assert_allclose(learned.variance, np.maximum(seen.var(0), 1e-4), rtol=1e-3, atol=1e-5)
    assert float(learned.variance.min()) >= np.float32(1e-4)
    privileged = np.asarray(lesson.critic_observation, np.float64).reshape(ENVS * STEPS, -1)
    np.testing.assert_allclose(after.student.critic_normalizer.mean, privileged.mean(0), atol=1e-3)
    late = dataclasses.replace(after, round=jnp.asarray(CONFIG.normalizer_rounds, jnp.int32))
    frozen, _ = one_round(assets, two, late)
    for name in ("actor_normalizer", "critic_normalizer"):
        assert_same(getattr(frozen.student, name), getattr(late.student, name))
    moved = jax.tree.map(lambda a, b: bool((a != b).any()), frozen.student.actor, late.student.actor)
    assert moved["params"]["MLP_0"]["Dense_2"]["kernel"]


def test_value_target_is_the_discounted_return(env, assets, rolled, step):
    """Replayed with the teachers' actions: V(s) + Σ (γ λ)^k δ_k over the steps that follow."""
    before, _, lesson, _ = rolled(1)
    state, student, ppo = before.env, before.student, env.config.ppo
    alive, delta = np.ones(ENVS, bool), []
    for time in range(STEPS):
        value = student.value(tracking.observe(env, assets, state, None)[1])
        state, result = step(state, lesson.action[time])
        following = student.value(tracking.observe(env, assets, state, None)[1])
        alive &= ~np.asarray(result.terminated | result.truncated)
        reward = 0.02 * (result.reward.tracking + result.reward.regularisation)
        delta.append(np.asarray(reward + ppo.discount * following - value))
    assert alive.any()
    weight = (ppo.discount * ppo.gae_lambda) ** np.arange(STEPS)
    expected = np.asarray(student.value(lesson.critic_observation[0])) + weight @ np.array(delta)
    np.testing.assert_allclose(lesson.value_target[0][alive], expected[alive], atol=2e-3)


def test_score_is_the_share_completed_and_the_mean_reward_while_alive(env, assets, two, policy, step):
    """A robot that fails after the end of its clip has completed it."""
    wild = policy(3, scale=200.0)
    found = jax.jit(lambda assets, student: score_of(env, assets, two, student))(assets, wild)
    episodes = fresh_episodes(env, assets, two, jax.random.split(jax.random.PRNGKey(module.SCORE_SEED), 3)[0])
    rewards, ended, late = [[] for _ in range(ENVS)], np.zeros(ENVS, bool), np.zeros(ENVS, bool)
    horizon, clip = np.asarray(episodes.horizon), np.asarray(episodes.clip)
    for time in range(HORIZON):
        action = wild.mean_action(tracking.observe(env, assets, episodes, None)[0])
        episodes, result = step(episodes, action)
        ended |= np.asarray(result.terminated) & (time < horizon)
        late |= np.asarray(result.terminated) & (time >= horizon) & ~ended
        for robot in np.flatnonzero(~ended & (time < horizon)):
            rewards[robot].append(float(result.reward.normalized_tracking[robot]))
    assert ended.any()
    assert late.any()
    mean = np.array([np.mean(of) if of else 0.0 for of in rewards])
    for index in (SWAY, TURN):
        np.testing.assert_allclose(found.success[index], (~ended)[clip == index].mean(), atol=1e-6)
        np.testing.assert_allclose(found.reward[index], mean[clip == index].mean(), atol=1e-4)


def test_student_becomes_as_good_as_two_teachers_and_stops(env, assets, two, policy):
    """A wild student ends early, then acts on each clip as that clip's teacher and stops before its last round."""
    config = DistilConfig(
        rounds=200,
        steps=8,
        expert_share=(1.0, 0.5, 0.0, 0.0, 0.0),
        noise_rounds=20,
        normalizer_rounds=40,
        minibatches=2,
        learning_rate=1e-2,
        check_every=10,
        success_tolerance=0.13,
    )
    start = begin(env, assets, two, policy(3, scale=1000.0), jax.random.PRNGKey(0))
    end = distil(env, assets, two, start, config)
    teachers = score_of(env, assets, two, None)
    assert is_enough(config, score_of(env, assets, two, end.student), teachers)
    assert not is_enough(config, score_of(env, assets, two, start.student), teachers)
    assert 80 < int(end.round) < 200  # not before it acts alone
    episodes = fresh_episodes(env, assets, two, jax.random.PRNGKey(9))
    observation, clip = tracking.observe(env, assets, episodes, None)[0], np.asarray(episodes.clip)
    now = np.asarray(end.student.mean_action(observation))
    actions = {of: np.asarray(two.teachers[of].policy.mean_action(observation)) for of in (SWAY, TURN)}
    for mine, other in ((SWAY, TURN), (TURN, SWAY)):
        near, far = (np.abs(now - actions[of])[clip == mine].mean() for of in (mine, other))
        assert near < 0.3 * far


def test_interrupted_and_restored_it_ends_with_the_same_bits(env, assets, two, policy, one_round):
    state = begin(env, assets, two, policy(3), jax.random.PRNGKey(0))
    template = state
    for _ in range(2):
        state, _ = one_round(assets, two, state)
    saved = serialization.to_bytes(state)
    for _ in range(2):
        state, _ = one_round(assets, two, state)
    restored = serialization.from_bytes(template, saved)
    assert int(restored.round) == 2
    for _ in range(2):
        restored, _ = one_round(assets, two, restored)
    assert_same(restored, state)


def test_lessons_that_are_shown_are_learned(env, assets, policy):
    """A clip without a teacher is learned from what is shown of it alone."""
    teacher = policy(1)
    start = begin(
        env, assets, make_teaching(assets, [(PolicyTeacher(teacher), (TURN,))]), policy(3), jax.random.PRNGKey(0)
    )
    seen = 0.5 * jax.random.normal(jax.random.PRNGKey(1), (64, start.student.actor_normalizer.mean.size))
    privileged = jnp.zeros((64, start.student.critic_normalizer.mean.size))
    shown = Lesson(seen, privileged, jnp.full((64, JOINTS), 2.0), jnp.full(64, 3.0))
    teaching = make_teaching(assets, [(PolicyTeacher(teacher), (TURN,))], shown)
    config = dataclasses.replace(CONFIG, rounds=40, normalizer_rounds=0, learning_rate=1e-2, minibatches=4)
    run, state = make_round(env, config), start
    for _ in range(40):
        state, _ = run(assets, teaching, state)
    assert np.abs(np.asarray(start.student.mean_action(seen)) - 2.0).mean() > 1.0
    assert np.abs(np.asarray(state.student.mean_action(seen)) - 2.0).mean() < 0.4
    np.testing.assert_allclose(state.student.value(privileged), 3.0, atol=0.5)
