"""Many unlearning runs: each a process of its own, so that one that fails or is stopped harms no other.

A trial is a Config and its hash: its folder is named by what decides its numbers, so that any study that asks for the
same run finds a finished one again, and a run of other code is another trial.
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import hashlib
import itertools
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

from forgetmimic_jax.basics.console import progress
from forgetmimic_jax.basics.errors import Interrupted
from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.basics.provenance import provenance
from forgetmimic_jax.motion.library import library_hash
from forgetmimic_jax.robot.model import roles_file
from forgetmimic_jax.settings.config import Config, to_dict
from forgetmimic_jax.tracking.setup import library_folder
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.checkpoint import newest_checkpoint
from forgetmimic_jax.training.start import base_checkpoint
from forgetmimic_jax.training.unlearning_run import Options, config_of

POLL = 1.0  # s between two looks at the running trials


@dataclass(frozen=True)
class Trial:
    """One run of `forgetmimic_jax.unlearn`.

    Args:
        folder: where it goes; see `make_trial`.
        config: every setting.
        flags: of the command that makes this config, all but `--output` and `--resume`.
    """

    folder: Path
    config: Config
    flags: tuple[str, ...]

    @property
    def iterations(self) -> int:
        """How long it trains."""
        return self.config.iterations

    @property
    def evaluation(self) -> Path:
        """The last file that a trial writes: with it, the trial is finished."""
        return self.folder / "evaluation.json"

    @property
    def log(self) -> Path:
        """What the run printed."""
        return self.folder.with_name(f"{self.folder.name}.log")


def make_trial(root: Path, options: Mapping[str, Any]) -> Trial:
    """The trial with these options of `unlearn`, by name.

    Its folder is METHOD-TARGETS-sSEED-DIGEST-CODE in `root`. DIGEST is over every setting, the number of evaluation
    episodes, and the contents of base, clips and robot; CODE is over the package's Python files. Where base and clips
    lie does not count.
    """
    given = Options(**{**options, "set": [list(options.get("set", []))]})
    config = config_of(given)
    base = checkpoint.fingerprint(base_checkpoint(config))
    robot = [path.read_text() for path in sorted(roles_file(config.robot).parent.glob("*.*ml"))]
    plain = dataclasses.replace(config, base=None, library=None)
    content = [to_dict(plain), given.episodes, base, library_hash(library_folder(config)), robot]
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:8]
    unlearning = config.unlearn
    words = [unlearning.method, "+".join(unlearning.targets), f"s{config.seed}", digest, provenance().code]
    return Trial(root / "-".join(words), config, flags_of(given))


def without_code(name: str) -> str:
    """A trial's name but for the code that made it."""
    return name.rpartition("-")[0]


def flags_of(options: Options) -> tuple[str, ...]:
    """The command line of options that are not the defaults."""
    flags: list[str] = []
    for option in fields(options):
        value, default = getattr(options, option.name), getattr(Options(), option.name)
        if option.name == "set":
            value, default = list(itertools.chain(*value)), []
        if value != default:
            values = value if isinstance(value, list) else [] if value is True else [value]
            flags += [f"--{option.name}", *map(str, values)]
    return tuple(flags)


def run_trials(trials: Sequence[Trial], *, jobs: int, description: str) -> dict[Trial, str]:
    """Run the trials that are not finished, `jobs` at a time; returns those that failed, each with its last line.

    A trial that was stopped continues from its last checkpoint. Ctrl-C and SIGTERM stop the running ones, which save.

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

    def say(text: str) -> None:
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
                    failed[trial] = "another process runs it"
            time.sleep(POLL)
            for trial in [trial for trial, process in running.items() if process.poll() is not None]:
                code = running.pop(trial).returncode
                if code != 0 or not trial.evaluation.is_file():
                    words = trial.log.read_text().strip().splitlines() or ["it printed nothing"]
                    failed[trial] = f"killed by signal {-code}" if code < 0 else words[-1].removeprefix("error: ")
                    say(f"failed: {trial.folder.name}: {failed[trial]} ({trial.log})")
                else:
                    say(f"finished: {trial.folder.name}")
            now = {trial.folder.name: iterations(trial) for trial in running}
            if now != shown:
                report(sum(map(iterations, trials)), 0, shown := now)
    return failed


def _start(trial: Trial) -> subprocess.Popen:
    """The trial's process. It holds a lock on its log until it ends, even if its parent is killed."""
    trial.folder.parent.mkdir(parents=True, exist_ok=True)
    with trial.log.open("a") as log:
        _lock(log)
        resume = newest_checkpoint(trial.folder) is not None
        if not resume:
            shutil.rmtree(trial.folder, ignore_errors=True)  # nothing in it to continue with
        command = [sys.executable, "-m", "forgetmimic_jax.unlearn", *trial.flags, "--output", str(trial.folder)]
        # Its own session: a Ctrl-C in the terminal reaches the parent alone, which asks each trial once to stop.
        return subprocess.Popen(
            command + ["--resume"] * resume, stdout=log, stderr=subprocess.STDOUT, start_new_session=True
        )


def _lock(file: IO[str]) -> None:
    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextlib.contextmanager
def _stoppable(running: Mapping[Trial, subprocess.Popen]) -> Iterator[None]:
    """Whatever ends the body early also stops the running trials, which save first; SIGTERM counts as Ctrl-C."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    old = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    except KeyboardInterrupt:
        raise Interrupted("stopped; finished trials are kept; the same command continues") from None
    finally:
        for process in running.values():
            process.terminate()
        for process in running.values():
            process.wait()
        signal.signal(signal.SIGTERM, old)
