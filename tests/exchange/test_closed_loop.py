"""The exported policy in plain MuJoCo does what it does in the environment, whatever it sees and does."""

import dataclasses

import numpy as np
import pytest
from invented import invented_policy
from orders import isaac_order

from forgetmimic_jax import export
from forgetmimic_jax.evaluation.metrics import Rollout
from forgetmimic_jax.evaluation.rollout import Evaluator
from forgetmimic_jax.exchange.closed_loop import run_episodes
from forgetmimic_jax.exchange.onnx_actor import OnnxActor, to_onnx
from forgetmimic_jax.robot.model import load_robot
from forgetmimic_jax.settings.config import ActionConfig, ObservationConfig
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.setup import Setup

# Layout, action mode, and whether the policy has Isaac Lab's order of joints.
CASES = [
    ("wbc132", "residual", False),
    ("root132", "residual", True),
    ("mjlab160", "offset", True),
    ("mjlab154", "offset", False),
]


@pytest.fixture(scope="module", params=CASES, ids=lambda case: case[0])
def setup(request, tiny_config, robot, library) -> Setup:
    """What a policy brings with it: also another pose, scale and gain than the robot's own."""
    layout, mode, isaac = request.param
    given = {"default_pose": {"left_knee_joint": 0.5}, "scale": {"waist_yaw_joint": 0.3}}
    gains = {"stiffness": {"left_elbow_joint": 10.0}, "damping": {"left_elbow_joint": 1.5}}
    action = ActionConfig(mode, isaac_order(robot) if isaac else (), **given, **gains)
    config = dataclasses.replace(tiny_config, observation=ObservationConfig(layout), action=action)
    return Setup(config, load_robot("g1", action=action), library, library_hash="invented")


@pytest.fixture(scope="module")
def evaluator(setup) -> Evaluator:
    return Evaluator(setup, episodes=2, seed=0)


@pytest.fixture(scope="module")
def gentle(setup):
    """The invented policy with a tenth of its actions: the robot stays up for a while."""
    policy = invented_policy(setup.config)
    actor = {"params": {"log_std": policy.actor["params"]["log_std"], "MLP_0": dict(policy.actor["params"]["MLP_0"])}}
    last = actor["params"]["MLP_0"]["Dense_2"]
    actor["params"]["MLP_0"]["Dense_2"] = {name: 0.1 * value for name, value in last.items()}
    return dataclasses.replace(policy, actor=actor)


@pytest.fixture(scope="module")
def exported(gentle, setup) -> OnnxActor:
    return OnnxActor(to_onnx(gentle, setup.robot, setup.config, run_path="").SerializeToString())


@pytest.fixture(scope="module")
def record(evaluator, exported, robot, library):
    """The robot here is the one of the YAML: what the policy expects of it stands in the file."""
    return run_episodes(exported, robot, library, evaluator.config, evaluator.start())


@pytest.fixture(scope="module")
def expected(evaluator, gentle) -> Rollout:
    return evaluator.rollout(gentle)


def test_an_export_that_has_one_joints_scale_wrong_by_a_tenth_is_distinguished_from_a_right_one(
    record, expected, evaluator, gentle, setup, robot, library
):
    assert export.early_agreement(expected, record.rollout) == 1.0
    model = to_onnx(gentle, setup.robot, setup.config, run_path="")
    (entry,) = [entry for entry in model.metadata_props if entry.key == "action_scale"]
    first, *others = entry.value.split(",")
    entry.value = ",".join([str(1.1 * float(first)), *others])
    wrong = run_episodes(OnnxActor(model.SerializeToString()), robot, library, evaluator.config, evaluator.start())
    assert export.early_agreement(expected, wrong.rollout) < 0.5 < export.EARLY_SHARE


def test_the_robot_fares_as_in_the_evaluation(record, expected):
    found = record.rollout
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


def test_progress_is_message_after_each_episode(evaluator, exported, robot, library):
    message = []
    short = dataclasses.replace(evaluator.start(), horizon=np.full(4, 3))
    run_episodes(exported, robot, library, evaluator.config, short, progress=lambda *done: message.append(done))
    assert message == [(1, 3), (2, 6), (3, 9), (4, 12)]
