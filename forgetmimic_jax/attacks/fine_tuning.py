"""Plain PPO from any policy, on chosen clips: what the attacks that train have in common.

There is no KL to any policy, no penalty and no assistive wrench, and the step size is fixed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.library import build_library
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.ppo.state import init_state
from forgetmimic_jax.ppo.update import make_iteration
from forgetmimic_jax.settings.config import Config, UnlearnConfig
from forgetmimic_jax.tracking.env import make_assets, make_environment
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.unlearning.method import SHORT, Method

TARGET_SHARE = 0.5  # of the starts, where targets are learned: whoever wants them back would do the same

# After an iteration: how many are done, the policy, and the steps that were simulated of each clip. True ends it.
After = Callable[[int, Policy, Mapping[str, float]], bool]


class FineTuning:
    """The training of some clips. Compiled once, used for any number of policies."""

    def __init__(self, setup: Setup, clips: Sequence[Clip]):
        """Load the clips.

        Args:
            setup: robot and settings of the unlearned policy.
            clips: all that any training may start from, at the control rate.
        """
        library = build_library(setup.robot, clips)
        self._setup = dataclasses.replace(setup, config=attack_config(setup.config), library=library, base=None)
        self._env = make_environment(self._setup, self._setup.config.ppo.num_envs)
        self._assets = make_assets(self._setup)
        self._start = jax.jit(lambda assets, key, policy: init_state(self._env, assets, key, policy))
        self._iterate = make_iteration(self._env, Method())

    def train(self, policy: Policy, starts: Mapping[str, float], *, iterations: int, seed: int, after: After) -> Policy:
        """The policy that learned.

        Args:
            policy: to start from; it stays as it is.
            starts: share of the starts of each clip, 1 together.
            iterations: at most.
            seed: of the training.
            after: called after each iteration.
        """
        names = self._setup.library.names
        shares = jnp.asarray([starts.get(name, 0.0) for name in names], jnp.float32)
        assets = dataclasses.replace(self._assets, focus=dataclasses.replace(self._assets.focus, starts=shares))
        # An iteration gives the memory of its state back, so the state has a copy.
        state = self._start(assets, jax.random.PRNGKey(seed), jax.tree.map(jnp.copy, policy))
        for done in range(1, iterations + 1):
            state, metrics = self._iterate(assets, state)
            steps = np.asarray(metrics["clip/steps"])
            if after(done, state.policy, dict(zip(names, steps.tolist(), strict=True))):
                break
        return state.policy


def attack_config(config: Config) -> Config:
    """A run's settings as an attack trains with them: on a laptop those of unlearning, at a fixed step size."""
    pace = {**SHORT, "schedule": "fixed"} if config.preset == "cpu" else {}
    return dataclasses.replace(
        config,
        base=None,
        evaluate_every=0,
        unlearn=UnlearnConfig(),
        sampling=dataclasses.replace(
            config.sampling, rule="uniform_clips", clips="all", target_share=0.0, first_frame=0.0
        ),
        wrench=dataclasses.replace(config.wrench, max_gain=0.0),
        ppo=dataclasses.replace(config.ppo, **{**pace, "base_kl": 0.0}),
    )


def shares(learned: Sequence[str], others: Sequence[str]) -> dict[str, float]:
    """Starts that are divided evenly: `TARGET_SHARE` for the clips to be learned, the rest for the others."""
    share = TARGET_SHARE if learned else 0.0
    found = {name: share / len(learned) for name in learned}
    return found | {name: (1.0 - share) / len(others) for name in others}
