"""A run: iterate, log, checkpoint, stop and resume. Training and unlearning are both this."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import jax
import numpy as np
from rich.console import Console

from forgetmimic_jax.basics.console import command_line, say
from forgetmimic_jax.basics.console import progress as progress_bar
from forgetmimic_jax.basics.errors import Interrupted
from forgetmimic_jax.basics.signals import stop_requests
from forgetmimic_jax.ppo.rule import Rule
from forgetmimic_jax.ppo.state import TrainState
from forgetmimic_jax.ppo.update import make_iteration
from forgetmimic_jax.settings.config import Config, save_config
from forgetmimic_jax.tracking.env import make_assets, make_environment
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.checkpoint import Progress, checkpoints, newest_checkpoint
from forgetmimic_jax.training.course import MakeCourse, Plain, Position
from forgetmimic_jax.training.devices import (
    anywhere,
    gathered,
    is_of_xla,
    leave,
    local,
    mesh_of,
    shard_environment,
    share,
    spread,
)
from forgetmimic_jax.training.folder import prepare_folder
from forgetmimic_jax.training.log import Log
from forgetmimic_jax.training.start import another_machine, saved_state, start_state, steps_before, unlearned_base
from forgetmimic_jax.unlearning.registry import method_of

KEEP = 2  # newest checkpoints kept beside the named ones
LOG_EVERY = 10  # iterations averaged into one row of metrics.jsonl; the first has a row of its own


def run(
    setup: Setup,
    directory: Path,
    *,
    description: str,
    resume: bool = False,
    make_course: MakeCourse = Plain,
    rule: Rule | None = None,
) -> tuple[Path, TrainState]:
    """Train until `config.iterations`, or until the course is finished; returns the last checkpoint and the state.

    The rule is the method's, unless another is given.

    The folder gets config.yaml, metrics.jsonl (means over LOG_EVERY iterations), TensorBoard events and checkpoints/,
    the first of them before the first iteration, so that a run that is killed can always continue. With
    `config.evaluate_every` also evaluations.jsonl, its picture evaluations.png, and best/, the policy with the best
    mean survival-weighted tracking of the clips to keep. Ctrl-C and SIGTERM end the current iteration, save, and raise
    Interrupted.
    """
    config = setup.config
    base = unlearned_base(config)
    newest = prepare_folder(directory, resume=resume)
    rule, assets = rule or method_of(config), make_assets(setup)
    env = make_environment(setup, config.ppo.num_envs, runs_on=rule.runs_on, replace_reference=rule.replace_reference)
    if newest is None:
        now = Position(start_state(setup, env, assets), assets, 0, steps_before(config))
    else:
        state, environment_steps = saved_state(setup, env, assets, newest)
        now = Position(state, assets, int(state.iteration), environment_steps)
    mesh = mesh_of(config.devices)
    iterate = make_iteration(shard_environment(mesh, setup, env), rule, mesh)
    directory.mkdir(parents=True, exist_ok=True)
    console = Console()
    if newest and (difference := another_machine(newest, config.devices)):
        say(difference, console)
    course = make_course(setup, env, directory, console, checkpoint.read_info(newest) if newest else None)
    at_most = config.unlearn.stop_every > 0
    saved, stopped = newest, False

    def course_after(step: Callable[[Position], Position]) -> Position:
        """Where a step of the course leads from here; the course sees what is on this process's first device."""
        seen = dataclasses.replace(now, state=local(mesh, now.state))
        then = step(seen)
        state = now.state if then.state is seen.state else spread(mesh, then.state)
        return dataclasses.replace(then, state=state, assets=share(mesh, then.assets))

    def save() -> Path:
        # A row never spans a checkpoint: what is resumed has all of its rows in the file.
        log.write(now.iteration, now.environment_steps, setup.library.names, course.note)
        path = directory / "checkpoints" / f"{now.iteration:08d}"
        progress = Progress(now.iteration, now.environment_steps, base, course.curriculum)
        checkpoint.save_checkpoint(path, setup, gathered(now.state), progress)
        for old in checkpoints(directory)[:-KEEP]:
            shutil.rmtree(old)
        return path

    try:
        save_config(config, directory / "config.yaml")
        with (
            Log(directory, now.iteration, now.environment_steps) as log,
            stop_requests() as stop,
            progress_bar(description, config.iterations, start=now.iteration, at_most=at_most, console=console) as show,
        ):
            now = dataclasses.replace(now, state=spread(mesh, now.state))
            now = course_after(course.begin)
            saved = saved or save()
            while now.iteration < config.iterations and not course.finished:
                stopped = anywhere(bool(stop))
                if stopped:
                    break
                state, metrics = iterate(now.assets, now.state)
                metrics = jax.device_get(metrics)
                steps = now.environment_steps + config.ppo.num_envs * config.ppo.num_steps
                now = Position(state, now.assets, now.iteration + 1, steps)
                log.add(metrics)
                if now.iteration == 1 or now.iteration % LOG_EVERY == 0:
                    log.write(now.iteration, steps, setup.library.names, course.note)
                show(now.iteration, steps, _live(metrics))
                now = course_after(course.after)
                if now.iteration % config.checkpoint_every == 0:
                    saved = save()  # after the evaluation, which a run that is resumed from here does not make again
            if int(saved.name) != now.iteration:
                saved = save()
    except BaseException as error:
        if saved is None:
            shutil.rmtree(directory, ignore_errors=True)  # nothing in it to continue with
        elif isinstance(error, KeyboardInterrupt):
            raise interrupted(config, directory, course.command) from None
        elif jax.process_count() > 1 and is_of_xla(error):
            why = str(error).partition("\n")[0]
            leave(f"error: {why}; if another process has ended, start all of them again with --resume")
        elif isinstance(error, OSError) and error.filename is None:
            error.filename = str(directory)  # a full disk does not say where
        raise
    if stop or stopped:
        raise interrupted(config, directory, course.command)
    state = local(mesh, now.state)
    # On the host: on a device of the mesh, what was compiled for other policies would be compiled again for this one.
    return saved, dataclasses.replace(state, policy=jax.device_get(state.policy)) if mesh else state


def interrupted(config: Config, directory: Path, command: str) -> Interrupted:
    """What a stopped run says at its end: what it saved, and the command that continues it."""
    if jax.process_index() > 0:
        return Interrupted("stopped with the first process, which saved")
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
