import dataclasses

import numpy as np
import pytest

from forgetmimic_jax.evaluation.rollout import Evaluator
from forgetmimic_jax.exchange.closed_loop import run_episodes
from forgetmimic_jax.exchange.onnx_actor import OnnxActor, to_onnx
from forgetmimic_jax.tracking import env as tracking


@pytest.fixture(scope="module")
def evaluator(tiny_setup) -> Evaluator:
    return Evaluator(tiny_setup, episodes=2, seed=0)


@pytest.fixture(scope="module")
def gentle(policy):
    """The invented policy with a tenth of its actions: the robot stays up for a while."""
    actor = {"params": {"log_std": policy.actor["params"]["log_std"], "MLP_0": dict(policy.actor["params"]["MLP_0"])}}
    last = actor["params"]["MLP_0"]["Dense_2"]
    actor["params"]["MLP_0"]["Dense_2"] = {name: 0.1 * value for name, value in last.items()}
    return dataclasses.replace(policy, actor=actor)


@pytest.fixture(scope="module")
def record(evaluator, gentle, robot, library, tiny_config):
    model = to_onnx(gentle, robot, tiny_config, run_path="")
    return run_episodes(OnnxActor(model.SerializeToString()), robot, library, evaluator.config, evaluator.start())


def test_the_robot_fares_as_in_the_evaluation(record, evaluator, gentle):
    expected, found = evaluator.rollout(gentle), record.rollout
    for field in ("clip", "start_frame", "horizon"):
        np.testing.assert_array_equal(getattr(found, field), getattr(expected, field))
    assert (expected.length < expected.horizon).any()
    np.testing.assert_array_equal(found.length, expected.length)
    for episode, length in enumerate(expected.length):
        np.testing.assert_allclose(
            found.tracking_reward[episode, :length], expected.tracking_reward[episode, :length], atol=1e-4
        )


def test_the_policy_sees_what_the_environment_shows(record, evaluator):
    # The environment's own observation of the first frame, whose terms other tests work out by hand.
    start = evaluator.start()
    expected = np.asarray(tracking.observe(evaluator._env, evaluator._assets, start, None)[0])
    first = np.cumsum(record.rollout.horizon) - record.rollout.horizon
    np.testing.assert_allclose(record.observations[first], expected, atol=1e-5)


def test_every_step_to_the_horizon_is_recorded(record):
    assert len(record.observations) == len(record.actions) == record.rollout.horizon.sum()
    np.testing.assert_array_equal(record.observations[1:, -29:][:10], record.actions[:10])  # the last action


def test_progress_is_told_after_each_episode(evaluator, gentle, robot, library, tiny_config):
    message = []
    actor = OnnxActor(to_onnx(gentle, robot, tiny_config, run_path="").SerializeToString())
    start = evaluator.start()
    short = dataclasses.replace(start, horizon=np.full(4, 3))
    run_episodes(actor, robot, library, evaluator.config, short, report=lambda *done: message.append(done))
    assert message == [(1, 3), (2, 6), (3, 9), (4, 12)]
