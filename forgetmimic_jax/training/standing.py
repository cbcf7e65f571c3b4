"""The teacher of the method `stand`: the base, where it stays upright, or the base after training to stand."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from forgetmimic_jax.basics.console import say
from forgetmimic_jax.basics.errors import Interrupted
from forgetmimic_jax.evaluation.metrics import HOLD_SECONDS
from forgetmimic_jax.evaluation.rollout import Evaluator
from forgetmimic_jax.motion.library import only_clips
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.ppo.rule import Rule
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.tracking.stand import STAND
from forgetmimic_jax.training.checkpoint import newest_checkpoint
from forgetmimic_jax.training.devices import agreed
from forgetmimic_jax.training.folder import config_there
from forgetmimic_jax.training.run import run

EPISODES = 20  # a target
ENOUGH = 0.95  # upright rate of a base that needs no training
TAUGHT = 0.92  # upright rate after the training; below it the training goes on
LONGER = 1.5  # times the iterations, at most
# PPO; the reference of a target clip is the stand, and only a fall terminates an episode.
STANDING = Rule(runs_on=HOLD_SECONDS, replace_reference=True)
# The teacher needs no clip any more, so it has no KL to the base.
LEARNING: dict[str, Any] = {"minibatches": 4, "epochs": 4, "learning_rate": 3e-4, "base_kl": 0.0, "equal_clips": False}
SECONDS = 2.0  # an episode: a robot that falls does so early, and short episodes have more starts
# A robot falls from a few frames of a clip, such as the swing of a kick: narrow bins, which have few episodes each, and
# most starts by failure. A user starts a clip at its first frame.
STARTS: dict[str, Any] = {
    "rule": "adaptive",
    "clips": "all",
    "target_share": 1.0,
    "bin_seconds": 0.3,
    "uniform_ratio": 0.1,
    "smoothing": 0.05,
    "first_frame": 0.5,
}
LATER = {"first_frame": 0.2}  # of the iterations beyond the first: by then the first frames are learned


def longest(iterations: float) -> int:
    """The most iterations of a training that is asked for `iterations`."""
    return round(LONGER * iterations)


def upright_rate(setup: Setup, policy: Policy) -> float:
    """Share of the episodes without a fall. They start in the target clips, and their reference is the stand.

    Half of them start at frame 0, half are spread over the clip, as in an evaluation.
    """
    targets = dataclasses.replace(setup, library=only_clips(setup.library, setup.config.unlearn.targets))
    rollout = Evaluator(targets, episodes=EPISODES, seed=setup.config.seed, rule=STANDING).rollout(policy)
    return agreed(float((rollout.length == rollout.horizon).mean()))


def standing_teacher(setup: Setup, directory: Path) -> Policy:
    """The base, if it stays upright with the stand as its reference; else the base after training on that.

    The training is PPO from the base. Its episodes start in the target clips, their reference is the stand, and only a
    fall terminates them. It goes on for half as many iterations where the policy still falls too often. Its folder is
    `directory` with `-stand` at the end. One that is there already continues.

    Raises:
        InputError: the folder is of a run with other settings.
        Interrupted: Ctrl-C during the training.
    """
    assert setup.base is not None
    upright = upright_rate(setup, setup.base)
    said = f"with the stand as the reference, the base stays upright in {upright:.0%} of the targets' episodes"
    if upright >= ENOUGH:
        say(said)
        return setup.base
    say(f"{said}; it learns to stand first")
    iterations = round(setup.config.unlearn.settings["stand_iterations"])
    learning, longer = _learning(setup, iterations), _learning(setup, longest(iterations), **LATER)
    folder = directory.with_name(f"{directory.name}-{STAND}")
    resume = newest_checkpoint(folder) is not None
    if resume:
        found = config_there(folder, learning.config, longer.config)
        learning = longer if found == longer.config else learning
    try:
        _, state = run(learning, folder, description="learn to stand", resume=resume, rule=STANDING)
        upright = upright_rate(setup, state.policy)
        if upright < TAUGHT and learning is not longer:
            say(f"it stays upright in {upright:.0%} now; it goes on for half as many iterations")
            _, state = run(longer, folder, description="learn to stand", resume=True, rule=STANDING)
            upright = upright_rate(setup, state.policy)
    except Interrupted:
        text = f"stopped while the base learned to stand; saved {folder}; the same command continues"
        raise Interrupted(text) from None
    say(f"after training it stays upright in {upright:.0%}")
    return state.policy


def _learning(setup: Setup, iterations: int, **starts: float) -> Setup:
    """The setup of the training: all starts are in the targets, more of them where it fails."""
    config = setup.config
    return dataclasses.replace(
        setup,
        config=dataclasses.replace(
            config,
            iterations=iterations,
            ppo=dataclasses.replace(config.ppo, **LEARNING),
            sampling=dataclasses.replace(config.sampling, **STARTS | starts),
            max_episode_steps=min(config.max_episode_steps, round(SECONDS / config.physics.control_step)),
        ),
    )
