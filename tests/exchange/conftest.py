import dataclasses

import jax
import jax.numpy as jnp
import pytest

from forgetmimic_jax.policy.normalizer import Normalizer
from forgetmimic_jax.policy.policy import Policy, init_policy
from forgetmimic_jax.tracking.layouts import LAYOUTS


@pytest.fixture(scope="session")
def policy(robot, tiny_config) -> Policy:
    """An invented policy whose actions are not small and whose normaliser is not the identity."""
    size = LAYOUTS["wbc132"].size(robot.num_joints)
    policy = init_policy(tiny_config.ppo, robot.num_joints, size, 20, jax.random.PRNGKey(1))
    keys = jax.random.split(jax.random.PRNGKey(2), 3)
    actor = jax.tree.map(lambda x: x + 0.1 * jax.random.normal(keys[0], x.shape), policy.actor)
    normalizer = Normalizer(
        mean=jax.random.normal(keys[1], (size,)),
        variance=jnp.exp(jax.random.normal(keys[2], (size,))),
        count=jnp.float32(1000.0),
    )
    return dataclasses.replace(policy, actor=actor, actor_normalizer=normalizer)
