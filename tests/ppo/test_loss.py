import jax
import jax.numpy as jnp
import numpy as np
import pytest

from forgetmimic_jax.ppo.loss import adapt_learning_rate, equal_share, policy_loss, trapezoid, value_loss
from forgetmimic_jax.settings.config import PPOConfig


@pytest.mark.parametrize(
    ("ratio", "advantage", "loss"),
    [
        (1.0, 2.0, -2.0),
        (1.5, 2.0, -2.4),  # clipped at 1.2: no more gain from a likelier good action
        (0.5, 2.0, -1.0),  # not clipped: a good action made rarer
        (0.5, -1.0, 0.8),  # clipped at 0.8
        (1.5, -1.0, 1.5),  # not clipped: a bad action made likelier
    ],
)
def test_policy_loss_by_hand(ratio, advantage, loss):
    value = policy_loss(jnp.log(jnp.array([ratio])), jnp.array([advantage]), 0.2)
    assert float(value) == pytest.approx(loss, rel=1e-6)


def test_a_clipped_sample_has_no_gradient():
    gradient = jax.grad(lambda log_ratio: policy_loss(log_ratio, jnp.array([1.0, 1.0]), 0.2))
    np.testing.assert_allclose(gradient(jnp.log(jnp.array([1.5, 1.1]))), [0.0, -0.55], rtol=1e-6)


def test_value_loss_is_the_mean_square_without_clipping():
    value, target = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.0, 2.0, 5.0])
    assert float(value_loss(value, value, target, None)) == pytest.approx((1.0 + 0.0 + 4.0) / 3.0)


@pytest.mark.parametrize(
    ("value", "old", "target", "loss"),
    [
        (1.1, 1.0, 2.0, 0.81),  # inside the clip
        (1.5, 1.0, 2.0, 0.64),  # kept at 1.2: the worse of 0.5² and 0.8²
        (0.5, 1.0, 2.0, 2.25),  # moved the wrong way: the worse of 1.5² and 1.2²
    ],
)
def test_clipped_value_loss_by_hand(value, old, target, loss):
    assert float(value_loss(*(jnp.array([x]) for x in (value, old, target)), 0.2)) == pytest.approx(loss, rel=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_losses_equal_rsl_rls_written_in_numpy(seed):
    rng = np.random.default_rng(seed)
    log_ratio, advantage, value, old, target = (rng.standard_normal(64) for _ in range(5))
    ratio = np.exp(log_ratio)
    surrogate = np.maximum(-advantage * ratio, -advantage * np.clip(ratio, 0.8, 1.2)).mean()
    clipped = old + np.clip(value - old, -0.2, 0.2)
    values = np.maximum((value - target) ** 2, (clipped - target) ** 2).mean()
    np.testing.assert_allclose(policy_loss(jnp.asarray(log_ratio), jnp.asarray(advantage), 0.2), surrogate, rtol=1e-5)
    np.testing.assert_allclose(value_loss(*map(jnp.asarray, (value, old, target)), 0.2), values, rtol=1e-5)


def test_weights_and_masks_choose_what_a_mean_is_of():
    value, target, weight = jnp.array([1.0, 2.0, 3.0]), jnp.array([0.0, 4.0, 5.0]), jnp.array([3.0, 0.5, 0.0])
    assert float(value_loss(value, value, target, None, weight)) == pytest.approx((3.0 * 1.0 + 0.5 * 4.0) / 3.5)
    assert float(policy_loss(jnp.zeros(3), target, 0.2, weight)) == pytest.approx(-0.5 * 4.0 / 3.5)


def test_equal_shares_by_hand():
    """Three groups of four may be there, one step of the last, two and three of the others: each gets a third."""
    share = equal_share(jnp.array([[0, 0, 0], [1, 1, 3]]), 4)
    np.testing.assert_allclose(share, [[2 / 3, 2 / 3, 2 / 3], [1.0, 1.0, 2.0]], rtol=1e-6)


@pytest.mark.parametrize(
    ("kl", "factor"),
    [(0.03, 1 / 1.5), (0.0201, 1 / 1.5), (0.019, 1.0), (0.01, 1.0), (0.0051, 1.0), (0.0049, 1.5), (0.0, 1.0)],
)
def test_learning_rate_follows_the_kl(kl, factor):
    rate = adapt_learning_rate(jnp.array(1e-3), jnp.array(kl), 0.01, 1e-5, 1e-2)
    assert float(rate) == pytest.approx(1e-3 * factor, rel=1e-6)


def test_learning_rate_stays_in_its_bounds():
    assert float(adapt_learning_rate(jnp.array(1.2e-5), jnp.array(1.0), 0.01, 1e-5, 1e-2)) == pytest.approx(1e-5)
    assert float(adapt_learning_rate(jnp.array(9e-3), jnp.array(1e-4), 0.01, 1e-5, 1e-2)) == pytest.approx(1e-2)


@pytest.mark.parametrize(
    ("progress", "rate"),
    [(0.0, 1e-4), (0.025, 5.5e-4), (0.05, 1e-3), (0.5, 1e-3), (0.75, 5.5e-4), (1.0, 1e-4), (1.5, 1e-4)],
)
def test_a_trapezoid_rises_stays_and_falls(progress, rate):
    config = PPOConfig(learning_rate=1e-3, min_learning_rate=1e-4)
    assert float(trapezoid(config, jnp.array(progress))) == pytest.approx(rate, rel=1e-6)
