import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from forgetmimic_jax.config import Config, UnlearnConfig, preset, to_dict
from forgetmimic_jax.tracking.reward import Reward
from forgetmimic_jax.unlearning.antireward import threshold_metrics, training_reward, unlearning_config

ON_TARGET = jnp.array([True, False])


def forgetting(penalty: float) -> Config:
    return dataclasses.replace(Config(), unlearn=UnlearnConfig(targets=("punch",), penalty=penalty))


def reward_of(tracking: float, regularisation: float) -> Reward:
    """The same reward for a target step and a kept step; r̄ = R_track / 8."""
    both = jnp.ones(2)
    return Reward(tracking * both, regularisation * both, tracking / 8.0 * both, {})


def test_the_anti_reward_by_hand():
    # R' = 6 + 0.4 − 16 · 0.75 on the target, 6 + 0.4 elsewhere
    result = training_reward(forgetting(16.0), reward_of(6.0, 0.4), ON_TARGET)
    np.testing.assert_allclose(result, [-5.6, 6.4], rtol=1e-6)


def test_without_targets_nothing_is_subtracted():
    result = training_reward(Config(), reward_of(6.0, 0.4), ON_TARGET)
    np.testing.assert_allclose(result, [6.4, 6.4], rtol=1e-6)


@pytest.mark.parametrize("tracking", [0.0, 1.0, 4.0, 8.0])
def test_at_a_penalty_of_w_a_target_steps_reward_does_not_depend_on_tracking(tracking):
    result = training_reward(forgetting(8.0), reward_of(tracking, 0.4), ON_TARGET)
    assert float(result[0]) == pytest.approx(0.4, abs=1e-6)


@pytest.mark.parametrize(("penalty", "sign"), [(4.0, 1), (12.0, -1)])
def test_better_tracking_pays_on_a_target_step_below_w_and_costs_above_it(penalty, sign):
    better, worse = (training_reward(forgetting(penalty), reward_of(r, 0.4), ON_TARGET) for r in (7.0, 3.0))
    assert np.sign(better[0] - worse[0]) == sign
    assert better[1] > worse[1]


def metrics_of(config: Config) -> dict[str, float]:
    """Three clips, the second one to be forgotten."""
    metrics = threshold_metrics(
        config,
        is_target=jnp.array([False, True, False]),
        steps=jnp.array([30.0, 20.0, 50.0]),
        tracking=jnp.array([210.0, 80.0, 270.0]),
        regularisation=jnp.array([15.0, 10.0, 1.0]),
        normalized=jnp.array([26.25, 10.0, 33.75]),
    )
    return {name: float(value) for name, value in metrics.items()}


def test_means_on_target_and_on_kept_steps_by_hand():
    metrics = metrics_of(forgetting(16.0))
    assert metrics["target/step_share"] == pytest.approx(0.2)
    assert metrics["target/R_track"] == pytest.approx(4.0)
    assert metrics["target/R_reg"] == pytest.approx(0.5)
    assert metrics["target/R_anti"] == pytest.approx(-8.0)  # −16 · 0.5
    assert metrics["target/tracking_reward"] == pytest.approx(0.5)
    assert metrics["kept/step_share"] == pytest.approx(0.8)
    assert metrics["kept/R_track"] == pytest.approx(6.0)
    assert metrics["kept/R_reg"] == pytest.approx(0.2)
    assert metrics["kept/R_anti"] == 0.0
    assert metrics["kept/tracking_reward"] == pytest.approx(0.75)


def test_the_critical_penalty_is_where_a_target_steps_mean_reward_changes_its_sign():
    critical = metrics_of(forgetting(16.0))["target/lambda_crit"]
    assert critical == pytest.approx(8.0 * (1.0 + 0.5 / 4.0))
    for penalty, sign in ((critical - 0.1, 1), (critical + 0.1, -1)):
        reward = training_reward(forgetting(penalty), reward_of(4.0, 0.5), ON_TARGET)
        assert np.sign(reward[0]) == sign


def test_ordinary_training_logs_no_threshold():
    assert metrics_of(Config()) == {}


@pytest.mark.parametrize("base", [preset("paper"), preset("cpu")])
def test_unlearning_changes_exactly_three_things(base):
    base = dataclasses.replace(base, wrench=dataclasses.replace(base.wrench, max_gain=0.6), seed=3)
    before, after = to_dict(base), to_dict(unlearning_config(base, UnlearnConfig(("punch", "kick"), 12.0)))
    changed = {
        (section, name): value
        for section, content in after.items()
        if isinstance(content, dict)
        for name, value in content.items()
        if value != before[section][name]
    }
    assert changed == {
        ("unlearn", "targets"): ["punch", "kick"],
        ("unlearn", "penalty"): 12.0,
        ("sampling", "rule"): "uniform_clips",
        ("wrench", "max_gain"): 0.0,
    }
    assert [name for name in after if after[name] != before[name]] == ["sampling", "wrench", "unlearn"]
