"""What an iteration averages and sums over the shards is what it would be over all steps in one shard.

Shards are members of a `vmap` whose axis has the mesh's name, so that one device is enough.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from forgetmimic_jax.basics.shards import AXIS, average, moments, shards, total
from forgetmimic_jax.policy.normalizer import Normalizer
from forgetmimic_jax.ppo.loss import equal_share, mean
from forgetmimic_jax.settings.config import SamplingConfig
from forgetmimic_jax.tracking.rsi import update_failure_level

SHARDS, STEPS = 4, 6
VALUES = np.random.default_rng(0).normal(3.0, 2.0, (SHARDS, STEPS)).astype(np.float32)
# In the second shard nothing has weight, as where it has no step of a target.
WEIGHT = np.array([[1, 0, 2, 0, 0, 1], [0] * 6, [3, 0, 0, 0, 0, 0], [0.5] * 6], np.float32)


def on_shards(function):
    return jax.vmap(function, axis_name=AXIS)


def test_without_shards_nothing_is_added():
    assert shards() == 1
    np.testing.assert_array_equal(total(VALUES), VALUES)
    np.testing.assert_array_equal(average(VALUES), VALUES)


def test_sums_and_means_are_over_the_shards():
    np.testing.assert_allclose(on_shards(total)(VALUES), np.tile(VALUES.sum(0), (SHARDS, 1)), rtol=1e-6)
    np.testing.assert_allclose(on_shards(average)(VALUES), np.tile(VALUES.mean(0), (SHARDS, 1)), rtol=1e-6)


def test_moments_are_of_all_values():
    found_mean, found_variance = on_shards(moments)(VALUES)
    np.testing.assert_allclose(found_mean, np.full(SHARDS, VALUES.mean()), rtol=1e-6)
    np.testing.assert_allclose(found_variance, np.full(SHARDS, VALUES.var()), rtol=1e-6)


@pytest.mark.parametrize("weight", [None, WEIGHT, np.zeros_like(WEIGHT), np.full_like(WEIGHT, 0.01)])
def test_the_average_of_the_parts_of_a_loss_is_the_loss_over_all_steps(weight):
    parts = on_shards(lambda values, w: mean(values, None if weight is None else w))(
        VALUES, WEIGHT if weight is None else weight
    )
    expected = VALUES.mean() if weight is None else (VALUES * weight).sum() / max(weight.sum(), 1.0)
    np.testing.assert_allclose(parts.mean(), expected, rtol=1e-6)


def test_clips_weigh_the_same_over_all_shards():
    clip = np.array([[0, 0, 0, 0, 0, 1], [0] * 6, [0] * 6, [1, 1, 2, 0, 0, 0]])  # 20 steps, 3 and 1, of four clips
    found = on_shards(lambda group: equal_share(group, 4))(clip)
    np.testing.assert_allclose(found, 24 / (3 * np.array([20, 3, 1])[clip]), rtol=1e-6)


def test_normalizers_learn_the_steps_of_all_shards():
    start = Normalizer(mean=jnp.array([1.0]), variance=jnp.array([4.0]), count=jnp.float32(10.0))
    found = on_shards(lambda batch: start.updated(batch[:, None]))(VALUES)
    # Ten values of mean 1 and variance 4 before.
    before = np.repeat([3.0, -1.0], 5)
    together = np.concatenate([before, VALUES.ravel()])
    np.testing.assert_allclose(found.mean[:, 0], np.full(SHARDS, together.mean()), rtol=1e-5)
    np.testing.assert_allclose(found.variance[:, 0], np.full(SHARDS, together.var()), rtol=1e-5)
    np.testing.assert_array_equal(found.count, np.full(SHARDS, 34.0))


def test_failure_levels_learn_the_episodes_of_all_shards():
    config = dataclasses.replace(SamplingConfig(), smoothing=0.1)
    done = np.array([[1, 0, 0], [0, 0, 0], [1, 1, 0], [0, 1, 0]], bool)
    failure = np.array([[0.2, 9, 9], [9, 9, 9], [0.4, 1.0, 9], [9, 0.6, 9]], np.float32)
    clip, index = np.tile([0, 1, 0], (4, 1)), np.tile([0, 0, 1], (4, 1))
    found = on_shards(lambda *of: update_failure_level(config, jnp.ones((2, 2)), *of))(done, failure, clip, index)
    # Two episodes of the first bin with mean 0.3, two of the third with mean 0.8, none of the others.
    expected = [[0.81 + 0.19 * 0.3, 1.0], [0.81 + 0.19 * 0.8, 1.0]]
    np.testing.assert_allclose(found, np.tile(expected, (4, 1, 1)), rtol=1e-6)
