"""What an unlearning method may change of PPO. A module of this package with a `METHOD` is one, by its file's name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from jax import Array

from forgetmimic_jax.ppo.loss import Batch, Prediction, ppo_loss
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.reward import Reward


def plain_reward(config: Config, reward: Reward, is_target: Array, key: Array) -> Array:
    """R [env] = R_track + R_reg."""
    return reward.tracking + reward.regularisation


def plain_observation(observation: Array, is_target: Array) -> Array:
    """The actor's observation [env, features] as it is."""
    return observation


@dataclass(frozen=True)
class Method:
    """A training rule as its differences from PPO; without any, PPO fine-tuning of the base on all clips.

    Args:
        reward: (config, the step's parts [env], is_target bool[env], random key) → training reward [env], per second.
        observation: (actor observation [env, features], is_target bool[env]) → what the actor sees in training.
        loss: (config, batch, what the networks say now, iteration i32[]) → the loss [] to minimise and its parts.
        clips: which clips episodes start from, unless the user says otherwise (`sampling.clips`).
        start: from the base with uniform sampling and no wrench; a fresh policy that the base teaches, the same way; or
            a fresh policy with the base's own settings.
        simulate: whether steps are simulated, or reference states with reset noise stand for them.
        result: what evaluation.json calls the policy.
    """

    reward: Callable[[Config, Reward, Array, Array], Array] = plain_reward
    observation: Callable[[Array, Array], Array] = plain_observation
    loss: Callable[[Config, Batch, Prediction, Array], tuple[Array, dict[str, Array]]] = ppo_loss
    clips: Literal["all", "kept"] = "all"
    start: Literal["base", "taught", "fresh"] = "base"
    simulate: bool = True
    result: Literal["unlearned", "retrained", "fine_tuned"] = "unlearned"
