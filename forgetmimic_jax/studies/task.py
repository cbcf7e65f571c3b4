"""A task: one run of a command in a process of its own, and how a worker runs it.

A worker is a thread of the program that wants the tasks, or a process of a cluster on any machine. Every task has a
process of its own in both, so that a task that fails, or that the system kills, harms no other.
"""

from __future__ import annotations

import contextlib
import os
import platform
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from forgetmimic_jax.basics.drawing import draw_later
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.files import read_rows, write_atomically
from forgetmimic_jax.basics.provenance import PACKAGE, provenance
from forgetmimic_jax.studies.process import CODE

PROC = Path("/proc")  # of Linux: what the kernel says of processes
ATTEMPTS = 3  # at a task whose process the system kills
POLL = 1.0  # s between two questions whether a running task is still wanted
# Environment variables that say how many threads to use: to `provenance.cores`, to XLA, and to BLAS.
THREADS = ("PYTHON_CPU_COUNT", "NPROC", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")

_lock = threading.Lock()
_here: dict[Path, subprocess.Popen | None] = {}  # the tasks that this program runs, by folder; None: about to start


@dataclass(frozen=True)
class Task:
    """One run of a command of this package.

    Args:
        folder: that it writes to. Every worker sees it under this absolute path.
        command: its name, such as `unlearn`.
        flags: of the command, all but `--output` and `--resume`.
        iterations: how long it trains.
        last: the file in `folder` that the command writes last; with it, the task is finished.
        adds: it adds to a folder that is there already, and continues by itself. Other commands make `folder`, their
            `--output`, and continue with `--resume`.
    """

    folder: Path
    command: str
    flags: tuple[str, ...]
    iterations: int
    last: str = "evaluation.json"
    adds: bool = False

    @property
    def finished(self) -> bool:
        """The command came to its end."""
        return (self.folder / self.last).is_file()

    @property
    def log(self) -> Path:
        """What the command printed, in all its attempts."""
        return self.folder.with_name(f"{self.folder.name}.log")

    @property
    def mark(self) -> Path:
        """While a worker runs the task: a file with the worker's host, process and the process's start."""
        return self.folder.with_name(f"{self.folder.name}.running")

    @property
    def iterations_done(self) -> int:
        """Up to the newest row of its metrics.jsonl."""
        rows = read_rows(self.folder / "metrics.jsonl")
        return rows[-1]["iteration"] if rows else 0


def run_task(
    task: Task,
    directory: Path,
    code: str,
    threads: int,
    wanted: Callable[[], bool] = lambda: True,
    gpu: str | None = None,
) -> str | None:
    """Run a task here, from its newest checkpoint if it has one.

    A process that the system kills is started again, ATTEMPTS times in all.

    Args:
        task: not finished yet.
        directory: where relative paths of its flags start.
        code: `code_hash` of the program that wants it.
        threads: that the command may use.
        wanted: whether anyone still waits for the task; if not, it is stopped.
        gpu: the only one that the command sees, as CUDA_VISIBLE_DEVICES names it; by default those of this process.

    Returns:
        None where the task is finished now, otherwise why it is not.
    """
    draw_later()  # a worker of a cluster may have no library to draw with
    try:
        _check_worker(task, directory, code)
        with _marked(task):
            _here[task.folder] = None
            try:
                return _attempts(task, directory, _environment(threads, gpu), wanted)
            finally:
                _here.pop(task.folder, None)
    except InputError as error:
        return str(error)


def stop_tasks(folders: Iterable[Path]) -> None:
    """Ask those of the tasks that this program runs to save and end; returns when they have ended."""
    with _lock:
        processes = [_here.pop(folder) for folder in folders if folder in _here]
    started = [process for process in processes if process is not None]
    for process in started:
        process.terminate()
    for process in started:
        process.wait()


def _check_worker(task: Task, directory: Path, code: str) -> None:
    """InputError where the worker has other code, or does not see the task's folder."""
    host, here = platform.node(), provenance().code
    if here != code:
        raise InputError(f"{host}: its code is {here}; accepted: {code}, the code that wants the task")
    for path in (task.folder.parent, directory):
        if not path.is_dir():
            raise InputError(f"{host}: no folder {path} there; every worker must see it under this path")


@contextlib.contextmanager
def _marked(task: Task) -> Iterator[None]:
    """Inside, the task's mark exists; the mark of a worker that is gone is replaced.

    Raises:
        InputError: another process of this machine runs the task.
    """
    mine = f"{platform.node()} {os.getpid()} {_start_of(os.getpid())}"
    try:
        with task.mark.open("x") as file:
            file.write(mine)
    except FileExistsError:
        if (process := _at_work(task.mark.read_text())) is not None:
            raise InputError(f"process {process} runs it") from None
        write_atomically(task.mark, mine.encode())
    try:
        yield
    finally:
        task.mark.unlink(missing_ok=True)


def _at_work(mark: str) -> int | None:
    """The process of a mark, if it still runs on this machine; its number alone may be another process's by now."""
    host, process, start = (*mark.split(), "", "", "")[:3]
    if host != platform.node() or not process.isdigit() or not _is_alive(int(process)):
        return None
    return int(process) if _start_of(int(process)) in ("", start) else None


def _start_of(process: int) -> str:
    """When a process started: the boot's identity and clock ticks since then; empty where the system does not say."""
    try:
        boot = (PROC / "sys/kernel/random/boot_id").read_text().strip()
        fields = (PROC / str(process) / "stat").read_text().rpartition(")")[2].split()  # from the third on
    except OSError:
        return ""
    return f"{boot}:{fields[19]}"


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _attempts(task: Task, directory: Path, more: Mapping[str, str], wanted: Callable[[], bool]) -> str | None:
    for _ in range(ATTEMPTS):
        process = _start(task, directory, more)
        code = _end(task, process, wanted) if process else 0
        if task.finished:
            return None
        if task.folder not in _here:
            return "stopped"
        if code >= 0:
            return _last_words(task)
    return f"killed by signal {-code}, {ATTEMPTS} times"


def _end(task: Task, process: subprocess.Popen, wanted: Callable[[], bool]) -> int:
    """Wait for the end of a task's process; returns its exit code."""
    while True:
        try:
            return process.wait(POLL)
        except subprocess.TimeoutExpired:
            if not wanted():
                stop_tasks([task.folder])


def _start(task: Task, directory: Path, more: Mapping[str, str]) -> subprocess.Popen | None:
    """The task's process, with more environment variables; None if the task was stopped before."""
    from forgetmimic_jax.training.checkpoint import newest_checkpoint
    from forgetmimic_jax.training.devices import without_others

    command = [sys.executable, "-m", "forgetmimic_jax.studies.process", task.command, *task.flags]
    if not task.adds:
        resume = newest_checkpoint(task.folder) is not None
        if not resume:
            shutil.rmtree(task.folder, ignore_errors=True)  # nothing in it to continue with
        command += ["--output", str(task.folder), *["--resume"] * resume]
    with _lock, task.log.open("a") as log:
        if task.folder not in _here:
            return None
        # Its own session: a Ctrl-C in the terminal reaches the program alone, which asks each task once to stop.
        # Its input is a pipe that nothing is written to: it closes when this program ends, however it ends.
        process = subprocess.Popen(
            command,
            cwd=directory,
            env={**without_others(os.environ), **more},
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        _here[task.folder] = process
    return process


def _environment(threads: int, gpu: str | None) -> dict[str, str]:
    """For the process of a task: where the code of this process lies, its hash, its threads and its GPU."""
    paths = [str(PACKAGE.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    counts = dict.fromkeys(THREADS, str(threads))
    counts |= {CODE: provenance().code} | ({} if gpu is None else {"CUDA_VISIBLE_DEVICES": gpu})
    return counts | {"PYTHONPATH": os.pathsep.join(paths), "PYTHONSAFEPATH": "1"}


def _last_words(task: Task) -> str:
    words = task.log.read_text().strip().splitlines() or ["it printed nothing"]
    return words[-1].removeprefix("error: ")
