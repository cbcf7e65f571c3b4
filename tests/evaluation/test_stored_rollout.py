"""What the shipped bases do does not change unless a change is meant: a short rollout against a stored one.

`python tests/evaluation/test_stored_rollout.py` stores it anew. A change that is meant says why in its commit.
"""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

from forgetmimic_jax.evaluation.rollout import Evaluator, act
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.setup import make_setup
from forgetmimic_jax.training.checkpoint import load_policy, read_info
from forgetmimic_jax.training.start import base_folder

STORED = Path(__file__).with_suffix(".npz")
STEPS = 15


def rollout(robot: str) -> dict[str, np.ndarray]:
    """Positions [step, clip, nq], rewards and the running episodes of the base from each clip's first frame."""
    info = read_info(base_folder(robot))
    config = dataclasses.replace(info.config, physics=dataclasses.replace(info.config.physics, engine="native"))
    setup = make_setup(config)
    evaluator = Evaluator(setup, episodes=1, seed=0)
    env, assets, policy = evaluator._env, evaluator._assets, load_policy(info, setup.robot)

    @jax.jit
    def advance(state):
        action = act(env, policy, tracking.observe(env, assets, state, None)[0])
        return tracking.step(env, assets, state, action, jax.random.PRNGKey(0))

    state, steps = evaluator.start(), []
    for _ in range(STEPS):
        state, result = advance(state)
        steps.append((state.physics.qpos, state.last_action, result.reward.normalized_tracking, result.terminated))
    qpos, action, reward, ended = (np.stack(values) for values in zip(*jax.device_get(steps), strict=True))
    return {f"{robot}_qpos": qpos, f"{robot}_action": action, f"{robot}_reward": reward, f"{robot}_ended": ended}


@pytest.mark.parametrize("robot", ["g1", "h2"])
def test_the_shipped_base_does_what_it_did(robot):
    stored = np.load(STORED)
    for name, found in rollout(robot).items():
        # The tests' compiler flags, and other processors, differ in the last digits, which contacts enlarge.
        np.testing.assert_allclose(found, stored[name], atol=5e-3, err_msg=name)


if __name__ == "__main__":
    np.savez_compressed(STORED, **rollout("g1"), **rollout("h2"))
