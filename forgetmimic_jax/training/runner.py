"""A run: iterate, log, checkpoint, stop and resume. Training and unlearning are both this."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shutil
import signal
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.proto.summary_pb2 import Summary

from forgetmimic_jax.basics.console import progress
from forgetmimic_jax.basics.errors import InputError, Interrupted, nearest
from forgetmimic_jax.basics.files import drop_rows_after
from forgetmimic_jax.evaluation.watch import Watch
from forgetmimic_jax.motion.library import DATA_DIR, MotionLibrary, library_hash, load_library, read_manifest
from forgetmimic_jax.ppo.state import Policy, TrainState, init_state
from forgetmimic_jax.ppo.update import make_iteration
from forgetmimic_jax.robot.model import Robot, load_robot, roles_file
from forgetmimic_jax.settings.config import Config, save_config, validate
from forgetmimic_jax.tracking.env import Assets, Environment, make_assets, make_environment
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.carried_over import policy_for
from forgetmimic_jax.unlearning.registry import method_of

COMPILATION_CACHE = DATA_DIR.parent / ".cache" / "jax"  # what XLA compiled is not compiled again at the next start
BEST = "best"
KEEP = 2  # newest checkpoints kept beside the named ones
LOG_EVERY = 10  # iterations averaged into one row of metrics.jsonl; the first has a row of its own


@dataclass(frozen=True)
class Setup:
    """A config, resolved: robot, clips and environment."""

    config: Config
    robot: Robot
    library: MotionLibrary
    library_hash: str
    env: Environment
    assets: Assets


def make_setup(config: Config) -> Setup:
    """Load what a config names; bad names and numbers are told before anything is written."""
    validate(config)
    if not jax.config.values["jax_compilation_cache_dir"]:
        jax.config.update("jax_compilation_cache_dir", str(COMPILATION_CACHE))
    robot = load_robot(
        config.robot,
        timestep=config.physics.timestep,
        solver_iterations=config.physics.solver_iterations,
        line_search_iterations=config.physics.line_search_iterations,
        self_collision=config.physics.self_collision,
    )
    folder = library_folder(config)
    library = load_library(robot, folder, fps=1.0 / (config.physics.timestep * config.physics.substeps))
    check_targets(config.unlearn.targets, library.names)
    method_of(config)
    env = make_environment(config, robot, config.ppo.num_envs)
    return Setup(config, robot, library, library_hash(folder), env, make_assets(config, robot, library))


def template(setup: Setup) -> TrainState:
    """Shapes of the run's TrainState."""
    return jax.eval_shape(lambda key: init_state(setup.env, setup.assets, key), jax.random.PRNGKey(0))


def start_state(setup: Setup) -> TrainState:
    """A fresh run's state; with a base, a warm start from its policy, unless the unlearning method trains a fresh one.

    Where unlearning samples or assists by failure levels, it goes on with the base's.
    """
    config, unlearning = setup.config, bool(setup.config.unlearn.targets)
    key = jax.random.PRNGKey(config.seed)
    if method_of(config).start != "base" or (config.base is None and not unlearning):
        return jax.jit(lambda assets, key: init_state(setup.env, assets, key))(setup.assets, key)
    policy, failure_level = base_policy(setup), None
    by_failure = config.sampling.rule == "adaptive" or config.wrench.max_gain > 0
    if config.sampling.rule == "frozen" or (unlearning and by_failure):
        failure_level = checkpoint.load_failure_level(base_checkpoint(config), template(setup))
    start = jax.jit(lambda assets, key, policy, level: init_state(setup.env, assets, key, policy, level))
    return start(setup.assets, key, policy, failure_level)


def base_policy(setup: Setup) -> Policy:
    """The policy that a run starts from.

    Training may go on with other clips than the base's, and with another robot's policy, carried over joint by joint;
    unlearning needs the base's own.

    Raises:
        InputError: the checkpoint is not of this robot, network or library, or of a robot that nothing can be had from.
    """
    config, robot = setup.config, setup.robot
    base, training = base_checkpoint(config), not config.unlearn.targets
    info = checkpoint.read_info(base)
    carry = training and info.robot != robot.name
    checkpoint.check_matches(
        info, robot, setup.library, setup.library_hash, config, other_library=training, other_robot=carry
    )
    if carry:
        return policy_for(robot, base, config, template(setup))
    return checkpoint.load_policy(base, template(setup))


def with_base(setup: Setup) -> Setup:
    """The setup of an unlearning run, whose method may hold the policy against the frozen base."""
    return dataclasses.replace(setup, assets=dataclasses.replace(setup.assets, base=base_policy(setup)))


def check_targets(targets: tuple[str, ...], names: tuple[str, ...]) -> None:
    """Targets must be clips of the library, and not all of them.

    Raises:
        InputError: an unknown clip, or nothing left to keep.
    """
    for target in targets:
        if target not in names:
            raise InputError(f"targets: no clip '{target}' in the library; {nearest(target, names)}")
    if targets and set(targets) == set(names):
        raise InputError(f"targets: all {len(names)} clips of the library; leave at least one to keep")


def library_folder(config: Config) -> Path:
    """Where a config's clips lie."""
    return DATA_DIR / config.robot if config.library is None else Path(config.library)


def default_targets(config: Config) -> tuple[str, ...]:
    """The clips that the library itself proposes to forget."""
    return tuple(read_manifest(library_folder(config)).get("default_targets", ()))


def base_checkpoint(config: Config) -> Path:
    """The checkpoint that an unlearning run starts from: the one it names, or the shipped one."""
    return base_folder(config.robot) if config.base is None else Path(config.base)


def base_folder(robot: str) -> Path:
    """Where a robot's shipped base policy lies.

    Raises:
        InputError: unknown robot, or none is shipped for it.
    """
    roles_file(robot)
    folder = DATA_DIR / robot / "base"
    if not folder.is_dir():
        raise InputError(f"{folder}: no policy is shipped for '{robot}'; train one and name its checkpoint")
    return folder


def folder_of(path: Path) -> Path | None:
    """The run that a checkpoint belongs to, if any."""
    if path.parent.name == "checkpoints":
        return path.parent.parent
    return path.parent if (path.parent / "checkpoints").is_dir() else None


def default_folder(kind: str, *, resume: bool) -> Path:
    """The next free folder runs/KIND-NUMBER, or with `resume` the last one."""
    numbers = [int(path.name.rpartition("-")[2]) for path in Path("runs").glob(f"{kind}-[0-9]*")
               if path.name.rpartition("-")[2].isdigit()]  # fmt: skip
    last = max(numbers, default=0)
    return Path("runs") / f"{kind}-{last if resume and last else last + 1:03d}"


def prepare_folder(directory: Path, *, resume: bool) -> Path | None:
    """The newest checkpoint to resume from; without `resume` the folder must be new or empty.

    Raises:
        InputError: the folder exists or cannot be written, or there is nothing to resume.
    """
    check_writable(directory)
    if resume:
        newest = checkpoint.newest_checkpoint(directory)
        if newest is None:
            raise InputError(f"{directory}: --resume finds no checkpoint there; leave it out to start")
        return newest
    if directory.exists() and any(directory.iterdir()):
        other = "go on with --resume" if checkpoint.newest_checkpoint(directory) else "remove it"
        raise InputError(f"{directory}: exists already; choose another --output, or {other}")
    return None


def check_writable(directory: Path) -> None:
    """InputError unless `directory` can be written to or made."""
    existing = next(path for path in (directory, *directory.parents) if path.exists())
    if not existing.is_dir():
        raise InputError(f"{directory}: {existing} is a file; choose another --output")
    if not os.access(existing, os.W_OK):
        raise InputError(f"{directory}: no permission to write in {existing}; choose another --output")


def interrupted(config: Config, directory: Path) -> Interrupted:
    """What a stopped run says at its end: what it saved, and the command that goes on."""
    command = "unlearn" if config.unlearn.targets else "pretrain"
    return Interrupted(
        f"stopped; saved {checkpoint.newest_checkpoint(directory)}; "
        f"go on with: make {command} ROBOT={config.robot} RESUME=1 OUTPUT={directory}"
    )


def run(
    setup: Setup,
    directory: Path,
    *,
    description: str,
    resume: bool = False,
) -> tuple[Path, TrainState]:
    """Train until `config.iterations`; returns the last checkpoint's folder and the state.

    The folder gets config.yaml, metrics.jsonl (means over LOG_EVERY iterations), TensorBoard events and checkpoints/,
    the first of them before the first iteration, so that a run that is killed can always go on. With
    `config.evaluate_every` also evaluations.jsonl, its picture evaluations.png, and best/, the policy with the best
    mean survival-weighted tracking. Ctrl-C and SIGTERM end the current iteration, save, and raise Interrupted.
    """
    config = setup.config
    base = checkpoint.policy_hash(checkpoint.read_info(base_checkpoint(config))) if config.unlearn.targets else None
    newest = prepare_folder(directory, resume=resume)
    if newest is None:
        state, environment_steps = start_state(setup), _steps_before(config)
    else:
        state, environment_steps = _saved_state(setup, newest)
    iteration = int(state.iteration)
    steps_per_iteration = config.ppo.num_envs * config.ppo.num_steps
    iterate = make_iteration(setup.env)
    directory.mkdir(parents=True, exist_ok=True)
    console = Console()
    saved = newest

    def save(best: bool = False) -> Path:
        if not best:
            # A row never spans a checkpoint: what is resumed has all of its rows in the file.
            log.write(iteration, environment_steps, setup.library.names)
        path = directory / BEST if best else directory / "checkpoints" / f"{iteration:08d}"
        checkpoint.save_checkpoint(
            path,
            state,
            config,
            setup.robot,
            setup.library,
            setup.library_hash,
            environment_steps=environment_steps,
            base=base,
            resumable=not best,
        )
        for old in checkpoint.checkpoints(directory)[:-KEEP]:
            shutil.rmtree(old)
        return path

    try:
        save_config(config, directory / "config.yaml")
        with (
            _Log(directory, iteration, environment_steps) as log,
            _stop_requests() as stop,
            progress(description, config.iterations, start=iteration, console=console) as report,
        ):
            watch = _watch(setup, directory, iteration)
            saved = saved or save()
            while iteration < config.iterations and not stop:
                state, metrics = iterate(setup.assets, state)
                metrics = jax.device_get(metrics)
                iteration += 1
                environment_steps += steps_per_iteration
                log.add(metrics)
                if iteration == 1 or iteration % LOG_EVERY == 0:
                    log.write(iteration, environment_steps, setup.library.names)
                report(iteration, environment_steps, _live(metrics))
                if watch and iteration % config.evaluate_every == 0:
                    if watch(state.policy, iteration, environment_steps):
                        save(best=True)
                    console.print(watch.table())
                if iteration % config.checkpoint_every == 0:
                    saved = save()  # after the evaluation, which a run that is resumed from here does not make again
            if int(saved.name) != iteration:
                saved = save()
    except BaseException as error:
        if saved is None:
            shutil.rmtree(directory, ignore_errors=True)  # nothing in it to go on with
        elif isinstance(error, KeyboardInterrupt):
            raise interrupted(config, directory) from None
        elif isinstance(error, OSError) and error.filename is None:
            error.filename = str(directory)  # a full disk does not say where
        raise
    if stop:
        raise interrupted(config, directory)
    return saved, state


def _watch(setup: Setup, directory: Path, iteration: int) -> Watch | None:
    if not setup.config.evaluate_every:
        return None
    return Watch(setup.config, setup.robot, setup.library, directory, iteration)


def _steps_before(config: Config) -> int:
    """Environment steps that a base's training adds to those of the training that goes on from it on the same robot."""
    if config.base is None or config.unlearn.targets:
        return 0
    info = checkpoint.read_info(Path(config.base))
    return info.environment_steps if info.robot == config.robot else 0


def _saved_state(setup: Setup, path: Path) -> tuple[TrainState, int]:
    """The state of a checkpoint of this run, and the environment steps behind it."""
    info = checkpoint.read_info(path)
    checkpoint.check_matches(info, setup.robot, setup.library, setup.library_hash, setup.config, resume=True)
    state = checkpoint.load_state(path, template(setup))
    step_size = setup.config.ppo.learning_rate
    if step_size != info.config.ppo.learning_rate:  # changed with --set; else the state's own holds
        state = dataclasses.replace(state, learning_rate=jnp.asarray(step_size, jnp.float32))
    return state, info.environment_steps


def _live(metrics: Mapping[str, np.ndarray]) -> dict[str, float]:
    shown = {"episode_length": metrics["episode_length"], "tracking": metrics["tracking_reward"]}
    if "target/tracking_reward" in metrics:
        shown |= {"target_tracking": metrics["target/tracking_reward"], "kept": metrics["kept/tracking_reward"]}
    return {name: float(value) for name, value in shown.items()}


class _Log:
    """metrics.jsonl and TensorBoard events: means over the iterations since the last row, and the seconds they took."""

    def __init__(self, directory: Path, iteration: int, environment_steps: int):
        # TensorboardX's SummaryWriter writes from a thread, for which a run would wait forever when the disk is full.
        path = directory / "metrics.jsonl"
        drop_rows_after(path, iteration)
        self._file = path.open("a")
        (directory / "events").mkdir(exist_ok=True)
        self._events = EventsWriter(str(directory / "events" / "events"))
        # TensorBoard hides the rows after this one that an earlier, killed process may have written.
        self._write_event(environment_steps + 1, session_log=SessionLog(status=SessionLog.START))
        self._rows: list[Mapping[str, np.ndarray]] = []
        self._last_row = time.monotonic()

    def __enter__(self) -> _Log:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._events.close()

    def add(self, metrics: Mapping[str, np.ndarray]) -> None:
        self._rows.append(metrics)

    def write(self, iteration: int, environment_steps: int, clips: tuple[str, ...]) -> None:
        rows, self._rows = self._rows, []
        if not rows:
            return
        mean = {name: np.mean([row[name] for row in rows], axis=0) for name in rows[0]}
        out: dict[str, Any] = {"iteration": iteration, "environment_steps": environment_steps}
        out |= {name: float(value) for name, value in mean.items() if np.ndim(value) == 0}
        now = time.monotonic()
        out["seconds"], self._last_row = round(now - self._last_row, 2), now
        episodes = np.maximum(mean["clip/episodes"], 1e-9)
        steps = np.maximum(mean["clip/steps"], 1e-9)
        per_clip = {
            "success": mean["clip/completed"] / episodes,
            "survival_weighted_tracking": mean["clip/survival_weighted_sum"] / episodes,
            "episode_length": mean["clip/episode_length_sum"] / episodes,
            "tracking_reward": mean["clip/tracking_sum"] / steps,
            "probability": mean["clip/probability"],
            "step_share": steps / steps.sum(),
        }
        out["clips"] = {
            clip: {name: round(float(values[i]), 5) for name, values in per_clip.items()}
            for i, clip in enumerate(clips)
        }
        self._file.write(json.dumps(out) + "\n")
        self._file.flush()
        scalars = {name: value for name, value in out.items() if isinstance(value, float)}
        for clip, values in out["clips"].items():
            scalars |= {f"{clip}/{name}": value for name, value in values.items()}
        summary = Summary(value=[Summary.Value(tag=name, simple_value=value) for name, value in scalars.items()])
        self._write_event(environment_steps, summary=summary)

    def _write_event(self, step: int, **content: Any) -> None:
        self._events.write_event(Event(wall_time=time.time(), step=step, **content))
        self._events.flush()


@contextlib.contextmanager
def _stop_requests() -> Iterator[list[int]]:
    """A list that becomes non-empty at Ctrl-C or SIGTERM; a second Ctrl-C interrupts at once."""
    received: list[int] = []

    def ask(number: int, _frame: object) -> None:
        if received:
            raise KeyboardInterrupt
        received.append(number)

    old = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
