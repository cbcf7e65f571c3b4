"""Weights of less precision against values worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from trees import assert_same

from forgetmimic_jax.attacks import numerics
from forgetmimic_jax.policy.policy import init_policy
from forgetmimic_jax.settings.config import PPOConfig


def test_four_bits_have_fifteen_levels_for_each_output():
    weights = jnp.array([[7.0, 0.875, 0.0], [-3.5, 0.3, 0.0], [2.5, -0.05, 0.0], [1.2, -0.875, 0.0]])
    expected = [[7.0, 0.875, 0.0], [-4.0, 0.25, 0.0], [2.0, 0.0, 0.0], [1.0, -0.875, 0.0]]
    np.testing.assert_array_equal(numerics.quantised(weights, 4), expected)


def test_eight_bits_have_255():
    np.testing.assert_array_equal(numerics.quantised(jnp.array([[127.0], [3.6], [-0.4]]), 8), [[127.0], [4.0], [0.0]])


def test_bfloat16_has_eight_bits_and_rounds_ties_to_even():
    weights = jnp.array([1.0 + 2.0**-7, 1.0 + 2.0**-8, 1.0 + 3.0 * 2.0**-8, 3.14159])
    np.testing.assert_array_equal(numerics.half_precision(weights), [1.0 + 2.0**-7, 1.0, 1.0 + 2.0**-6, 3.140625])
    assert numerics.half_precision(weights).dtype == jnp.float32


def test_noise_is_a_share_of_the_layers_standard_deviation():
    weights = 5.0 * jax.random.normal(jax.random.PRNGKey(1), (200, 200)) + 1.0
    noise = numerics.noisy(0.03, weights, jax.random.PRNGKey(2)) - weights
    assert float(noise.std()) == pytest.approx(0.03 * 5.0, rel=0.02)
    assert abs(float(noise.mean())) < 0.003


@pytest.mark.parametrize("name", numerics.CHANGES)
def test_layers_of_the_actor_change_and_nothing_else(name):
    policy = init_policy(PPOConfig(actor_layers=(8, 4), critic_layers=(8,)), 3, 5, 7, jax.random.PRNGKey(0))
    found = numerics.changed(policy, numerics.CHANGES[name], seed=1)
    before, after = (jax.tree_util.tree_leaves_with_path(of.actor) for of in (policy, found))
    for (path, old), (_, new) in zip(before, after, strict=True):
        kernel = "kernel" in jax.tree_util.keystr(path)
        assert bool(jnp.array_equal(old, new)) != kernel, path
    for part in ("critic", "actor_normalizer", "critic_normalizer"):
        assert_same(getattr(found, part), getattr(policy, part))


def test_every_layer_has_noise_of_its_own():
    policy = init_policy(PPOConfig(actor_layers=(6, 6, 6), critic_layers=(8,)), 3, 6, 7, jax.random.PRNGKey(0))
    found = numerics.changed(policy, lambda weights, key: jax.random.normal(key, weights.shape))
    one, two = (found.actor["params"]["MLP_0"][f"Dense_{layer}"]["kernel"] for layer in (1, 2))
    assert not jnp.allclose(one, two)


def test_the_changes_are_those_of_the_definition():
    assert list(numerics.CHANGES) == ["bf16", "int8", "int4", "noise 1%", "noise 3%", "noise 10%"]
