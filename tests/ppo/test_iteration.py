"""One iteration seen from outside: the episode a step is credited to, the starts, the branches and the base."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from forgetmimic_jax.physics import BodyState
from forgetmimic_jax.policy.normalizer import Normalizer
from forgetmimic_jax.policy.policy import Policy, init_policy
from forgetmimic_jax.ppo.collect import collect, draw_states
from forgetmimic_jax.ppo.state import TrainState, init_state
from forgetmimic_jax.ppo.update import make_iteration
from forgetmimic_jax.tracking.env import Assets, Environment, make_assets, make_environment
from forgetmimic_jax.tracking.focus import focus_of
from forgetmimic_jax.tracking.layouts import LAYOUTS
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.unlearning.registry import method_of, unlearning_config

ENVS, STEPS, CONTROL_STEP = 8, 2, 0.02
DISCOUNT, GAE_LAMBDA, PENALTY = 0.9, 0.7, 16.0
SWAY, TURN = 0, 1  # the clip to keep and the clip to forget


# What these tests know of the inside of a state and of a rollout.


def collected(env: Environment, assets: Assets, state: TrainState) -> dict[str, jax.Array]:
    """The arrays [time, env, ...] of a rollout by name."""
    _, transition, outcome = collect(env, assets, state, method_of(env.config))
    return {**vars(transition), **vars(outcome)}


def drawn(env: Environment, assets: Assets, state: TrainState) -> dict[str, jax.Array]:
    """The same where states are drawn in the place of a rollout."""
    return vars(draw_states(env, assets, state)[1])


def with_episodes(state: TrainState, **changes) -> TrainState:
    """A state whose running episodes have other fields, [env] each."""
    return dataclasses.replace(state, env=dataclasses.replace(state.env, **changes))


def lifted(state: TrainState, env: int) -> TrainState:
    """A state in which one robot is a metre too high, which ends its episode with the next step."""
    physics = state.env.physics
    return with_episodes(state, physics=dataclasses.replace(physics, qpos=physics.qpos.at[env, 2].add(1.0)))


def only(assets: Assets, clip: int, index: int) -> Assets:
    """Assets of which one bin alone is ever started from."""
    valid = jnp.zeros_like(assets.bins.valid).at[clip, index].set(True)
    return dataclasses.replace(assets, bins=dataclasses.replace(assets.bins, valid=valid))


@dataclasses.dataclass
class Run:
    env: Environment
    assets: Assets

    def __post_init__(self):
        self._begin = jax.jit(lambda assets: init_state(self.env, assets, jax.random.PRNGKey(0)))
        self._collect = jax.jit(lambda assets, state: collected(self.env, assets, state))
        self._iterate = make_iteration(self.env, method_of(self.env.config))

    def begin(self, assets: Assets | None = None) -> TrainState:
        return self._begin(assets or self.assets)

    def collect(self, assets: Assets, state: TrainState) -> SimpleNamespace:
        return SimpleNamespace(**jax.device_get(self._collect(assets, state)))

    def iterate(self, assets: Assets, state: TrainState) -> tuple[TrainState, dict[str, np.ndarray]]:
        return jax.device_get(self._iterate(assets, jax.tree.map(jnp.copy, state)))


@pytest.fixture(scope="module")
def run(robot, library, tiny_config) -> Run:
    """A run of the anti-reward against `turn`: branches in pairs, one gradient step, nothing random but the starts."""
    plain = dataclasses.replace(
        tiny_config,
        noise=dataclasses.replace(tiny_config.noise, enabled=False),
        ppo=dataclasses.replace(
            tiny_config.ppo,
            num_steps=STEPS,
            branches=2,
            epochs=1,
            minibatches=1,
            equal_clips=True,
            discount=DISCOUNT,
            gae_lambda=GAE_LAMBDA,
        ),
    )
    unlearn = dataclasses.replace(plain.unlearn, targets=("turn",), method="arft", settings={"penalty": PENALTY})
    setup = Setup(unlearning_config(plain, unlearn), robot, library, "invented")
    return Run(make_environment(setup, ENVS), make_assets(setup))


OTHER_CLIP = [((SWAY, 1), (TURN, 0)), ((TURN, 0), (SWAY, 1))]  # (clip, bin) of the episodes that end, of the next ones
STEPS_BEFORE, TRACKING_BEFORE = 9, 6.0  # steps behind the episodes that end with the first step, and their Σ r̄


def ending(run: Run, clip: int, index: int) -> TrainState:
    """Every episode is of one bin and one step before its end."""
    steps = jnp.full(ENVS, STEPS_BEFORE, jnp.int32)
    state = run.begin(only(run.assets, clip, index))
    tracking_sum = jnp.full(ENVS, TRACKING_BEFORE, jnp.float32)
    return with_episodes(state, step=steps, horizon=steps + 1, tracking_sum=tracking_sum)


@pytest.mark.parametrize(("ended", "started"), OTHER_CLIP)
def test_an_episodes_last_step_is_credited_to_the_episode_that_ends(run, ended, started):
    found = run.collect(only(run.assets, *started), ending(run, *ended))
    assert found.truncated[0].all()
    assert not (found.truncated[1] | found.terminated).any()
    np.testing.assert_array_equal(found.clip, np.repeat([[ended[0]], [started[0]]], ENVS, axis=1))
    np.testing.assert_array_equal(found.start_bin, np.repeat([[ended[1]], [started[1]]], ENVS, axis=1))
    np.testing.assert_array_equal(found.steps, np.repeat([[STEPS_BEFORE + 1], [1]], ENVS, axis=1))
    survival_weighted = (TRACKING_BEFORE + found.normalized_tracking[0]) / (STEPS_BEFORE + 1)
    np.testing.assert_allclose(found.failure[0], 1.0 - survival_weighted, rtol=1e-5)
    anti_reward = PENALTY * found.normalized_tracking * (found.clip == TURN)
    per_second = found.tracking + found.regularisation - anti_reward
    np.testing.assert_allclose(found.reward, CONTROL_STEP * per_second, rtol=1e-5, atol=1e-6)
    assert anti_reward.max() > 1.0


@pytest.mark.parametrize(("ended", "started"), OTHER_CLIP)
def test_metrics_and_sampler_learn_of_the_episode_that_ended(run, ended, started):
    assets, state = only(run.assets, *started), ending(run, *ended)
    tracked = run.collect(assets, state).normalized_tracking
    before = np.asarray(state.failure_level)
    after, metrics = run.iterate(assets, state)
    of_ended = np.arange(2) == ended[0]
    np.testing.assert_array_equal(metrics["clip/steps"], [ENVS, ENVS])
    np.testing.assert_array_equal(metrics["clip/episodes"], ENVS * of_ended)
    np.testing.assert_array_equal(metrics["clip/completed"], ENVS * of_ended)
    np.testing.assert_array_equal(metrics["clip/episode_length_sum"], ENVS * (STEPS_BEFORE + 1) * of_ended)
    survival_weighted = (TRACKING_BEFORE + tracked[0]) / (STEPS_BEFORE + 1)
    np.testing.assert_allclose(metrics["clip/survival_weighted_sum"], survival_weighted.sum() * of_ended, rtol=1e-5)
    on_target = tracked[0 if ended[0] == TURN else 1]
    assert metrics["target/step_share"] == 0.5
    assert metrics["target/R_anti"] == pytest.approx(-PENALTY * on_target.mean(), rel=1e-5)
    keep = (1.0 - run.env.config.sampling.smoothing) ** ENVS
    expected = before.copy()
    expected[ended] = keep * before[ended] + (1.0 - keep) * (1.0 - survival_weighted.mean())
    np.testing.assert_allclose(after.failure_level, expected, rtol=1e-5)
    assert expected[ended] < before[ended] - 0.01


def test_the_policy_learns_from_branches_against_each_other_and_the_critic_from_what_came(run):
    """Of four pairs one ends by its time and one falls with the first step, so only two still compare in the second."""
    state = lifted(run.begin(), env=2)
    state = with_episodes(state, horizon=state.env.horizon.at[0].set(1))
    found = run.collect(run.assets, state)
    np.testing.assert_array_equal(found.truncated[0], [1, 1, 0, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(found.terminated[0], [0, 0, 1, 1, 0, 0, 0, 0])
    assert not (found.truncated[1] | found.terminated[1]).any()

    delta = found.reward + DISCOUNT * np.where(found.terminated, 0.0, found.next_value) - found.value
    goes_on = np.arange(ENVS) >= 4
    advantage = np.stack([delta[0] + DISCOUNT * GAE_LAMBDA * goes_on * delta[1], delta[1]])
    other = advantage.reshape(STEPS, -1, 2)[..., ::-1].reshape(STEPS, ENVS)
    compared = advantage - other * [np.ones(ENVS), goes_on]

    def clips_mean(values: np.ndarray) -> float:
        """Every clip weighs the same."""
        return np.mean([values[found.clip == clip].mean() for clip in (SWAY, TURN)])

    def policy_loss(advantage: np.ndarray) -> float:
        """Before the first gradient step every probability ratio is 1."""
        return -clips_mean((advantage - advantage.mean()) / advantage.std())

    _, metrics = run.iterate(run.assets, state)
    assert metrics["policy_loss"] == pytest.approx(policy_loss(compared), abs=1e-4)
    assert abs(policy_loss(compared) - policy_loss(advantage)) > 0.05
    assert metrics["value_loss"] == pytest.approx(clips_mean(advantage**2), rel=1e-4)


def perceptron(parameters: dict, observation: np.ndarray) -> np.ndarray:
    """The output [..., outputs] of an ELU network, from its kernels and biases."""
    layers = parameters["params"]["MLP_0"]
    for index in range(len(layers)):
        layer = layers[f"Dense_{index}"]
        observation = observation @ np.asarray(layer["kernel"], np.float64) + np.asarray(layer["bias"])
        if index < len(layers) - 1:
            observation = np.where(observation > 0.0, observation, np.expm1(np.minimum(observation, 0.0)))
    return observation


def normalised(normalizer: Normalizer, observation: np.ndarray) -> np.ndarray:
    mean, variance = np.asarray(normalizer.mean, np.float64), np.asarray(normalizer.variance, np.float64)
    return np.clip((observation - mean) / np.sqrt(variance + 1e-6), -10.0, 10.0)


def test_the_base_reads_its_observations_through_its_own_normalisers(run, robot):
    """On kept steps, by hand: the divergence of the policy from the base and the distance of their values."""
    config = run.env.config
    config = dataclasses.replace(
        config,
        ppo=dataclasses.replace(config.ppo, base_kl=0.5),
        unlearn=dataclasses.replace(config.unlearn, method="trajdeleter", settings={}),
    )
    state = run.begin()
    found = run.collect(run.assets, state)
    sizes = LAYOUTS["wbc132"].size(robot.num_joints), found.critic_observation.shape[-1]
    rng = np.random.default_rng(0)

    def normaliser(size: int) -> Normalizer:
        mean, variance = rng.normal(size=size), rng.uniform(0.5, 4.0, size)
        return Normalizer(jnp.asarray(mean, jnp.float32), jnp.asarray(variance, jnp.float32), jnp.float32(100.0))

    def policy(seed: int, spread: float) -> Policy:
        """Random networks whose means are some tenths, with normalisers of their own."""
        random = init_policy(config.ppo, robot.num_joints, *sizes, jax.random.PRNGKey(seed))
        actor = jax.tree.map(lambda leaf: 3.0 * leaf if leaf.ndim > 1 else leaf, random.actor)
        actor["params"]["log_std"] = jnp.full(robot.num_joints, np.log(spread), jnp.float32)
        return dataclasses.replace(
            random, actor=actor, actor_normalizer=normaliser(sizes[0]), critic_normalizer=normaliser(sizes[1])
        )

    learner, base = policy(1, 0.5), policy(2, 0.3)
    state = dataclasses.replace(state, policy=learner)
    found = run.collect(run.assets, state)
    focus = focus_of(config.ppo, run.assets.is_target)
    anchored = Run(dataclasses.replace(run.env, config=config), dataclasses.replace(run.assets, base=base, focus=focus))
    _, metrics = anchored.iterate(anchored.assets, state)
    kept = found.clip == SWAY
    assert 0 < kept.sum() < kept.size

    def outputs(of: Policy) -> tuple[np.ndarray, np.ndarray]:
        mean = perceptron(of.actor, normalised(of.actor_normalizer, found.actor_observation[kept]))
        value = perceptron(of.critic, normalised(of.critic_normalizer, found.critic_observation[kept]))
        return mean, value[:, 0]

    (mean, value), (base_mean, base_value) = outputs(learner), outputs(base)
    per_joint = np.log(0.3 / 0.5) + (0.5**2 + (mean - base_mean) ** 2) / (2 * 0.3**2) - 0.5
    assert metrics["base_kl"] == pytest.approx(per_joint.sum(-1).mean(), rel=1e-4)
    assert metrics["base_value_distance"] == pytest.approx(((value - base_value) ** 2).mean(), rel=1e-4)


class Collapsing:
    """An engine whose robots fall to the floor's origin in one step, which ends every episode at once."""

    def step(self, state, parameters, target, wrench):
        nothing = jnp.zeros((len(target), 14, 3))
        upright = jnp.zeros((len(target), 14, 4)).at[..., 0].set(1.0)
        return state, BodyState(nothing, upright, nothing, nothing, nothing)

    def forward(self, state, parameters, mask, bodies):
        return bodies


@pytest.fixture(scope="module")
def many(robot, library, tiny_config) -> Run:
    """256 robots that fall at once in each of 16 steps: 4096 starts, of which four in five are on the target."""
    unlearn = dataclasses.replace(tiny_config.unlearn, targets=("turn",))
    config = unlearning_config(tiny_config, unlearn)
    config = dataclasses.replace(
        config,
        noise=dataclasses.replace(config.noise, enabled=False),
        ppo=dataclasses.replace(config.ppo, num_envs=256, num_steps=16),
        sampling=dataclasses.replace(config.sampling, target_share=0.8),
    )
    assets = make_assets(Setup(config, robot, library, "invented"))
    return Run(Environment(config, robot, Collapsing(), 256, noisy=False), assets)


TURN_STARTS = 40  # frames of the target that an episode may start at
FOUR_ERRORS = 4 * np.sqrt(0.8 * 0.2)  # over √n: four standard errors of the share of n starts


def test_the_targets_get_their_share_of_the_starts_in_a_rollout(many):
    found = many.collect(many.assets, many.begin())
    assert (found.terminated | found.truncated).all()
    first, later = found.clip[0] == TURN, found.clip[1:] == TURN
    assert first.mean() == pytest.approx(0.8, abs=FOUR_ERRORS / np.sqrt(first.size))
    assert later.mean() == pytest.approx(0.8, abs=FOUR_ERRORS / np.sqrt(later.size))


def from_first_frames(run: Run, share: float) -> Run:
    """The run with that share of its starts at the first frame of their clip."""
    sampling = dataclasses.replace(run.env.config.sampling, first_frame=share)
    config = dataclasses.replace(run.env.config, sampling=sampling)
    return Run(dataclasses.replace(run.env, config=config), run.assets)


def test_a_share_of_the_starts_is_at_the_first_frame(many):
    frame = np.asarray(from_first_frames(many, 0.8).begin().env.frame)
    assert (frame == 0).mean() == pytest.approx(0.8, abs=FOUR_ERRORS / np.sqrt(frame.size) + 1.0 / TURN_STARTS)
    assert (np.asarray(many.begin().env.frame) == 0).mean() < 0.2


def test_states_drawn_without_a_simulator_may_all_be_at_the_first_frame(many):
    first = from_first_frames(many, 1.0)
    found = jax.jit(lambda assets, state: drawn(first.env, assets, state))(first.assets, first.begin())
    reference = np.asarray(found["actor_observation"])[..., :39].reshape(found["clip"].size, -1)
    assert len(np.unique(reference, axis=0)) == 2  # one frame a clip


def test_states_drawn_without_a_simulator_have_the_share_too_and_each_its_own_reset_noise(many):
    """Every bin has one frame, so states of a bin differ by their noise alone."""
    bins = dataclasses.replace(many.assets.bins, end=many.assets.bins.start + 1)
    assets = dataclasses.replace(many.assets, bins=bins)
    found = SimpleNamespace(**jax.jit(lambda assets, state: drawn(many.env, assets, state))(assets, many.begin()))
    assert (found.clip == TURN).mean() == pytest.approx(0.8, abs=FOUR_ERRORS / np.sqrt(found.clip.size))
    observation = np.asarray(found.actor_observation).reshape(found.clip.size, -1)
    reference, robot = observation[:, :39], observation[:, 39:]
    assert len(np.unique(reference, axis=0)) == bins.valid.sum()
    assert len(np.unique(robot, axis=0)) == found.clip.size


def test_states_drawn_without_a_simulator_show_the_robot_where_its_reset_noise_put_it(run):
    """From one frame, the way from the robot's anchor to the reference's differs by the noise of the robot."""
    one_frame = dataclasses.replace(run.assets.bins, end=run.assets.bins.start + 1)
    assets = only(dataclasses.replace(run.assets, bins=one_frame), TURN, 0)
    found = jax.jit(lambda assets, state: drawn(run.env, assets, state))(assets, run.begin())
    anchor_position = np.asarray(found["critic_observation"])[..., 132:135].reshape(-1, 3)
    assert len(np.unique(anchor_position, axis=0)) == ENVS * STEPS
