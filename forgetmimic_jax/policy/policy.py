"""A policy as one value: actor, critic and their normalisers, with the modules that apply them."""

from __future__ import annotations

import dataclasses
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from forgetmimic_jax.policy.gaussian import MAX_STD, MIN_STD
from forgetmimic_jax.policy.normalizer import Normalizer
from forgetmimic_jax.settings.config import PPOConfig


class MLP(nn.Module):
    """ELU perceptron; the last layer is linear."""

    layers: tuple[int, ...]
    outputs: int
    output_scale: float

    @nn.compact
    def __call__(self, x: Array) -> Array:
        for width in self.layers:
            x = nn.elu(nn.Dense(width, kernel_init=nn.initializers.orthogonal(2**0.5))(x))
        return nn.Dense(self.outputs, kernel_init=nn.initializers.orthogonal(self.output_scale))(x)


class Actor(nn.Module):
    """Mean action [..., joint] and one learnable log standard deviation per action dimension [joint]."""

    layers: tuple[int, ...]
    actions: int
    initial_std: float

    @nn.compact
    def __call__(self, observation: Array) -> tuple[Array, Array]:
        mean = MLP(self.layers, self.actions, output_scale=0.01)(observation)
        log_std = self.param("log_std", nn.initializers.constant(jnp.log(self.initial_std)), (self.actions,))
        return mean, log_std


class Critic(nn.Module):
    """Value [...] of a privileged observation."""

    layers: tuple[int, ...]

    @nn.compact
    def __call__(self, observation: Array) -> Array:
        return MLP(self.layers, 1, output_scale=1.0)(observation)[..., 0]


@struct.dataclass
class Policy:
    """What goes from one run to another: the networks and their normalisers.

    The modules are static: they say how the parameters are applied, and are no part of the saved tree. Observations
    come as the environment gives them; the policy normalises them itself.
    """

    actor: Any
    critic: Any
    actor_normalizer: Normalizer
    critic_normalizer: Normalizer
    actor_module: Actor = struct.field(pytree_node=False)
    critic_module: Critic = struct.field(pytree_node=False)

    def distribution(self, observation: Array) -> tuple[Array, Array]:
        """Mean action [..., joint] and log standard deviation [joint] at an actor observation [..., features]."""
        mean_and_log_std: Any = self.actor_module.apply(self.actor, self.actor_normalizer(observation))
        return mean_and_log_std

    def mean_action(self, observation: Array) -> Array:
        """The deterministic action [..., joint] at an actor observation [..., features]."""
        return self.distribution(observation)[0]

    def value(self, observation: Array) -> Array:
        """V [...] at a critic observation [..., features]."""
        result: Any = self.critic_module.apply(self.critic, self.critic_normalizer(observation))
        return result

    @property
    def log_std(self) -> Array:
        """Log standard deviation [joint] of the exploration noise."""
        return self.actor["params"]["log_std"]

    @property
    def parameters(self) -> tuple[Any, Any]:
        """What a gradient step changes: the actor's and the critic's parameters."""
        return self.actor, self.critic

    def with_parameters(self, parameters: tuple[Any, Any]) -> Policy:
        """The policy with other parameters of actor and critic."""
        return dataclasses.replace(self, actor=parameters[0], critic=parameters[1])


def init_policy(config: PPOConfig, num_joints: int, actor_size: int, critic_size: int, key: Array) -> Policy:
    """Random networks and empty normalisers.

    Args:
        config: sizes of the hidden layers and the initial exploration noise.
        num_joints: actions.
        actor_size: numbers in an actor observation.
        critic_size: numbers in a critic observation.
        key: random key.
    """
    actor = Actor(config.actor_layers, num_joints, config.initial_std)
    critic = Critic(config.critic_layers)
    actor_key, critic_key = jax.random.split(key)
    return Policy(
        actor=actor.init(actor_key, jnp.zeros((1, actor_size))),
        critic=critic.init(critic_key, jnp.zeros((1, critic_size))),
        actor_normalizer=Normalizer.create(actor_size),
        critic_normalizer=Normalizer.create(critic_size),
        actor_module=actor,
        critic_module=critic,
    )


def bound_std(parameters: Any) -> Any:
    """Actor parameters with the standard deviation in [MIN_STD, MAX_STD].

    After a gradient step, not inside the network: there a clip would leave what lies outside without a gradient back.
    """
    log_std = jnp.clip(parameters["params"]["log_std"], jnp.log(MIN_STD), jnp.log(MAX_STD))
    return {**parameters, "params": {**parameters["params"], "log_std": log_std}}
