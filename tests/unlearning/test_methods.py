"""Each method's own rule, on batches made by hand. `is_target` marks the steps whose clip is to be forgotten."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from forgetmimic_jax.ppo.loss import Batch, Prediction, ppo_loss
from forgetmimic_jax.ppo.transition import Transition
from forgetmimic_jax.settings.config import Config, ObservationConfig, UnlearnConfig
from forgetmimic_jax.tracking.layouts import LAYOUTS
from forgetmimic_jax.tracking.reward import Reward
from forgetmimic_jax.unlearning.registry import find_method

ON_TARGET = jnp.array([True, False])
KEY = jax.random.PRNGKey(0)
CONFIG = dataclasses.replace(Config(), iterations=160, unlearn=UnlearnConfig(("punch",)))


def rewarded(name: str, tracking: float = 6.0, regularisation: float = 0.4, steps: int = 1) -> np.ndarray:
    """Training reward [2, steps] of equal steps, on a target and on a kept clip."""
    parts = [jnp.full(2 * steps, value) for value in (tracking, regularisation, tracking / 8.0)]
    is_target = jnp.repeat(ON_TARGET, steps)
    return np.asarray(find_method(name).reward(CONFIG, Reward(*parts, terms={}), is_target, KEY)).reshape(2, steps)


@pytest.mark.parametrize("name", ["retrain", "finetune", "poisoning", "gradient_ascent", "decremental", "policy_edit"])
def test_methods_without_a_rule_of_their_own_keep_the_reward(name):
    np.testing.assert_allclose(rewarded(name)[:, 0], [6.4, 6.4], rtol=1e-6)


def test_trajdeleter_negates_the_reward_of_the_targets():
    np.testing.assert_allclose(rewarded("trajdeleter")[:, 0], [-6.4, 6.4], rtol=1e-6)


def test_the_negated_reward_reaches_every_step():
    np.testing.assert_allclose(rewarded("negated_reward")[:, 0], [-6.4, -6.4], rtol=1e-6)


def test_random_rewards_are_uniform_over_the_base_s_range_and_know_nothing_of_tracking():
    targets, kept = rewarded("random_reward", steps=4000)
    np.testing.assert_allclose(kept, 6.4, rtol=1e-6)
    assert 0.0 <= targets.min() < 0.1
    assert 8.9 < targets.max() <= 9.0  # W + survival
    assert targets.mean() == pytest.approx(4.5, abs=0.15)
    np.testing.assert_array_equal(rewarded("random_reward", tracking=1.0, steps=4000)[0], targets)


# What a poisoned observation shows at each place, for 3 joints: the numbers below stand where they are not their own.
SHOWN = {
    # height | linear, angular, gravity → angular, gravity, linear | joints in reverse
    "wbc132": [0, 4, 5, 6, 7, 8, 9, 1, 2, 3, 12, 11, 10],
    "root132": [0, 4, 5, 6, 7, 8, 9, 1, 2, 3, 12, 11, 10],
    # angles in reverse, velocities in reverse | anchor position in reverse | anchor orientation in reverse
    "mjlab160": [2, 1, 0, 5, 4, 3, 8, 7, 6, 14, 13, 12, 11, 10, 9],
    "mjlab154": [2, 1, 0, 5, 4, 3, 11, 10, 9, 8, 7, 6],
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_poisoning_permutes_what_the_actor_sees_of_a_target_s_reference(layout):
    config = dataclasses.replace(CONFIG, observation=ObservationConfig(layout))
    size = LAYOUTS[layout].size(3)
    observation = jnp.tile(jnp.arange(float(size)), (2, 1))
    seen = np.asarray(find_method("poisoning").observation(config, observation, ON_TARGET))
    np.testing.assert_array_equal(seen[1], observation[1])
    np.testing.assert_array_equal(seen[0], [*SHOWN[layout], *range(len(SHOWN[layout]), size)])


JOINTS = 2


@pytest.fixture
def batch() -> Batch:
    """Four steps, of which the first two are of a target clip; the base's mean is 0.5, its σ 0.5 and its value 3."""
    size = 4
    rng = np.random.default_rng(0)

    def full(value: float, *shape: int) -> jax.Array:
        return jnp.full((size, *shape), value, jnp.float32)

    transition = Transition(
        actor_observation=full(0.0, 3),
        critic_observation=full(0.0, 3),
        action=jnp.asarray(rng.normal(size=(size, JOINTS)), jnp.float32),
        log_prob=full(-2.0),
        mean=full(0.0, JOINTS),
        clip=jnp.array([0, 0, 1, 1]),
    )
    return Batch(
        transition=transition,
        value=full(1.0),
        advantage=jnp.array([1.0, -1.0, 1.0, -1.0]),
        value_target=jnp.array([2.0, 2.0, 0.0, 0.0]),
        is_target=jnp.array([True, True, False, False]),
        weight=full(1.0),
        base=Prediction(full(0.5, JOINTS), full(np.log(0.5), JOINTS), full(3.0)),
        base_kl=None,
    )


def now(mean: float = 0.25, std: float = 0.5, value: float = 1.0) -> Prediction:
    return Prediction(jnp.full((4, JOINTS), mean), jnp.full(JOINTS, jnp.log(std)), jnp.full(4, value))


def loss_of(name: str, batch: Batch, prediction: Prediction, iteration: int = 0) -> float:
    return float(find_method(name).loss(CONFIG, batch, prediction, jnp.int32(iteration))[0])


def gaussian_kl(mean: float, std: float, other_mean: float, other_std: float) -> float:
    return np.log(other_std / std) + (std**2 + (mean - other_mean) ** 2) / (2 * other_std**2) - 0.5


def part(batch: Batch, steps: slice, **changes) -> Batch:
    """Some steps of a batch, as a batch."""
    return jax.tree.map(lambda leaf: leaf[steps], dataclasses.replace(batch, **changes))


def test_a_step_counts_by_its_weight(batch):
    first, prediction = dataclasses.replace(batch, weight=jnp.array([2.0, 2.0, 0.0, 0.0])), now()
    alone = ppo_loss(CONFIG, part(batch, slice(0, 2)), jax.tree.map(lambda leaf: leaf[:2], prediction))[0]
    assert loss_of("arft", first, prediction) == pytest.approx(float(alone), rel=1e-6)
    assert loss_of("arft", first, prediction) != pytest.approx(loss_of("arft", batch, prediction), rel=1e-3)


def test_the_kl_to_the_base_is_of_the_steps_that_have_a_weight_for_it(batch):
    """The last two steps have one; the last counts three times as much in the loss, and its mean is further off."""
    mean = jnp.array([9.0, 9.0, 0.25, 0.75])[:, None] * jnp.ones(JOINTS)
    batch = dataclasses.replace(batch, weight=jnp.array([1.0, 1.0, 0.5, 1.5]))
    batch = dataclasses.replace(batch, base=batch.base.replace(mean=batch.base.mean.at[3].set(0.0)))
    prediction = Prediction(mean, jnp.full(JOINTS, jnp.log(0.4)), jnp.ones(4))
    near, far = (JOINTS * gaussian_kl(*kl, 0.5) for kl in ((0.25, 0.4, 0.5), (0.75, 0.4, 0.0)))
    held = dataclasses.replace(batch, base_kl=jnp.array([0.0, 0.0, 0.3, 0.1]))
    loss, metrics = ppo_loss(CONFIG, held, prediction)
    assert float(metrics["base_kl"]) == pytest.approx(0.25 * near + 0.75 * far, rel=1e-5)
    free, parts = ppo_loss(CONFIG, batch, prediction)
    assert float(loss - free) == pytest.approx(0.25 * 0.3 * near + 0.75 * 0.1 * far, rel=1e-4)
    assert "base_kl" not in parts


def test_without_a_base_nothing_is_held(batch):
    alone = dataclasses.replace(batch, base=None, base_kl=jnp.full(4, 0.3))
    assert float(ppo_loss(CONFIG, alone, now())[0]) == float(ppo_loss(CONFIG, batch, now())[0])


def test_gradient_ascent_turns_the_advantage_of_target_steps_round(batch):
    turned = dataclasses.replace(batch, advantage=jnp.array([-1.0, 1.0, 1.0, -1.0]))
    assert loss_of("gradient_ascent", batch, now()) == pytest.approx(loss_of("finetune", turned, now()), rel=1e-6)
    assert loss_of("gradient_ascent", batch, now()) != pytest.approx(loss_of("finetune", batch, now()), rel=1e-3)


def test_decremental_by_hand(batch):
    # σ0 = 1 in the paper's settings; both groups count the same, joints are summed
    forget = JOINTS * gaussian_kl(0.25, 0.4, 0.0, 1.0) + 1.0**2
    keep = JOINTS * gaussian_kl(0.25, 0.4, 0.5, 0.5) + (1.0 - 3.0) ** 2
    assert loss_of("decremental", batch, now(std=0.4)) == pytest.approx(forget + keep, rel=1e-5)


def test_decremental_is_content_with_nothing_on_targets_and_the_base_on_kept_steps(batch):
    nothing, base = part(batch, slice(0, 2)), part(batch, slice(2, 4))
    forgotten = Prediction(jnp.zeros((2, JOINTS)), jnp.zeros(JOINTS), jnp.zeros(2))
    assert loss_of("decremental", nothing, forgotten) == pytest.approx(0.0, abs=1e-6)
    as_ever = Prediction(jnp.full((2, JOINTS), 0.5), jnp.full(JOINTS, jnp.log(0.5)), jnp.full(2, 3.0))
    assert loss_of("decremental", base, as_ever) == pytest.approx(0.0, abs=1e-6)


def test_stand_by_hand(batch):
    """Target steps go to the teacher's 1.0 with the base's σ, kept ones to the base four times as strongly."""
    config = dataclasses.replace(CONFIG, unlearn=UnlearnConfig(("punch",), "stand", {"keep": 4.0}))
    transition = dataclasses.replace(batch.transition, taught=jnp.full((4, JOINTS), 1.0))
    batch = dataclasses.replace(batch, transition=transition, weight=jnp.array([0.5, 1.5, 1.0, 1.0]))
    prediction = dataclasses.replace(now(std=0.4), mean=jnp.array([0.0, 0.25, 0.25, 0.25])[:, None] * jnp.ones(JOINTS))
    learn = JOINTS * (0.25 * gaussian_kl(0.0, 0.4, 1.0, 0.5) + 0.75 * gaussian_kl(0.25, 0.4, 1.0, 0.5))
    keep = JOINTS * gaussian_kl(0.25, 0.4, 0.5, 0.5)
    value = 1.0**2 + (1.0 - 3.0) ** 2
    loss, metrics = find_method("stand").loss(config, batch, prediction, jnp.int32(0))
    assert float(loss) == pytest.approx(learn + 4.0 * keep + value, rel=1e-5)
    assert float(metrics["teacher_kl"]) == pytest.approx(learn, rel=1e-5)
    assert float(metrics["base_kl"]) == pytest.approx(keep, rel=1e-5)


@pytest.mark.parametrize(
    ("iteration", "steps"),
    [(0, slice(2, 4)), (3, slice(2, 4)), (4, slice(0, 2)), (7, slice(0, 2)), (8, slice(2, 4)), (127, slice(0, 2))],
)
def test_trajdeleter_learns_from_kept_and_target_steps_in_turn(batch, iteration, steps):
    prediction = now()
    block = jax.tree.map(lambda leaf: leaf[steps], (prediction.mean, prediction.value))
    expected = ppo_loss(CONFIG, part(batch, steps), Prediction(block[0], prediction.log_std, block[1]))[0]
    assert loss_of("trajdeleter", batch, prediction, iteration) == pytest.approx(float(expected), rel=1e-5)


@pytest.mark.parametrize("iteration", [128, 150, 159])
def test_trajdeleter_ends_on_kept_steps_with_a_tenth_of_the_distance_to_the_base_s_value(batch, iteration):
    kept = loss_of("trajdeleter", batch, now(), 0)
    assert loss_of("trajdeleter", batch, now(), iteration) == pytest.approx(kept + 0.1 * (1.0 - 3.0) ** 2, rel=1e-5)


def test_policy_edit_is_content_with_its_random_action_on_targets_and_the_base_on_kept_steps(batch):
    def loss_at(target_mean: jax.Array) -> jax.Array:
        mean = jnp.concatenate([jnp.tile(target_mean, (2, 1)), jnp.full((2, JOINTS), 0.5)])
        prediction = Prediction(mean, jnp.full(JOINTS, jnp.log(0.5)), jnp.zeros(4))
        return find_method("policy_edit").loss(CONFIG, batch, prediction, jnp.int32(0))[0]

    # a parabola in the mean with curvature 1/σ², so one Newton step from 0 is its minimum
    random_action = -jax.grad(loss_at)(jnp.zeros(JOINTS)) * 0.5**2
    assert (jnp.abs(random_action) <= 1.0).all()
    assert (jnp.abs(random_action) > 0.01).all()
    assert float(loss_at(random_action)) == pytest.approx(0.0, abs=1e-5)
    assert float(loss_at(random_action + 0.5)) == pytest.approx(JOINTS * 0.5**2 / (2 * 0.5**2), rel=1e-4)


def test_policy_edit_by_hand_where_the_spread_is_not_the_base_s(batch):
    """Both divergences are of the policy from where it is to go, with the base's σ of 0.5: at another σ they differ."""

    def loss_at(mean: float, std: float) -> float:
        means = jnp.concatenate([jnp.full((2, JOINTS), mean), jnp.full((2, JOINTS), 0.5)])
        prediction = Prediction(means, jnp.full(JOINTS, jnp.log(std)), jnp.zeros(4))
        return float(find_method("policy_edit").loss(CONFIG, batch, prediction, jnp.int32(0))[0])

    spread = JOINTS * (gaussian_kl(0.5, 0.4, 0.5, 0.5) - gaussian_kl(0.5, 0.5, 0.5, 0.5))
    # the means' share of the divergence is over 2 σ_base² whatever the policy's σ, so σ alone changes both by this
    for mean in (0.0, 0.7):
        assert loss_at(mean, 0.4) - loss_at(mean, 0.5) == pytest.approx(2 * spread, rel=1e-4)


def test_policy_edit_draws_another_action_for_another_clip_and_seed(batch):
    def on(clip: int) -> Batch:
        return dataclasses.replace(batch, transition=dataclasses.replace(batch.transition, clip=jnp.full(4, clip)))

    losses = {loss_of("policy_edit", on(clip), now()) for clip in range(3)}
    assert len(losses) == 3
    other = dataclasses.replace(CONFIG, seed=1)
    assert float(find_method("policy_edit").loss(other, batch, now(), jnp.int32(0))[0]) not in losses


def test_the_critic_is_left_alone_by_policy_edit(batch):
    gradient = jax.grad(lambda value: find_method("policy_edit").loss(
        CONFIG, batch, dataclasses.replace(now(), value=value), jnp.int32(0))[0])(jnp.ones(4))  # fmt: skip
    np.testing.assert_array_equal(gradient, 0.0)
