"""A training rule: where a run's reward, observation and loss differ from plain PPO."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from jax import Array

from forgetmimic_jax.ppo.loss import Batch, Prediction, ppo_loss
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.env import Assets, Environment, EnvState
from forgetmimic_jax.tracking.reward import Reward


def plain_reward(config: Config, reward: Reward, is_target: Array, key: Array) -> Array:
    """R [env] = R_track + R_reg."""
    return reward.tracking + reward.regularisation


def plain_observation(config: Config, observation: Array, is_target: Array) -> Array:
    """The actor's observation [env, features] as it is."""
    return observation


@dataclass(frozen=True)
class Rule:
    """The parts of an iteration that an unlearning method may replace; without any, plain PPO.

    Args:
        reward: (config, the step's parts [env], is_target bool[env], random key) → training reward [env], per second.
        observation: (config, actor observation [env, features], is_target bool[env]) → what the actor sees in training.
        loss: (config, batch, what the networks say now, iteration i32[]) → the loss [] to minimise and its parts.
        teach: (environment, assets, running episodes) → the action [env, joint] that a teacher takes there, in the
            policy's order of joints. The loss finds it in the batch's transition.
        runs_on: s that an episode of a target clip lasts after the clip's end; above 0, only a fall terminates it.
        replace_reference: whether the reference of a target clip is replaced by what to do instead of it.
        simulate: whether steps are simulated, or reference states with reset noise stand for them.
    """

    reward: Callable[[Config, Reward, Array, Array], Array] = plain_reward
    observation: Callable[[Config, Array, Array], Array] = plain_observation
    loss: Callable[[Config, Batch, Prediction, Array], tuple[Array, dict[str, Array]]] = ppo_loss
    teach: Callable[[Environment, Assets, EnvState], Array] | None = None
    runs_on: float = 0.0
    replace_reference: bool = False
    simulate: bool = True
