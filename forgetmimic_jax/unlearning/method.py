"""What an unlearning method may change of PPO. A module of this package with a `METHOD` is one, by its file's name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

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
class Pace:
    """How long a method trains by default, and the PPO settings that it trains with.

    Args:
        iterations: by preset; of a preset without a number, as many steps as the base was trained for.
        ppo: settings of the `ppo` section by preset, in the place of the base's own.
        target_share: share of the uniform starts that are the targets', by preset.
    """

    iterations: Mapping[str, int]
    ppo: Mapping[str, Mapping[str, Any]]
    target_share: Mapping[str, float] = field(default_factory=dict)


# On a laptop: short iterations, because forgetting takes some hundred of them whatever their length. Targets would be
# a few steps in a hundred, fewer as they are forgotten, so half of the starts are theirs and clips weigh the same. The
# step size rises and falls, and a KL to the base holds what is kept. Values of targets change sign, which PPO's clip of
# the value would slow.
SHORT: dict[str, Any] = {
    "num_steps": 12,
    "minibatches": 4,
    "epochs": 2,
    "schedule": "trapezoid",
    "learning_rate": 3e-4,
    "clip_value": False,
    "equal_clips": True,
    "anchor": 0.1,
}
FINE_TUNING = Pace({"cpu": 640, "paper": 1000}, {"cpu": SHORT}, {"cpu": 0.5})


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
        penalised: whether the penalty λ (`unlearn.penalty`) is a setting of the method.
        pace: how long it trains and with which PPO settings.
    """

    reward: Callable[[Config, Reward, Array, Array], Array] = plain_reward
    observation: Callable[[Array, Array], Array] = plain_observation
    loss: Callable[[Config, Batch, Prediction, Array], tuple[Array, dict[str, Array]]] = ppo_loss
    clips: Literal["all", "kept"] = "all"
    start: Literal["base", "taught", "fresh"] = "base"
    simulate: bool = True
    result: Literal["unlearned", "retrained", "fine_tuned"] = "unlearned"
    penalised: bool = False
    pace: Pace = FINE_TUNING
