"""Gradient ascent on the targets: the usual first baseline of machine unlearning (Thudi et al. 2022, Jang et al. 2023).

The advantage changes its sign on target steps, and the plain PPO loss is minimised. So the surrogate is ascended on
target steps and descended on kept steps. Supervised ascent has no bound; here the data are the policy's own, and the
clipped ratio bounds the step of each iteration. The critic still learns the true value.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jax import Array

from forgetmimic_jax.ppo.loss import Batch, Prediction, ppo_loss
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.unlearning.method import STOP_EVERY, Method


def ascent(config: Config, batch: Batch, now: Prediction, iteration: Array) -> tuple[Array, dict[str, Array]]:
    """The PPO loss with −Â on target steps."""
    advantage = jnp.where(batch.is_target, -batch.advantage, batch.advantage)
    return ppo_loss(config, dataclasses.replace(batch, advantage=advantage), now)


METHOD = Method(loss=ascent, stop_every=STOP_EVERY)
