import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from forgetmimic_jax.policy import normalizer as normalizer_module
from forgetmimic_jax.policy.gaussian import entropy, kl_divergence, log_prob
from forgetmimic_jax.policy.normalizer import Normalizer
from forgetmimic_jax.policy.policy import Actor, Critic, bound_std

KEY = jax.random.PRNGKey(0)
MEAN, LOG_STD = np.array([0.3, -1.0, 2.0]), np.log([0.5, 1.0, 1.7])
NEW_MEAN, NEW_LOG_STD = np.array([0.1, -0.6, 2.5]), np.log([0.7, 0.9, 1.2])


def perceptron(layers: dict, x: np.ndarray) -> np.ndarray:
    """An ELU perceptron's forward pass in numpy."""
    for index in range(len(layers)):
        dense = layers[f"Dense_{index}"]
        x = x @ np.asarray(dense["kernel"]) + np.asarray(dense["bias"])
        if index < len(layers) - 1:
            x = np.where(x > 0, x, np.expm1(np.minimum(x, 0)))
    return x


def test_actor_and_critic_are_elu_perceptrons_with_a_linear_end():
    x = np.random.default_rng(0).standard_normal((5, 7))
    actor, critic = Actor((8, 6), 3, 1.0), Critic((4,))
    actor_parameters, critic_parameters = actor.init(KEY, jnp.asarray(x)), critic.init(KEY, jnp.asarray(x))
    mean, _ = actor.apply(actor_parameters, jnp.asarray(x))
    np.testing.assert_allclose(mean, perceptron(actor_parameters["params"]["MLP_0"], x), atol=1e-5)
    expected = perceptron(critic_parameters["params"]["MLP_0"], x)[:, 0]
    np.testing.assert_allclose(critic.apply(critic_parameters, jnp.asarray(x)), expected, atol=1e-5)


@pytest.mark.parametrize("initial_std", [1.0, 0.5])
def test_the_standard_deviation_is_one_number_per_action_and_sees_no_observation(initial_std):
    actor = Actor((8,), 3, initial_std)
    parameters = actor.init(KEY, jnp.zeros((1, 7)))
    log_std = actor.apply(parameters, jax.random.normal(KEY, (5, 7)))[1]
    np.testing.assert_allclose(np.exp(log_std), [initial_std] * 3, rtol=1e-6)


def test_a_standard_deviation_past_its_bound_comes_back_to_it_and_keeps_its_gradient():
    actor = Actor((8,), 3, 1.0)
    parameters = actor.init(KEY, jnp.zeros((1, 7)))
    parameters["params"]["log_std"] = jnp.log(jnp.array([0.01, 0.5, 9.0]))
    bounded = bound_std(parameters)
    np.testing.assert_allclose(np.exp(bounded["params"]["log_std"]), [0.05, 0.5, 2.0], rtol=1e-6)
    gradient = jax.grad(lambda p: actor.apply(p, jnp.zeros((1, 7)))[1].sum())(bounded)
    np.testing.assert_array_equal(gradient["params"]["log_std"], [1.0, 1.0, 1.0])


def test_the_first_policy_is_almost_the_zero_action():
    actor = Actor((64, 64), 29, 1.0)
    mean, _ = actor.apply(actor.init(KEY, jnp.zeros((1, 132))), jax.random.normal(KEY, (50, 132)))
    assert float(jnp.abs(mean).max()) < 0.3


def test_log_density_is_scipys():
    action = np.array([0.0, 0.5, 1.0])
    expected = stats.norm(MEAN, np.exp(LOG_STD)).logpdf(action).sum()
    assert float(log_prob(*map(jnp.asarray, (action, MEAN, LOG_STD)))) == pytest.approx(expected, rel=1e-5)


def test_entropy_is_scipys():
    expected = stats.norm(0, np.exp(LOG_STD)).entropy().sum()
    assert float(entropy(jnp.asarray(LOG_STD))) == pytest.approx(expected, rel=1e-5)


def test_kl_is_the_integral_over_the_old_policy():
    expected = 0.0
    for mean, log_std, new_mean, new_log_std in zip(MEAN, LOG_STD, NEW_MEAN, NEW_LOG_STD, strict=True):
        old, new = stats.norm(mean, np.exp(log_std)), stats.norm(new_mean, np.exp(new_log_std))
        expected += integrate.quad(
            lambda x, old=old, new=new: old.pdf(x) * (old.logpdf(x) - new.logpdf(x)), mean - 20, mean + 20
        )[0]
    kl = kl_divergence(*map(jnp.asarray, (MEAN, LOG_STD, NEW_MEAN, NEW_LOG_STD)))
    assert float(kl) == pytest.approx(expected, rel=1e-4)
    backwards = kl_divergence(*map(jnp.asarray, (NEW_MEAN, NEW_LOG_STD, MEAN, LOG_STD)))
    assert abs(float(backwards) - expected) > 0.01


def test_kl_of_a_policy_to_itself_is_zero():
    assert float(kl_divergence(*map(jnp.asarray, (MEAN, LOG_STD, MEAN, LOG_STD)))) == pytest.approx(0.0, abs=1e-7)


def test_normalizer_has_the_statistics_of_all_batches_together():
    rng = np.random.default_rng(1)
    batches = [rng.normal(3.0 * i, 1.0 + i, (4, 5 + i, 3)) for i in range(4)]
    normalizer = Normalizer.create(3)
    for batch in batches:
        normalizer = normalizer.updated(jnp.asarray(batch, jnp.float32))
    together = np.concatenate([batch.reshape(-1, 3) for batch in batches])
    np.testing.assert_allclose(normalizer.mean, together.mean(0), rtol=1e-5)
    np.testing.assert_allclose(normalizer.variance, together.var(0), rtol=1e-4)
    assert float(normalizer.count) == len(together)


def test_a_feature_that_never_varied_starts_anew_when_it_first_does():
    rng = np.random.default_rng(4)
    before, after = rng.normal(2.0, 3.0, (1000, 2)), rng.normal(5.0, 0.1, (50, 2))
    before[:, 1] = 0.0
    normalizer = Normalizer.create(2)
    for batch in (before, before, after):
        normalizer = normalizer.updated(jnp.asarray(batch, jnp.float32))
    together = np.concatenate([before, before, after])
    np.testing.assert_allclose(normalizer.mean, [together[:, 0].mean(), after[:, 1].mean()], rtol=1e-5)
    np.testing.assert_allclose(normalizer.variance, [together[:, 0].var(), after[:, 1].var()], rtol=1e-3)


def test_normalized_observations_have_mean_zero_and_variance_one():
    observation = jnp.asarray(np.random.default_rng(2).normal(5.0, 3.0, (1000, 2)), jnp.float32)
    scaled = Normalizer.create(2).updated(observation)(observation)
    np.testing.assert_allclose(scaled.mean(0), 0.0, atol=1e-5)
    np.testing.assert_allclose(scaled.std(0), 1.0, atol=1e-5)


def test_a_new_normalizer_changes_nothing():
    np.testing.assert_allclose(Normalizer.create(2)(jnp.array([0.5, -3.0])), [0.5, -3.0], rtol=1e-5)


def test_normalized_observations_are_clipped_at_ten():
    np.testing.assert_allclose(Normalizer.create(2)(jnp.array([1e6, -1e6])), [10.0, -10.0])


def test_past_its_largest_count_the_normalizer_still_learns(monkeypatch):
    monkeypatch.setattr(normalizer_module, "MAX_COUNT", 100.0)
    normalizer = Normalizer(jnp.zeros(1), jnp.ones(1), jnp.float32(100.0))
    for _ in range(200):
        normalizer = normalizer.updated(jnp.full((10, 1), 2.0))
    assert float(normalizer.count) == 100.0
    assert float(normalizer.mean[0]) == pytest.approx(2.0, abs=1e-3)
