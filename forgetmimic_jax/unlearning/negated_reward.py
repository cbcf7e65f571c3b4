"""A negative reward that reaches every motion: what the paper describes under the name of Ye et al. (2023).

R' = −(R_track + R_reg) on all steps. Humanoid control has one environment, so a penalty on "the environment" does not
tell targets from kept clips: the paper explains that baseline's collapse by this. `decremental` and `poisoning` are
what Ye et al. propose.
"""

from __future__ import annotations

from jax import Array

from forgetmimic_jax.ppo.rule import plain_reward
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.reward import Reward
from forgetmimic_jax.unlearning.method import STOP_EVERY, Method


def negated(config: Config, reward: Reward, is_target: Array, key: Array) -> Array:
    """R' [env] = −(R_track + R_reg)."""
    return -plain_reward(config, reward, is_target, key)


METHOD = Method(reward=negated, stop_every=STOP_EVERY)
