"""Random reward on target steps (paper, baseline 2; Gong et al. 2024 have the same baseline offline).

R' is drawn anew for every target step, uniformly from 0 to W + the survival reward: the range of the base's reward,
without the small penalties. Kept steps have the plain reward. Offline the rewards of a data set are replaced once; here
every step is new, so the noise has the same mean whatever the policy does, and what remains of it is a survival bonus.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from forgetmimic_jax.ppo.rule import plain_reward
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.reward import Reward, total_tracking_weight
from forgetmimic_jax.unlearning.method import STOP_EVERY, Method


def random_on_targets(config: Config, reward: Reward, is_target: Array, key: Array) -> Array:
    """R' [env] ~ U(0, W + survival) on target steps, R elsewhere."""
    largest = total_tracking_weight(config.reward) + config.reward.survival
    noise = jax.random.uniform(key, is_target.shape, maxval=largest)
    return jnp.where(is_target, noise, plain_reward(config, reward, is_target, key))


METHOD = Method(reward=random_on_targets, stop_every=STOP_EVERY)
