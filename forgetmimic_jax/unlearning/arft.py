"""Anti-reward fine-tuning, the paper's method ("ForgetMimic", equation of R_anti): tracking a target clip costs.

R' = R_track + R_reg − λ r̄ on steps of a target clip, so R'_target = (1 − λ/W) R_track + R_reg. Nothing else changes.
"""

from __future__ import annotations

from jax import Array

from forgetmimic_jax.ppo.rule import plain_reward
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.reward import Reward
from forgetmimic_jax.unlearning.method import STOP_EVERY, Method


def anti_reward(config: Config, reward: Reward, is_target: Array, key: Array) -> Array:
    """R' [env] = R_track + R_reg − λ r̄ on target steps; R_track + R_reg elsewhere."""
    penalty = config.unlearn.settings["penalty"]
    return plain_reward(config, reward, is_target, key) - penalty * reward.normalized_tracking * is_target


# λ; W = 8 is the edge of the paper's algebra.
METHOD = Method(reward=anti_reward, settings={"penalty": 16.0}, stop_every=STOP_EVERY)
