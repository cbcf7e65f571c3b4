"""A policy for the tests of the exchange."""

import dataclasses

import jax
import jax.numpy as jnp

from forgetmimic_jax.policy.normalizer import Normalizer
from forgetmimic_jax.policy.policy import Policy, init_policy
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.layouts import LAYOUTS


def invented_policy(config: Config) -> Policy:
    """A policy of the G1 whose actions are not small and whose normaliser is not the identity."""
    size = LAYOUTS[config.observation.layout].size(29)
    policy = init_policy(config.ppo, 29, size, 20, jax.random.PRNGKey(1))
    keys = jax.random.split(jax.random.PRNGKey(2), 3)
    actor = jax.tree.map(lambda x: x + 0.1 * jax.random.normal(keys[0], x.shape), policy.actor)
    normalizer = Normalizer(
        mean=jax.random.normal(keys[1], (size,)),
        variance=jnp.exp(jax.random.normal(keys[2], (size,))),
        count=jnp.float32(1000.0),
    )
    return dataclasses.replace(policy, actor=actor, actor_normalizer=normalizer)
