"""Every method trains a policy of every layout: an iteration is traced, which is where sizes would not fit."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from forgetmimic_jax.ppo.state import init_state
from forgetmimic_jax.ppo.update import make_iteration
from forgetmimic_jax.settings.config import ActionConfig, ObservationConfig, UnlearnConfig
from forgetmimic_jax.tracking.env import make_assets, make_environment
from forgetmimic_jax.tracking.layouts import LAYOUTS
from forgetmimic_jax.tracking.setup import Setup, instead_of_targets
from forgetmimic_jax.unlearning.registry import find_method, methods, unlearning_config


@pytest.fixture(scope="module", params=LAYOUTS)
def run(request, robot, library, tiny_config):
    """A noisy run of a layout, with its environment, its assets and the shapes of its state; the base is a policy of
    the same shapes."""
    config = dataclasses.replace(
        tiny_config,
        observation=ObservationConfig(request.param),
        action=ActionConfig("offset" if request.param.startswith("mjlab") else "residual"),
        noise=dataclasses.replace(tiny_config.noise, enabled=True),
    )
    setup = Setup(config, robot, library, "invented")
    env, assets = make_environment(setup, config.ppo.num_envs), make_assets(setup)
    state = jax.eval_shape(lambda: init_state(env, assets, jax.random.PRNGKey(0)))
    assets = dataclasses.replace(assets, is_target=jnp.array([False, True]))
    return env, assets, state


@pytest.mark.parametrize("name", methods())
def test_a_method_trains_a_policy_of_the_layout(run, name):
    env, assets, state = run
    config = unlearning_config(env.config, UnlearnConfig(targets=("turn",), method=name))
    env = dataclasses.replace(env, config=config, runs_on=round(find_method(name).runs_on / env.control_step))
    assets = dataclasses.replace(assets, instead=instead_of_targets(config, env.robot, assets.library))
    # jit takes the base as an argument, so that its shapes are enough.
    iterate = make_iteration(env, find_method(name))
    assets = jax.eval_shape(lambda: assets)
    assets = dataclasses.replace(assets, base=state.policy, teacher=state.policy)
    after, metrics = jax.eval_shape(iterate, assets, state)
    assert jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), after) == jax.tree.map(
        lambda leaf: (leaf.shape, leaf.dtype), state
    )
    size = LAYOUTS[config.observation.layout].size(29)
    assert after.policy.actor_normalizer.mean.shape == (size,)
    assert metrics["policy_loss"].shape == ()
