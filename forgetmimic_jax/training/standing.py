"""Who teaches the method `stand`: the base asked to stand, where it stays upright, or what training makes of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from rich.console import Console

from forgetmimic_jax.basics.errors import InputError, Interrupted
from forgetmimic_jax.evaluation.metrics import HOLD_SECONDS
from forgetmimic_jax.evaluation.rollout import Evaluator
from forgetmimic_jax.motion.library import only_clips
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.ppo.rule import Rule
from forgetmimic_jax.settings.config import load_config
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.tracking.stand import STAND
from forgetmimic_jax.training.checkpoint import CONFIG, newest_checkpoint
from forgetmimic_jax.training.devices import agreed
from forgetmimic_jax.training.run import run

EPISODES = 20  # a target
ENOUGH = 0.95  # upright rate of a base that needs no training
ASKED = Rule(runs_on=HOLD_SECONDS, asked=True)  # PPO; the reference of a target is the stand, only a fall ends it
# The teacher needs none of the clips any more: nothing holds it near the base.
LEARNING = {"minibatches": 4, "epochs": 4, "base_kl": 0.0, "equal_clips": False}


def upright_when_asked(setup: Setup, policy: Policy) -> float:
    """Share of the episodes without a fall, in which a policy is asked to stand from the states of the targets.

    They start as those of an evaluation do: half at frame 0, half spread over the clip.
    """
    targets = dataclasses.replace(setup, library=only_clips(setup.library, setup.config.unlearn.targets))
    rollout = Evaluator(targets, episodes=EPISODES, seed=setup.config.seed, rule=ASKED).rollout(policy)
    return agreed(float((rollout.length == rollout.horizon).mean()))


def standing_teacher(setup: Setup, directory: Path) -> Policy:
    """The base, if it stays upright where it is asked to stand; else the base after training on that.

    The training is PPO from the base. Its episodes start from the states of the targets, their reference is the stand,
    and only a fall ends them early. Its folder is `directory` with `-stand` at the end. One that is there already
    continues.

    Raises:
        InputError: the folder is of a run with other settings.
        Interrupted: Ctrl-C during the training.
    """
    assert setup.base is not None
    console, upright = Console(), upright_when_asked(setup, setup.base)
    said = f"asked to stand in the middle of a target, the base stays upright in {upright:.0%} of the episodes"
    if upright >= ENOUGH:
        console.print(said, highlight=False, soft_wrap=True)
        return setup.base
    console.print(f"{said}: it learns that first", highlight=False, soft_wrap=True)
    learning = _learning(setup)
    folder = directory.with_name(f"{directory.name}-{STAND}")
    resume = newest_checkpoint(folder) is not None
    devices = learning.config.devices  # another number of them continues too
    if resume and dataclasses.replace(load_config(folder / CONFIG), devices=devices) != learning.config:
        raise InputError(f"{folder}: is of a run with other settings; remove it, or choose another --output")
    try:
        _, state = run(learning, folder, description="learn to stand", resume=resume, rule=ASKED)
    except Interrupted:
        text = f"stopped while the base learned to stand; saved {folder}; the same command continues"
        raise Interrupted(text) from None
    console.print(f"now it does in {upright_when_asked(setup, state.policy):.0%}", highlight=False)
    return state.policy


def _learning(setup: Setup) -> Setup:
    """The setup of the training: all starts are those of the targets."""
    config = setup.config
    return dataclasses.replace(
        setup,
        config=dataclasses.replace(
            config,
            iterations=round(config.unlearn.settings["stand_iterations"]),
            ppo=dataclasses.replace(config.ppo, **LEARNING),
            sampling=dataclasses.replace(config.sampling, clips="all", target_share=1.0),
        ),
    )
