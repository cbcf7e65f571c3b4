"""Many unlearning runs: each a process of its own, so that one that fails or is stopped harms no other.

A trial's folder is named by what it was asked for, so a finished one is found again, by any study that asks the same.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import IO, Any

from rich.console import Console

from forgetmimic_jax import unlearn
from forgetmimic_jax.basics.console import progress
from forgetmimic_jax.basics.errors import Interrupted
from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.checkpoint import newest_checkpoint

POLL = 1.0  # s between two looks at the running trials
DEFAULTS = {option.name: option.default for option in fields(unlearn.Options)}


@dataclass(frozen=True)
class Trial:
    """One run of `forgetmimic_jax.unlearn`.

    Args:
        folder: where it goes; see `make_trial`.
        flags: of the command, all but `--output` and `--resume`.
        iterations: how long it trains.
    """

    folder: Path
    flags: tuple[str, ...]
    iterations: int

    @property
    def evaluation(self) -> Path:
        """The last thing a trial writes: where it is, the trial is finished."""
        return self.folder / "evaluation.json"

    @property
    def log(self) -> Path:
        """What the run printed."""
        return self.folder.with_name(f"{self.folder.name}.log")


def make_trial(root: Path, options: Mapping[str, Any]) -> Trial:
    """The trial of the options of `unlearn` by name; needs `base` and `iterations`.

    Its folder's name ends with a digest of all that is not a default and of the base's content. What the code does with
    them is not part of it: after a change of the code, remove the folder.
    """
    asked = {name: value for name, value in options.items() if value != DEFAULTS[name]}
    content = json.dumps({**asked, "base": checkpoint.fingerprint(Path(options["base"]))}, sort_keys=True, default=str)
    digest = hashlib.sha256(content.encode()).hexdigest()[:8]
    shown = ("penalty", "sampler", "wrench", "clips", "targets")
    words = [str(options.get("method", "arft")), *(f"{name}_{asked[name]}" for name in shown if name in asked)]
    name = "-".join([*words, f"s{options.get('seed', 0)}", digest]).replace(",", "+")
    flags: list[str] = []
    for option, value in asked.items():
        values = value if isinstance(value, list | tuple) else [] if value is True else [value]
        flags += [f"--{option}", *map(str, values)]
    return Trial(root / name, tuple(flags), int(options["iterations"]))


def run_trials(trials: Sequence[Trial], *, jobs: int, description: str) -> dict[Trial, str]:
    """Run the trials that are not finished, `jobs` at a time; those that failed, each with its last words.

    A trial that was stopped goes on from its last checkpoint. Ctrl-C and SIGTERM stop the running ones, which save.

    Raises:
        Interrupted: stopped.
    """
    trials = list(dict.fromkeys(trials))
    waiting = [trial for trial in trials if not trial.evaluation.is_file()]
    running: dict[Trial, subprocess.Popen] = {}
    failed: dict[Trial, str] = {}
    console = Console()

    def iterations(trial: Trial) -> int:
        rows = read_rows(trial.folder / "metrics.jsonl")
        return rows[-1]["iteration"] if rows else 0

    def told(text: str) -> None:
        console.print(text, highlight=False, markup=False, soft_wrap=True)

    total, done = (sum(map(count, trials)) for count in (lambda trial: trial.iterations, iterations))
    shown: dict[str, int] = {}
    with _stoppable(running), progress(description, total, start=done, console=console) as report:
        while waiting or running:
            while waiting and len(running) < jobs:
                trial = waiting.pop(0)
                try:
                    running[trial] = _start(trial)
                except BlockingIOError:
                    failed[trial] = "another process is at work on it"
            time.sleep(POLL)
            for trial in [trial for trial, process in running.items() if process.poll() is not None]:
                code = running.pop(trial).returncode
                if code != 0 or not trial.evaluation.is_file():
                    words = trial.log.read_text().strip().splitlines() or ["it said nothing"]
                    failed[trial] = f"killed by signal {-code}" if code < 0 else words[-1].removeprefix("error: ")
                    told(f"failed: {trial.folder.name}: {failed[trial]} ({trial.log})")
                else:
                    told(f"finished: {trial.folder.name}")
            now = {trial.folder.name: iterations(trial) for trial in running}
            if now != shown:
                report(sum(map(iterations, trials)), 0, shown := now)
    return failed


def _start(trial: Trial) -> subprocess.Popen:
    """The trial's process, which holds a lock on its log as long as it lives, though its parent be killed."""
    trial.folder.parent.mkdir(parents=True, exist_ok=True)
    with trial.log.open("a") as log:
        _lock(log)
        resume = newest_checkpoint(trial.folder) is not None
        if not resume:
            shutil.rmtree(trial.folder, ignore_errors=True)  # nothing in it to go on with
        command = [sys.executable, "-m", "forgetmimic_jax.unlearn", *trial.flags, "--output", str(trial.folder)]
        # Its own session: a Ctrl-C in the terminal is for the parent, which asks each trial once to stop.
        return subprocess.Popen(
            command + ["--resume"] * resume, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
        )


def _lock(file: IO[str]) -> None:
    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextlib.contextmanager
def _stoppable(running: Mapping[Trial, subprocess.Popen]) -> Iterator[None]:
    """Whatever ends the body early ends the running trials too, once they have saved; SIGTERM counts as Ctrl-C."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    old = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    except KeyboardInterrupt:
        raise Interrupted("stopped; what is finished is kept; the same command goes on") from None
    finally:
        for process in running.values():
            process.terminate()
        for process in running.values():
            process.wait()
        signal.signal(signal.SIGTERM, old)
