"""Many tasks at a time, on this machine or on a cluster: `run_tasks`.

Tasks go to a `concurrent.futures.Executor`: the standard library's on this machine, dask's on a cluster
(docs/cluster.md). Both get the same function, `task.run_task`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import queue
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, NamedTuple

from forgetmimic_jax.basics.console import closing
from forgetmimic_jax.basics.errors import InputError, Interrupted
from forgetmimic_jax.basics.provenance import cores, gpus, provenance
from forgetmimic_jax.settings.options import at_least
from forgetmimic_jax.studies.board import board
from forgetmimic_jax.studies.task import Task, run_task, stop_tasks

POLL = 1.0  # s between two looks at the running tasks
PATIENCE = 20.0  # s for a scheduler to answer
RESOURCE = "trial"  # of a dask worker: how many tasks it runs at a time
ENDS = (signal.SIGTERM, signal.SIGHUP)  # beside Ctrl-C


class Place(NamedTuple):
    """Where tasks run: the executor, what it calls, and what stops the tasks of some folders."""

    executor: Executor
    run: Callable[[Task, Path, str], str | None]
    stop: Callable[[Sequence[Path]], object]


def at_a_time(jobs: int | None, cluster: str | None, few: int = 1) -> int:
    """How many tasks run at a time on this machine: `--jobs`, or else one on each GPU; `few` where there is none.

    Raises:
        InputError: fewer than one, or more than there are GPUs.
    """
    there = 0 if cluster else len(gpus())
    if jobs is None:
        return there or few
    at_least(1, "--jobs", jobs)
    if there and jobs > there:
        raise InputError(f"--jobs: found {jobs}; accepted: 1 to {there}, since each takes one of the GPUs")
    return jobs


def run_tasks(tasks: Sequence[Task], *, jobs: int, cluster: str | None = None, description: str) -> dict[Task, str]:
    """Run the tasks that are not finished; returns those that failed, each with its reason.

    A task that was stopped, or whose worker died, continues from its newest checkpoint. Ctrl-C, SIGTERM and a terminal
    that is closed stop the running ones, which save.

    Args:
        tasks: one that is given twice runs once.
        jobs: tasks at a time on this machine. Each has as many threads as this process has cores, divided by `jobs`,
            and where there are GPUs, one of them for itself.
        cluster: address of a dask scheduler, such as tcp://host:8786; then its workers run the tasks, one at a time
            each, with the worker's own number of threads.
        description: of the table.

    Raises:
        Interrupted: stopped.
        InputError: no scheduler there, or no worker that can run tasks.
    """
    tasks = list(dict.fromkeys(tasks))
    waiting = [task for task in tasks if not task.finished]
    failed: dict[Task, str] = {}
    with _interruptible(), on_cluster(cluster) if cluster else on_this_machine(jobs) as place:
        for task in waiting:
            task.folder.parent.mkdir(parents=True, exist_ok=True)
        here = (Path.cwd(), provenance().code)
        with board(description, tasks) as show:
            futures = {place.executor.submit(place.run, _absolute(task), *here): task for task in waiting}
            running = set(futures)
            try:
                while running:
                    done, running = wait(running, timeout=POLL, return_when=FIRST_COMPLETED)
                    failed |= {futures[future]: why for future in done if (why := _outcome(future))}
                    show(failed)
            finally:
                for future in running:
                    future.cancel()
                if running:
                    place.stop([_absolute(futures[future]).folder for future in running])
    return failed


def run_together(tasks: Sequence[Task], next_command: str, **given: Any) -> None:
    """`run_tasks` as a command's whole work: says where each task's folder is, and ends with exit code 1 if one failed.

    Args:
        tasks: one for each folder.
        next_command: to try then.
        given: the other arguments of `run_tasks`.
    """
    failed = run_tasks(tasks, **given)
    closing({task.folder.name: task.folder for task in tasks if task not in failed}, next_command)
    if failed:
        print(f"{len(failed)} of {len(tasks)} failed; the same command tries them again", file=sys.stderr)
        sys.exit(1)


@contextlib.contextmanager
def on_this_machine(jobs: int) -> Iterator[Place]:
    """A thread for each of `jobs` tasks at a time, which waits for the task's process.

    Of the standard library's executors, that of processes would lose all of its tasks where one process is killed.
    """
    threads, free, there = max(1, cores() // jobs), queue.SimpleQueue[str](), gpus()
    for gpu in there:
        free.put(gpu)

    def run(task: Task, directory: Path, code: str) -> str | None:
        gpu = free.get() if there else None
        try:
            return run_task(task, directory, code, threads, gpu=gpu)
        finally:
            if gpu is not None:
                free.put(gpu)

    with ThreadPoolExecutor(jobs) as executor:
        yield Place(executor, run, stop_tasks)


@contextlib.contextmanager
def on_cluster(address: str) -> Iterator[Place]:
    """The workers of a dask scheduler; a worker runs as many tasks at a time as it has of RESOURCE."""
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--cluster: needs dask; install it with: pip install 'forgetmimic-jax[cluster]'") from None
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"--cluster: found {address}; accepted: the address of a dask scheduler ({error})") from None
    with client:
        workers = client.scheduler_info(n_workers=-1)["workers"].values()
        if workers and not any(worker["resources"].get(RESOURCE) for worker in workers):
            raise InputError(f"--cluster: no worker of {address} has the resource '{RESOURCE}'; see docs/cluster.md")
        executor = client.get_executor(resources={RESOURCE: 1})
        yield Place(executor, _run_on_worker, lambda folders: client.run(_stop_on_worker, folders, on_error="ignore"))


def _run_on_worker(task: Task, directory: Path, code: str) -> str | None:
    """`run_task` with the threads of this dask worker, until no client waits for it any more."""
    from distributed import get_worker

    worker = get_worker()
    key = worker.get_current_task()

    def wanted() -> bool:
        known = worker.state.tasks.get(key)
        return known is not None and known.state != "cancelled"

    return run_task(task, directory, code, worker.state.nthreads, wanted)


async def _stop_on_worker(folders: Sequence[Path]) -> None:
    """`stop_tasks` beside the worker's event loop, which must not wait."""
    import asyncio

    await asyncio.to_thread(stop_tasks, folders)


def _absolute(task: Task) -> Task:
    return dataclasses.replace(task, folder=task.folder.absolute())


def _outcome(future: Future[str | None]) -> str | None:
    """Why a task failed, if it did."""
    if future.cancelled():
        return "the cluster has lost it"
    error = future.exception()
    return future.result() if error is None else f"{type(error).__name__}: {error}"


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Inside, the signals of ENDS are like Ctrl-C; one that this process ignores, as under nohup, stays ignored."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    old = {number: signal.getsignal(number) for number in ENDS}
    for number, handler in old.items():
        if handler != signal.SIG_IGN:
            signal.signal(number, interrupt)
    try:
        yield
    except KeyboardInterrupt:
        raise Interrupted("stopped; finished trials are kept; the same command continues") from None
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
