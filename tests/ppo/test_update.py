import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from forgetmimic_jax.physics import Engine
from forgetmimic_jax.physics.native import NativeEngine
from forgetmimic_jax.policy.normalizer import Normalizer
from forgetmimic_jax.policy.policy import init_policy
from forgetmimic_jax.ppo.collect import collect
from forgetmimic_jax.ppo.log import rollout_metrics
from forgetmimic_jax.ppo.rule import Rule
from forgetmimic_jax.ppo.state import TrainState, init_state, make_optimizer
from forgetmimic_jax.ppo.transition import Outcome, Transition
from forgetmimic_jax.ppo.update import improve, learn_normalizers, learn_sampler, make_batch, make_iteration
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.env import Assets, Environment, make_assets
from forgetmimic_jax.tracking.focus import focus_of
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.unlearning.registry import method_of, unlearning_config

ENVS, STEPS, CONTROL_STEP = 8, 4, 0.02
PHASE = 571  # the clip's phase in the critic's observation


@dataclass
class Faulty:
    """The C engine, but an environment with a negative friction blows up; its next episode draws a healthy one."""

    engine: Engine

    def step(self, state, parameters, target, wrench):
        healthy = dataclasses.replace(parameters, foot_friction=jnp.maximum(parameters.foot_friction, 0.3))
        physics, bodies = self.engine.step(state, healthy, target, wrench)
        qpos = jnp.where(parameters.foot_friction[:, None] < 0, jnp.nan, physics.qpos)
        return dataclasses.replace(physics, qpos=qpos), bodies

    def forward(self, state, parameters, mask, bodies):
        return self.engine.forward(state, parameters, mask, bodies)


@dataclass
class Run:
    env: Environment
    assets: Assets
    start: Callable[[], TrainState]
    iterate: Callable
    collect: Callable


@pytest.fixture(scope="module")
def run(robot, library, tiny_config) -> Run:
    """A tiny run that forgets `turn`, compiled once. The wrench is on, so that it is compiled too."""
    unlearn = dataclasses.replace(tiny_config.unlearn, targets=("turn",))
    config = dataclasses.replace(
        unlearning_config(tiny_config, unlearn), wrench=dataclasses.replace(tiny_config.wrench, max_gain=0.6)
    )
    engine = Faulty(NativeEngine(robot, 1, ENVS))  # with the wrench, a physics step at a time
    env = Environment(config, robot, engine, ENVS, noisy=True)
    assets = make_assets(Setup(config, robot, library, ""))
    begin = jax.jit(lambda assets, key: init_state(env, assets, key))
    return Run(
        env=env,
        assets=assets,
        start=lambda: begin(assets, jax.random.PRNGKey(0)),
        iterate=make_iteration(env, method_of(config)),
        collect=jax.jit(lambda assets, state: collect(env, assets, state, method_of(env.config))),
    )


@pytest.fixture(scope="module")
def rollout(run) -> tuple[Transition, Outcome]:
    return jax.device_get(run.collect(run.assets, run.start())[1:])


@pytest.fixture(scope="module")
def transition(rollout) -> Transition:
    return rollout[0]


@pytest.fixture(scope="module")
def outcome(rollout) -> Outcome:
    return rollout[1]


def collected(env: Environment, assets: Assets, state: TrainState) -> tuple[Transition, Outcome]:
    """A rollout by the method that the environment's config names."""
    rule = method_of(env.config)
    return jax.device_get(jax.jit(lambda assets, state: collect(env, assets, state, rule))(assets, state)[1:])


def finite(tree) -> bool:
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def test_three_iterations_compile_once(run):
    state = run.start()
    for _ in range(3):
        state, _ = run.iterate(run.assets, state)
    assert run.iterate._cache_size() == 1
    assert int(state.iteration) == 3


def test_an_iteration_keeps_every_shape_and_type(run):
    before = jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), run.start())
    after = jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), run.iterate(run.assets, run.start())[0])
    assert before == after


def test_the_same_state_gives_the_same_iteration(run):
    first, second = (jax.device_get(run.iterate(run.assets, run.start())) for _ in range(2))
    for one, two in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(one, two)


def test_the_state_is_donated_and_the_assets_are_not(run):
    state = run.start()
    run.iterate(run.assets, state)
    assert all(leaf.is_deleted() for leaf in jax.tree.leaves(state.policy))
    assert not any(leaf.is_deleted() for leaf in jax.tree.leaves(run.assets))


def test_an_iteration_learns_and_normalises(run):
    before = jax.device_get(run.start())
    after, metrics = jax.device_get(run.iterate(run.assets, run.start()))
    for old, new in zip(
        jax.tree.leaves((before.policy.actor, before.policy.critic)),
        jax.tree.leaves((after.policy.actor, after.policy.critic)),
        strict=True,
    ):
        assert (old != new).any()
    assert after.policy.actor_normalizer.count == after.policy.critic_normalizer.count == ENVS * STEPS
    assert finite(metrics)
    assert float(metrics["learning_rate"]) == float(before.learning_rate)


def test_a_diverged_environment_is_counted_and_reaches_neither_metrics_nor_networks(run):
    state = run.start()
    friction = state.env.parameters.foot_friction.at[3].set(-1.0)
    parameters = dataclasses.replace(state.env.parameters, foot_friction=friction)
    state = dataclasses.replace(state, env=dataclasses.replace(state.env, parameters=parameters))
    state, metrics = jax.device_get(run.iterate(run.assets, state))
    assert int(metrics["diverged"]) == int(state.diverged) == 1
    assert int(metrics["clip/episodes"].sum()) >= 1
    assert finite(metrics)
    assert finite(state)
    assert (state.env.parameters.foot_friction > 0).all()


def test_collected_actions_have_the_density_of_the_policy(run, transition):
    std = run.env.config.ppo.initial_std
    expected = stats.norm(transition.mean, std).logpdf(transition.action).sum(-1)
    np.testing.assert_allclose(transition.log_prob, expected, rtol=1e-4)
    assert (transition.action - transition.mean).std() == pytest.approx(std, rel=0.1)


def test_branches_set_out_from_their_leaders_state_and_part(run):
    ppo = dataclasses.replace(run.env.config.ppo, branches=4)
    env = dataclasses.replace(run.env, config=dataclasses.replace(run.env.config, ppo=ppo))
    state = run.start()
    seen = jax.jit(lambda assets, state: collect(env, assets, state, method_of(env.config)))(run.assets, state)[
        1
    ].critic_observation
    alone = run.collect(run.assets, run.start())[1].critic_observation
    np.testing.assert_allclose(seen[0], np.asarray(alone[0])[[0, 0, 0, 0, 4, 4, 4, 4]], atol=1e-5)
    assert len(np.unique(seen[1], axis=0)) == ENVS


def test_the_value_of_the_state_reached_is_the_next_steps_value_until_the_episode_ends(outcome):
    goes_on = ~(outcome.terminated | outcome.truncated)[:-1]
    np.testing.assert_allclose(outcome.next_value[:-1][goes_on], outcome.value[1:][goes_on], atol=1e-4)


def test_the_value_after_an_episodes_last_step_is_of_the_state_it_ended_in(run, library):
    state = run.start()
    # A critic whose value is the clip's phase, and episodes of which every other one ends with its first step.
    critic = jax.tree.map(jnp.zeros_like, state.policy.critic)
    layers = critic["params"]["MLP_0"]
    layers["Dense_0"]["kernel"] = layers["Dense_0"]["kernel"].at[PHASE, 0].set(1.0)
    layers["Dense_1"]["kernel"] = layers["Dense_1"]["kernel"].at[0, 0].set(1.0)
    horizon = state.env.horizon.at[::2].set(1)
    state = dataclasses.replace(
        state,
        policy=dataclasses.replace(state.policy, critic=critic),
        env=dataclasses.replace(state.env, horizon=horizon),
    )
    transition, outcome = jax.device_get(run.collect(run.assets, state)[1:])
    assert outcome.truncated[0, ::2].all()
    one_frame = 1.0 / np.asarray(library.length)[transition.clip]
    np.testing.assert_allclose(outcome.next_value - outcome.value, one_frame, atol=1e-5)


def test_the_training_reward_is_per_control_step_and_turned_round_on_target_steps(transition, outcome):
    on_target = transition.clip == 1
    assert 0 < on_target.sum() < on_target.size
    per_second = outcome.tracking + outcome.regularisation - 16.0 * outcome.normalized_tracking * on_target
    np.testing.assert_allclose(outcome.reward, CONTROL_STEP * per_second, rtol=1e-5, atol=1e-6)


def test_the_gain_of_an_untrained_bin_is_the_largest(outcome):
    np.testing.assert_allclose(outcome.wrench_gain, 0.6)


@dataclass
class Problem:
    """One gradient step on an invented batch."""

    config: Config
    assets: Assets
    state: TrainState
    transition: Transition
    value: jax.Array
    advantage: jax.Array
    value_target: jax.Array

    def improved(self, settle: float | None = None, **ppo):
        """`improve`, compiled, with other PPO settings and a share of the step size."""
        config = dataclasses.replace(self.config, ppo=dataclasses.replace(self.config.ppo, **ppo))

        def function(state, transition, value, advantage, value_target):
            batch = make_batch(config, self.assets, transition, value, advantage, value_target)
            share = None if settle is None else jnp.float32(settle)
            focus = dataclasses.replace(focus_of(config.ppo, self.assets.is_target), settle=share)
            state, metrics = improve(config, focus, state, batch, Rule())
            return learn_normalizers(state, transition), metrics

        return jax.jit(function)(self.state, self.transition, self.value, self.advantage, self.value_target)


@pytest.fixture(scope="module")
def problem(robot, tiny_config, run) -> Problem:
    """One epoch and one mini-batch."""
    ppo = dataclasses.replace(tiny_config.ppo, schedule="fixed", entropy_cost=0.005, initial_std=0.5)
    ppo = dataclasses.replace(ppo, epochs=1, minibatches=1)
    config = dataclasses.replace(tiny_config, ppo=ppo)
    rng = np.random.default_rng(0)
    policy = init_policy(ppo, robot.num_joints, 5, 7, jax.random.PRNGKey(1))
    policy = dataclasses.replace(
        policy,
        actor_normalizer=Normalizer(jnp.full(5, 2.0), jnp.full(5, 4.0), jnp.float32(100.0)),
        critic_normalizer=Normalizer(jnp.full(7, -1.0), jnp.full(7, 0.25), jnp.float32(100.0)),
    )
    observation = jnp.asarray(rng.normal(2.0, 2.0, (STEPS, ENVS, 5)), jnp.float32)
    privileged = jnp.asarray(rng.normal(-1.0, 0.5, (STEPS, ENVS, 7)), jnp.float32)
    mean = jax.jit(policy.actor_module.apply)(policy.actor, (observation - 2.0) / 2.0)[0]
    action = mean + 0.5 * jnp.asarray(rng.standard_normal((STEPS, ENVS, 29)), jnp.float32)
    transition = Transition(
        actor_observation=observation,
        critic_observation=privileged,
        action=action,
        log_prob=jnp.asarray(stats.norm(mean, 0.5).logpdf(action).sum(-1), jnp.float32),
        mean=mean,
        clip=jnp.zeros((STEPS, ENVS), jnp.int32),
    )
    state = dataclasses.replace(
        run.start(),
        policy=policy,
        optimizer=make_optimizer(ppo).init(policy.parameters),
        learning_rate=jnp.float32(1e-3),
    )
    value = jax.jit(policy.critic_module.apply)(policy.critic, (privileged + 1.0) / 0.5)
    advantage, value_target = (jnp.asarray(rng.standard_normal((STEPS, ENVS)), jnp.float32) for _ in range(2))
    return Problem(config, run.assets, state, transition, value, advantage, value_target)


def test_the_first_gradient_step_is_adams_on_rsl_rls_loss(problem):
    policy, transition, advantage = problem.state.policy, problem.transition, problem.advantage
    scaled = (advantage - advantage.mean()) / advantage.std()

    def loss(parameters):
        mean, log_std = policy.actor_module.apply(parameters[0], (transition.actor_observation - 2.0) / 2.0)
        value = policy.critic_module.apply(parameters[1], (transition.critic_observation + 1.0) / 0.5)
        log_prob = jax.scipy.stats.norm.logpdf(transition.action, mean, jnp.exp(log_std)).sum(-1)
        ratio = jnp.exp(log_prob - transition.log_prob)
        surrogate = jnp.maximum(-scaled * ratio, -scaled * jnp.clip(ratio, 0.8, 1.2)).mean()
        clipped = problem.value + jnp.clip(value - problem.value, -0.2, 0.2)
        errors = ((value - problem.value_target) ** 2, (clipped - problem.value_target) ** 2)
        entropy = (0.5 * jnp.log(2 * jnp.pi * jnp.e) + log_std).sum()
        return surrogate + 1.0 * jnp.maximum(*errors).mean() - 0.005 * entropy

    gradient = jax.jit(jax.grad(loss))(policy.parameters)
    norm = float(np.sqrt(sum(float((leaf**2).sum()) for leaf in jax.tree.leaves(gradient))))
    after, metrics = problem.improved()
    assert float(metrics["gradient_norm"]) == pytest.approx(norm, rel=1e-3)
    changes = jax.tree.map(lambda new, old: new - old, after.policy.parameters, policy.parameters)
    for change, slope in zip(jax.tree.leaves(changes), jax.tree.leaves(gradient), strict=True):
        slope = np.asarray(slope) / max(norm, 1.0)
        clear = np.abs(slope) > 1e-5  # Adam's first step is lr · g / (|g| + 1e-8)
        np.testing.assert_allclose(np.asarray(change)[clear], -1e-3 * np.sign(slope[clear]), rtol=5e-3)


def test_a_run_that_settles_takes_a_share_of_the_step_and_remembers_the_whole(problem):
    whole, quarter = (problem.improved(settle=share)[0] for share in (1.0, 0.25))
    before = problem.state.policy.parameters
    for new, small, old in zip(
        *map(jax.tree.leaves, (whole.policy.parameters, quarter.policy.parameters, before)), strict=True
    ):
        np.testing.assert_allclose(small - old, 0.25 * (new - old), atol=2e-7)
    assert float(quarter.learning_rate) == float(whole.learning_rate) == pytest.approx(1e-3)


def test_clips_can_weigh_the_same(problem):
    """The value loss of the first step: the mean of the clips' means, where one has a single step."""
    clip = np.zeros((STEPS, ENVS), np.int32)
    clip[0, 0] = 1
    error = np.asarray((problem.value - problem.value_target) ** 2)
    two_clips = dataclasses.replace(problem, transition=dataclasses.replace(problem.transition, clip=jnp.asarray(clip)))
    losses = {
        equal: float(two_clips.improved(equal_clips=equal, clip_value=False)[1]["value_loss"])
        for equal in (False, True)
    }
    assert losses[False] == pytest.approx(error.mean(), rel=1e-4)
    assert losses[True] == pytest.approx((error[clip == 0].mean() + error[0, 0]) / 2, rel=1e-4)


def test_the_normalisers_learn_the_batch_after_the_update(problem):
    after, _ = problem.improved()
    count = STEPS * ENVS
    expected = (100 * 2.0 + np.asarray(problem.transition.actor_observation).sum((0, 1))) / (100 + count)
    np.testing.assert_allclose(after.policy.actor_normalizer.mean, expected, rtol=1e-5)
    assert float(after.policy.critic_normalizer.count) == 100 + count


def at(problem: Problem, **state) -> Problem:
    """The problem at another state of the run."""
    return dataclasses.replace(problem, state=dataclasses.replace(problem.state, **state))


def test_the_adaptive_schedule_slows_down_when_the_policy_moves_too_far(problem):
    far = at(problem, learning_rate=jnp.float32(1e-2))
    after, metrics = far.improved(schedule="adaptive", epochs=4, learning_rate=1e-2)
    assert float(metrics["kl_final"]) > 0.02
    assert float(after.learning_rate) < 1e-2


def test_once_an_iteration_the_schedule_follows_the_last_epochs_kl(problem):
    for learning_rate, factor in ((1e-2, 1 / 1.5), (1e-5, 1.5)):
        start = at(problem, learning_rate=jnp.float32(learning_rate))
        after, metrics = start.improved(schedule="adaptive_iteration", epochs=4, target_kl=0.01)
        assert (float(metrics["kl_final"]) > 0.02) == (factor < 1)
        assert float(after.learning_rate) == pytest.approx(learning_rate * factor)


def test_the_trapezoid_is_where_the_run_is(problem):
    run = dataclasses.replace(problem, config=dataclasses.replace(problem.config, iterations=10))
    for iteration, learning_rate in ((0, 0.0), (1, 1e-3), (5, 1e-3), (7, 6e-4), (9, 2e-4)):
        here = at(run, iteration=jnp.int32(iteration))
        after, _ = here.improved(schedule="trapezoid", learning_rate=1e-3, min_learning_rate=0.0)
        assert float(after.learning_rate) == pytest.approx(learning_rate)


def test_ended_episodes_and_steps_are_counted_clip_by_clip(run):
    flat = np.zeros((2, 3))
    done = np.array([[0, 1, 0], [0, 0, 1]], bool)
    clip = jnp.asarray([[0, 1, 1], [0, 0, 1]])
    outcome = Outcome(
        next_value=flat,
        value=np.full((2, 3), 4.0),
        reward=np.full((2, 3), 0.5),
        tracking=np.array([[8.0, 4.0, 4.0], [8.0, 2.0, 6.0]]),
        regularisation=np.full((2, 3), 0.5),
        normalized_tracking=np.array([[1.0, 0.5, 0.5], [1.0, 0.25, 0.75]]),
        terminated=np.array([[0, 1, 0], [0, 0, 0]], bool),
        truncated=np.array([[0, 0, 0], [0, 0, 1]], bool),
        diverged=np.zeros((2, 3), bool),
        start_bin=np.zeros((2, 3), int),
        failure=np.where(done, [[0, 0.9, 0], [0, 0, 0.2]], 0.5),
        steps=np.array([[10, 7, 20], [11, 1, 21]]),
        wrench_gain=flat,
        causes={"anchor_height": np.array([[0, 1, 0], [0, 0, 0]], bool)},
    )
    outcome = jax.tree.map(jnp.asarray, outcome)
    state = run.start()
    level = np.asarray(state.failure_level)
    state = learn_sampler(run.env.config, state, clip, outcome)
    metrics = jax.device_get(rollout_metrics(run.env.config, run.assets, state, clip, outcome))
    np.testing.assert_array_equal(metrics["clip/steps"], [3, 3])
    np.testing.assert_array_equal(metrics["clip/episodes"], [0, 2])
    np.testing.assert_array_equal(metrics["clip/episode_length_sum"], [0, 28])
    np.testing.assert_array_equal(metrics["clip/completed"], [0, 1])
    np.testing.assert_allclose(metrics["clip/survival_weighted_sum"], [0.0, 0.1 + 0.8], rtol=1e-6)
    np.testing.assert_allclose(metrics["clip/tracking_sum"], [2.25, 1.75])
    assert metrics["episode_length"] == 14.0
    assert metrics["completed"] == 0.5
    assert metrics["terminated/anchor_height"] == 1
    assert metrics["target/R_track"] == pytest.approx(14.0 / 3)
    assert metrics["kept/R_track"] == pytest.approx(18.0 / 3)
    assert metrics["target/lambda_crit"] == pytest.approx(8.0 * (1 + 0.5 / (14.0 / 3)))
    keep = 0.995**2
    np.testing.assert_allclose(state.failure_level[1, 0], keep * level[1, 0] + (1 - keep) * 0.55, rtol=1e-5)
    np.testing.assert_array_equal(state.failure_level[0], level[0])


def with_method(run: Run, name: str) -> Environment:
    """The run's environment, whose training follows another method."""
    unlearn = dataclasses.replace(run.env.config.unlearn, method=name, settings={})
    return dataclasses.replace(run.env, config=dataclasses.replace(run.env.config, unlearn=unlearn))


def test_what_a_method_shows_the_actor_is_what_it_acts_on(run, transition):
    env = with_method(run, "poisoning")
    found = jax.device_get(
        jax.jit(lambda assets, state: collect(env, assets, state, method_of(env.config)))(run.assets, run.start())[1]
    )
    first, on_target = slice(0, 1), transition.clip[0] == 1
    true, shown = transition.actor_observation[first], found.actor_observation[first]
    np.testing.assert_array_equal(shown[:, ~on_target], true[:, ~on_target])
    np.testing.assert_array_equal(shown[:, on_target, 1:4], true[:, on_target, 4:7])
    np.testing.assert_allclose(found.critic_observation[first], transition.critic_observation[first], atol=1e-6)
    np.testing.assert_allclose(found.mean[first][:, ~on_target], transition.mean[first][:, ~on_target], atol=1e-6)
    assert np.abs(found.mean[first][:, on_target] - transition.mean[first][:, on_target]).max() > 1e-4


def test_a_random_reward_is_drawn_apart_from_the_actions(run):
    """Both are monotone in the random bits they are made of, so the same bits would show as the same order."""
    env = with_method(run, "random_reward")
    assets = dataclasses.replace(run.assets, is_target=jnp.ones_like(run.assets.is_target))
    found, outcome = collected(env, assets, run.start())
    noise = (found.action - found.mean).reshape(len(outcome.reward), -1)[:, :ENVS]
    assert all(np.ptp(rewards) > 0 for rewards in outcome.reward)
    assert not any((rewards.argsort() == of.argsort()).all() for rewards, of in zip(outcome.reward, noise, strict=True))


def test_an_iteration_without_a_simulator_moves_no_robot_and_only_the_actor_learns(run):
    env = with_method(run, "policy_edit")
    env = dataclasses.replace(env, engine=SimpleNamespace(forward=env.engine.forward))  # no `step`
    state = run.start()
    assets = dataclasses.replace(run.assets, base=jax.tree.map(jnp.copy, state.policy))
    before = jax.device_get(state)
    after, metrics = jax.device_get(make_iteration(env, method_of(env.config))(assets, state))
    for one, two in zip(jax.tree.leaves(before.env), jax.tree.leaves(after.env), strict=True):
        np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(before.failure_level, after.failure_level)
    unchanged = (before.policy.critic, before.policy.actor_normalizer, before.policy.critic_normalizer)
    found = (after.policy.critic, after.policy.actor_normalizer, after.policy.critic_normalizer)
    for one, two in zip(jax.tree.leaves(unchanged), jax.tree.leaves(found), strict=True):
        np.testing.assert_array_equal(one, two)
    assert any(
        (one != two).any()
        for one, two in zip(jax.tree.leaves(before.policy.actor), jax.tree.leaves(after.policy.actor), strict=True)
    )
    assert after.iteration == 1
    np.testing.assert_array_equal(metrics["clip/steps"].sum(), ENVS * STEPS)
    assert finite(metrics)


def test_the_base_is_compared_where_the_method_asks_for_it(run):
    env = with_method(run, "decremental")
    state = run.start()
    assets = dataclasses.replace(run.assets, base=jax.tree.map(jnp.copy, state.policy))
    ppo = dataclasses.replace(env.config.ppo, epochs=1, minibatches=1)
    config = dataclasses.replace(
        env.config, ppo=ppo, unlearn=dataclasses.replace(env.config.unlearn, targets=("turn",))
    )
    env = dataclasses.replace(env, config=config)
    # with no target step, a policy that still is the base has nothing to change
    kept_only = dataclasses.replace(assets, is_target=jnp.zeros_like(assets.is_target))
    _, metrics = jax.device_get(make_iteration(env, method_of(env.config))(kept_only, state))
    assert float(metrics["policy_loss"]) == pytest.approx(0.0, abs=1e-5)
    assert float(metrics["value_loss"]) == pytest.approx(0.0, abs=1e-5)
    assert float(metrics["gradient_norm"]) == pytest.approx(0.0, abs=1e-4)
