import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from forgetmimic_jax.settings.config import Config, UnlearnConfig
from forgetmimic_jax.tracking.reward import Reward
from forgetmimic_jax.unlearning.arft import METHOD

ON_TARGET = jnp.array([True, False])


def forgetting(penalty: float) -> Config:
    return dataclasses.replace(Config(), unlearn=UnlearnConfig(("punch",), settings={"penalty": penalty}))


def training_reward(config: Config, reward: Reward, is_target) -> jax.Array:
    return METHOD.reward(config, reward, is_target, jax.random.PRNGKey(0))


def reward_of(tracking: float, regularisation: float) -> Reward:
    """The same reward for a target step and a kept step; r̄ = R_track / 8."""
    both = jnp.ones(2)
    return Reward(tracking * both, regularisation * both, tracking / 8.0 * both, {})


def test_the_anti_reward_by_hand():
    # R' = 6 + 0.4 − 16 · 0.75 on the target, 6 + 0.4 elsewhere
    result = training_reward(forgetting(16.0), reward_of(6.0, 0.4), ON_TARGET)
    np.testing.assert_allclose(result, [-5.6, 6.4], rtol=1e-6)


@pytest.mark.parametrize("tracking", [0.0, 1.0, 4.0, 8.0])
def test_at_a_penalty_of_w_a_target_steps_reward_does_not_depend_on_tracking(tracking):
    result = training_reward(forgetting(8.0), reward_of(tracking, 0.4), ON_TARGET)
    assert float(result[0]) == pytest.approx(0.4, abs=1e-6)


@pytest.mark.parametrize(("penalty", "sign"), [(4.0, 1), (12.0, -1)])
def test_better_tracking_pays_on_a_target_step_below_w_and_costs_above_it(penalty, sign):
    better, worse = (training_reward(forgetting(penalty), reward_of(r, 0.4), ON_TARGET) for r in (7.0, 3.0))
    assert np.sign(better[0] - worse[0]) == sign
    assert better[1] > worse[1]


@pytest.mark.parametrize("penalty", [0.5, 4.0, 8.0, 16.0])
def test_on_a_target_step_tracking_counts_one_minus_lambda_over_w(penalty):
    # the paper's R'_target = (1 − λ/W) R_track + R_reg, with W = 8
    result = training_reward(forgetting(penalty), reward_of(5.0, 0.4), ON_TARGET)
    assert float(result[0]) == pytest.approx((1.0 - penalty / 8.0) * 5.0 + 0.4, rel=1e-6)
