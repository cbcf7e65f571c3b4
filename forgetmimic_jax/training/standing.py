"""Whether a base can stand, and the training that teaches one that cannot: what the method `stand` needs first."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from rich.console import Console

from forgetmimic_jax.basics.errors import InputError, Interrupted
from forgetmimic_jax.evaluation.rollout import Evaluator
from forgetmimic_jax.motion.library import MotionLibrary, together
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.settings.config import UnlearnConfig, load_config
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.tracking.stand import STAND, stand_library
from forgetmimic_jax.training.checkpoint import CONFIG, newest_checkpoint
from forgetmimic_jax.training.devices import agreed
from forgetmimic_jax.training.run import run

SECONDS = 5.0  # of the stand
EPISODES = 20
ENOUGH = 0.75  # success on the stand of a base that needs no training for it


def stand_success(setup: Setup, policy: Policy | None) -> float:
    """Share of the episodes, from its start and from its middle, in which a policy completes the stand."""
    config = dataclasses.replace(setup.config, unlearn=UnlearnConfig())
    stand = dataclasses.replace(setup, config=config, library=_stand(setup), instead=None)
    rollout = Evaluator(stand, episodes=EPISODES, seed=setup.config.seed).rollout(policy)
    return agreed(float((rollout.length == rollout.horizon).mean()))


def standing_teacher(setup: Setup, directory: Path) -> Policy:
    """The base, if it stands where its reference is the stand; else the base after training on that reference.

    The training is PPO from the base on all clips and the stand, which has half of the starts, with a KL to the base on
    the clips. Its folder is `directory` with `-stand` at the end. One that is there already continues.

    Raises:
        InputError: the folder is of a run with other settings.
        Interrupted: Ctrl-C during the training.
    """
    assert setup.base is not None
    console, success = Console(), stand_success(setup, setup.base)
    said = f"the base completes {success:.0%} of {EPISODES} episodes of the stand"
    if success >= ENOUGH:
        console.print(said, highlight=False)
        return setup.base
    console.print(f"{said}: it learns to stand first", highlight=False)
    learning = _learning(setup)
    folder = directory.with_name(f"{directory.name}-{STAND}")
    resume = newest_checkpoint(folder) is not None
    devices = learning.config.devices  # another number of them continues too
    if resume and dataclasses.replace(load_config(folder / CONFIG), devices=devices) != learning.config:
        raise InputError(f"{folder}: is of a run with other settings; remove it, or choose another --output")
    try:
        _, state = run(learning, folder, description="learn to stand", resume=resume)
    except Interrupted:
        text = f"stopped while the base learned to stand; saved {folder}; the same command continues"
        raise Interrupted(text) from None
    console.print(f"now it completes {stand_success(setup, state.policy):.0%} of them", highlight=False)
    return state.policy


def _learning(setup: Setup) -> Setup:
    """The setup of the training: fine-tuning on all clips and the stand, which is the clip with half of the starts."""
    config = setup.config
    iterations = round(config.unlearn.settings["stand_iterations"])
    return dataclasses.replace(
        setup,
        config=dataclasses.replace(
            config,
            iterations=iterations,
            unlearn=UnlearnConfig((STAND,), method="finetune"),
            sampling=dataclasses.replace(config.sampling, clips="all", target_share=0.5),
        ),
        library=together(setup.library, _stand(setup)),
        library_hash=f"{setup.library_hash}+{STAND}",
        instead=None,
    )


def _stand(setup: Setup) -> MotionLibrary:
    step = setup.config.physics.control_step
    return stand_library(setup.robot, frames=round(SECONDS / step) + 1, fps=1.0 / step)
