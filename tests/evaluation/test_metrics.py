import dataclasses

import numpy as np
import pytest

from forgetmimic_jax.evaluation.metrics import Rollout, common_length, episode_metrics, ratio, skill


def two_episodes() -> Rollout:
    """Episode 0 falls after 2 of 4 steps; episode 1 survives its 3."""
    return Rollout(
        clip=np.array([0, 1]),
        start_frame=np.array([0, 7]),
        horizon=np.array([4, 3]),
        length=np.array([2, 3]),
        tracking_reward=np.array([[0.8, 0.4, 99.0, np.nan], [0.9, 0.6, 0.3, np.inf]]),
        errors={"mpkpe": np.array([[0.1, 0.3, np.nan, 5.0], [0.2, 0.4, 0.9, -1.0]])},
    )


def test_numbers_of_each_episode_by_hand():
    numbers = episode_metrics(two_episodes())
    np.testing.assert_allclose(numbers["tracking_reward"], [1.2 / 2, 1.8 / 3])
    np.testing.assert_allclose(numbers["survival_weighted_tracking"], [1.2 / 4, 1.8 / 3])
    np.testing.assert_array_equal(numbers["success_rate"], [0.0, 1.0])
    np.testing.assert_array_equal(numbers["episode_length"], [2.0, 3.0])
    np.testing.assert_allclose(numbers["mpkpe"], [0.2, 0.5])
    assert not any(name.endswith("_common") for name in numbers)


def test_a_fall_in_the_last_step_is_no_success():
    nearly = dataclasses.replace(two_episodes(), length=np.array([2, 2]))
    np.testing.assert_array_equal(episode_metrics(nearly)["success_rate"], [0.0, 0.0])


def test_errors_on_the_steps_that_every_policy_survives():
    first = two_episodes()
    second = dataclasses.replace(
        first, length=np.array([4, 1]), tracking_reward=np.full((2, 4), 0.5), errors={"mpkpe": np.ones((2, 4))}
    )
    common = common_length([first, second])
    np.testing.assert_array_equal(common, [2, 1])
    np.testing.assert_allclose(episode_metrics(first, common)["mpkpe_common"], [0.2, 0.2])
    np.testing.assert_allclose(episode_metrics(first, common)["mpkpe"], [0.2, 0.5])


def test_steps_after_the_end_have_no_effect():
    rollout = two_episodes()
    alive = np.arange(4) < rollout.length[:, None]
    other = dataclasses.replace(rollout, tracking_reward=np.where(alive, rollout.tracking_reward, -1e30))
    for name, values in episode_metrics(rollout).items():
        np.testing.assert_array_equal(values, episode_metrics(other)[name])


def test_policies_on_other_episodes_are_not_comparable():
    other = dataclasses.replace(two_episodes(), start_frame=np.array([0, 8]))
    with pytest.raises(ValueError, match="start_frame differs"):
        common_length([two_episodes(), other])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"length": np.array([0, 3])}, "1 <= length <= horizon"),
        ({"length": np.array([2, 4])}, "1 <= length <= horizon"),
        ({"horizon": np.array([9, 3])}, "1 <= length <= horizon"),
        ({"clip": np.array([0])}, "clip has shape"),
        ({"errors": {"mpkpe": np.zeros((2, 3))}}, "mpkpe has shape"),
        ({"errors": {"mpkpe": np.full((2, 4), np.nan)}}, "mpkpe is not finite"),
    ],
)
def test_a_rollout_that_cannot_be_right_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(two_episodes(), **change)


def test_skill_is_one_at_the_base_and_zero_at_the_floor():
    np.testing.assert_allclose(skill(np.array([0.9, 0.1, 0.5]), np.array(0.9), np.array(0.1)), [1.0, 0.0, 0.5])
    assert np.isnan(ratio(np.array(1.0), np.array(0.0)))
