"""A run: iterate, log, checkpoint, stop and resume. Training and unlearning are both this."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np
from rich.console import Console

from forgetmimic_jax.basics.console import command_line
from forgetmimic_jax.basics.console import progress as progress_bar
from forgetmimic_jax.basics.errors import Interrupted
from forgetmimic_jax.basics.signals import stop_requests
from forgetmimic_jax.ppo.state import TrainState
from forgetmimic_jax.ppo.update import make_iteration
from forgetmimic_jax.settings.config import Config, save_config
from forgetmimic_jax.tracking.env import make_assets, make_environment
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.checkpoint import Progress, checkpoints, newest_checkpoint
from forgetmimic_jax.training.folder import BEST, prepare_folder
from forgetmimic_jax.training.log import Log
from forgetmimic_jax.training.start import another_machine, base_checkpoint, saved_state, start_state, steps_before
from forgetmimic_jax.training.watch import Watch
from forgetmimic_jax.unlearning.registry import method_of

KEEP = 2  # newest checkpoints kept beside the named ones
LOG_EVERY = 10  # iterations averaged into one row of metrics.jsonl; the first has a row of its own


def run(setup: Setup, directory: Path, *, description: str, resume: bool = False) -> tuple[Path, TrainState]:
    """Train until `config.iterations`; returns the last checkpoint's folder and the state.

    The folder gets config.yaml, metrics.jsonl (means over LOG_EVERY iterations), TensorBoard events and checkpoints/,
    the first of them before the first iteration, so that a run that is killed can always continue. With
    `config.evaluate_every` also evaluations.jsonl, its picture evaluations.png, and best/, the policy with the best
    mean survival-weighted tracking of the clips to keep. Ctrl-C and SIGTERM end the current iteration, save, and raise
    Interrupted.
    """
    config = setup.config
    base = checkpoint.policy_hash(checkpoint.read_info(base_checkpoint(config))) if config.unlearn.targets else None
    newest = prepare_folder(directory, resume=resume)
    env, assets = make_environment(setup, config.ppo.num_envs), make_assets(setup)
    if newest is None:
        state, environment_steps = start_state(setup, env, assets), steps_before(config)
    else:
        state, environment_steps = saved_state(setup, env, assets, newest)
    iteration = int(state.iteration)
    iterate = make_iteration(env, method_of(config))
    directory.mkdir(parents=True, exist_ok=True)
    console = Console()
    if newest and (difference := another_machine(newest)):
        console.print(difference, highlight=False, markup=False, soft_wrap=True)
    saved = newest

    def save() -> Path:
        # A row never spans a checkpoint: what is resumed has all of its rows in the file.
        log.write(iteration, environment_steps, setup.library.names)
        path = directory / "checkpoints" / f"{iteration:08d}"
        checkpoint.save_checkpoint(path, setup, state, Progress(iteration, environment_steps, base))
        for old in checkpoints(directory)[:-KEEP]:
            shutil.rmtree(old)
        return path

    try:
        save_config(config, directory / "config.yaml")
        with (
            Log(directory, iteration, environment_steps) as log,
            stop_requests() as stop,
            progress_bar(description, config.iterations, start=iteration, console=console) as report,
        ):
            watch = Watch(setup, directory, iteration) if config.evaluate_every else None
            saved = saved or save()
            while iteration < config.iterations and not stop:
                state, metrics = iterate(assets, state)
                metrics = jax.device_get(metrics)
                iteration += 1
                environment_steps += config.ppo.num_envs * config.ppo.num_steps
                log.add(metrics)
                if iteration == 1 or iteration % LOG_EVERY == 0:
                    log.write(iteration, environment_steps, setup.library.names)
                report(iteration, environment_steps, _live(metrics))
                if watch and iteration % config.evaluate_every == 0:
                    if watch(state.policy, iteration, environment_steps):
                        progress = Progress(iteration, environment_steps, base)
                        checkpoint.save_policy(directory / BEST, setup, state.policy, state.failure_level, progress)
                    console.print(watch.table())
                if iteration % config.checkpoint_every == 0:
                    saved = save()  # after the evaluation, which a run that is resumed from here does not make again
            if int(saved.name) != iteration:
                saved = save()
    except BaseException as error:
        if saved is None:
            shutil.rmtree(directory, ignore_errors=True)  # nothing in it to continue with
        elif isinstance(error, KeyboardInterrupt):
            raise interrupted(config, directory) from None
        elif isinstance(error, OSError) and error.filename is None:
            error.filename = str(directory)  # a full disk does not say where
        raise
    if stop:
        raise interrupted(config, directory)
    return saved, state


def interrupted(config: Config, directory: Path) -> Interrupted:
    """What a stopped run says at its end: what it saved, and the command that continues it."""
    command = "unlearn" if config.unlearn.targets else "train"
    again = command_line(command, robot=config.robot, resume=True, output=directory)
    return Interrupted(f"stopped; saved {newest_checkpoint(directory)}; continue with: {again}")


LIVE = {
    "episode_length": "episode_length",
    "tracking_reward": "tracking",
    "target/tracking_reward": "target_tracking",
    "kept/tracking_reward": "kept_tracking",
}


def _live(metrics: Mapping[str, np.ndarray]) -> dict[str, float]:
    """The metrics of an iteration that the terminal shows; a group without a step in it has none."""
    shown = {label: float(metrics[name]) for name, label in LIVE.items() if name in metrics}
    return {label: value for label, value in shown.items() if not np.isnan(value)}
