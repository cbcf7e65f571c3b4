import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from forgetmimic_jax.ppo.threshold import threshold_metrics
from forgetmimic_jax.settings.config import Config, UnlearnConfig
from forgetmimic_jax.tracking.reward import Reward
from forgetmimic_jax.unlearning.arft import METHOD


def forgetting(penalty: float, method: str = "arft") -> Config:
    return dataclasses.replace(
        Config(), unlearn=UnlearnConfig(("punch",), method, {"penalty": penalty} if method == "arft" else {})
    )


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
        step = Reward(*(jnp.full(1, value) for value in (4.0, 0.5, 0.5)), terms={})
        reward = METHOD.reward(forgetting(penalty), step, jnp.array([True]), jax.random.PRNGKey(0))
        assert np.sign(reward[0]) == sign


def test_a_group_without_a_step_has_no_means_and_no_threshold():
    sums = {"steps": [30.0, 0.0, 50.0], "tracking": [210.0, 0.0, 270.0]}
    sums |= {"regularisation": [15.0, 0.0, 1.0], "normalized": [26.25, 0.0, 33.75]}
    metrics = threshold_metrics(
        forgetting(16.0), jnp.array([False, True, False]), **{name: jnp.array(values) for name, values in sums.items()}
    )
    assert metrics.pop("target/step_share") == 0.0
    assert {name for name, value in metrics.items() if np.isnan(value)} == {
        *("target/R_track", "target/R_reg", "target/R_anti", "target/tracking_reward", "target/lambda_crit"),
    }
    assert metrics["kept/R_track"] == pytest.approx(6.0)
    assert metrics["kept/step_share"] == 1.0


def test_ordinary_training_logs_no_threshold():
    assert metrics_of(Config()) == {}


def test_only_the_anti_reward_is_logged_as_one():
    metrics = metrics_of(forgetting(16.0, method="finetune"))
    assert not {name for name in metrics if "R_anti" in name}
    assert metrics["target/R_track"] == pytest.approx(4.0)
