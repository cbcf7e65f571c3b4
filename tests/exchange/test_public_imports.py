"""The public policies through the import: their figures, and joint targets of loops of their own (tests/loops.py)."""

import numpy as np
import pytest
from loops import from_config_yaml, from_deploy_yaml, from_metadata, in_its_own_loop, in_the_environment

from forgetmimic_jax.exchange.adopt import adopt, own_setup
from forgetmimic_jax.exchange.foreign import PolicyReading, read_policy
from forgetmimic_jax.exchange.imported import with_actor
from forgetmimic_jax.motion.readers import read_motion
from forgetmimic_jax.motion.recording import Reading
from forgetmimic_jax.tracking.env import make_assets
from forgetmimic_jax.training.start import fresh_policy

STEPS = 50
# Mean absolute joint error in rad and mean reward while alive that plain MuJoCo gives from frame 0, and seconds.
FIGURES = {"spinkick": (0.126, 0.914, 4.62), "dance": (0.058, 0.986, 29.12)}


@pytest.fixture(scope="module")
def files(public_policies):
    return {
        "spinkick": public_policies / "mjlab_spinkick" / "spinkick_safe.onnx",
        "dance": public_policies / "unitree_rl_lab_dance_102" / "policy.onnx",
        "wbc": public_policies / "wbc_39eff8a" / "policy.onnx",
    }


@pytest.mark.parametrize("name", FIGURES)
def test_survival_reward_and_joint_error_are_those_of_plain_mujoco(name, files, robot, tiny_config):
    foreign = read_policy(files[name], robot, 0.02, PolicyReading())
    (found,) = adopt(foreign, tiny_config, std=0.4, episodes=20, seed=0).trial.clips.values()
    error, reward, seconds = FIGURES[name]
    assert found.seconds == found.horizon == pytest.approx(seconds, abs=0.01)
    assert found.survival >= 0.95
    for reached in (found.joint_error, found.noisy_joint_error):
        assert reached == pytest.approx(error, abs=0.01)
    for reached in (found.reward, found.noisy_reward):
        assert reached == pytest.approx(reward, abs=0.01)


@pytest.mark.parametrize("name", [*FIGURES, "wbc"])
def test_joint_targets_are_those_of_the_policys_own_loop(name, files, robot, tiny_config, samples):
    file = files[name]
    deployment = {
        "spinkick": lambda: from_metadata(file),
        "dance": lambda: from_deploy_yaml(file, file.with_name("deploy.yaml"), robot),
        "wbc": lambda: from_config_yaml(file, file.with_name("config.yaml")),
    }[name]()
    foreign = read_policy(file, robot, 0.02, PolicyReading())
    clip = foreign.clip or read_motion(robot, samples / "M_ShortMove12.csv", Reading(fps=60.0)).clip
    setup = own_setup(foreign.config(tiny_config), [clip])
    policy = with_actor(fresh_policy(setup, make_assets(setup)), foreign.actor, 0.4)
    expected = in_its_own_loop(deployment, robot, setup.library, STEPS)
    found = in_the_environment(setup, lambda assets, state, seen: policy.mean_action(seen), STEPS)
    assert np.ptp(expected, axis=0).max() > 0.2
    np.testing.assert_allclose(found[:10], expected[:10], atol=1e-5)
    np.testing.assert_allclose(found, expected, atol=1e-4)  # float32 beside float64, through contacts
