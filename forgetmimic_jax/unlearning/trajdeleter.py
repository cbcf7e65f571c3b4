"""TrajDeleter (Gong et al. 2024, "TrajDeleter: Enabling Trajectory Forgetting in Offline RL Agents").

Forgetting, 80 % of the budget: equal blocks in turn, one of plain updates on what is kept, one of updates on the
targets with their rewards negated. Convergence, the rest: only what is kept, and the critic's loss gets 0.1 times the
distance to the frozen base's target. Theirs is offline, two data sets and a Q-function (d3rlpy); here both kinds of
steps come from the policy's own rollouts and a block leaves the others' out of the loss, PPO updates stand for theirs,
and V_base(s) stands for the base's one-step target, whose mean it is under the base.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jax import Array

from forgetmimic_jax.ppo.loss import Batch, Prediction, mean, ppo_loss
from forgetmimic_jax.ppo.rule import plain_reward
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.reward import Reward
from forgetmimic_jax.unlearning.method import Method

BLOCKS = 32  # of the forgetting phase, give or take its last ones: a block is a whole number of iterations
FORGETTING, DISTANCE = 0.8, 0.1


def negated_on_targets(config: Config, reward: Reward, is_target: Array, key: Array) -> Array:
    """R' [env] = −R on target steps, R elsewhere."""
    return jnp.where(is_target, -1.0, 1.0) * plain_reward(config, reward, is_target, key)


def in_two_phases(config: Config, batch: Batch, now: Prediction, iteration: Array) -> tuple[Array, dict[str, Array]]:
    """The PPO loss on the steps of this block; in the second phase with the distance to the base's value."""
    assert batch.base is not None
    forgetting = iteration < FORGETTING * config.iterations
    block = max(1, round(FORGETTING * config.iterations / BLOCKS))
    on_targets = forgetting & (iteration // block % 2 == 1)
    in_block = jnp.where(on_targets, batch.is_target, ~batch.is_target)
    weight = batch.weight * in_block
    loss, metrics = ppo_loss(config, dataclasses.replace(batch, weight=weight), now)
    distance = mean((now.value - batch.base.value) ** 2, weight)
    loss += jnp.where(forgetting, 0.0, config.ppo.value_cost * DISTANCE) * distance
    return loss, metrics | {"base_value_distance": distance}


METHOD = Method(reward=negated_on_targets, loss=in_two_phases)
