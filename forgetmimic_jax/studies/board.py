"""Progress and failures of many tasks in one table, which changes in place on a terminal."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence

from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from forgetmimic_jax.basics.console import say
from forgetmimic_jax.studies.task import Task

EVERY = 30.0  # s between two lines where there is no terminal
ORDER = ("running", "failed", "waiting", "finished")  # what changes stands at the top

Show = Callable[[Mapping[Task, str]], None]


class Board:
    """What is known of every task."""

    def __init__(self, description: str, tasks: Sequence[Task]):
        self._description, self._tasks = description, tasks
        self._states: dict[Task, str] = {}
        self._done: dict[Task, int] = {}
        self.look({})
        self._first, self._begun = sum(self._done.values()), time.monotonic()

    def look(self, failed: Mapping[Task, str]) -> list[str]:
        """See how far the tasks are; returns a line for each that has ended since the last look.

        Args:
            failed: tasks, each with its reason.
        """
        before, self._states = self._states, {task: _state(task, failed) for task in self._tasks}
        changed = [task for task in self._tasks if self._states[task] != before.get(task)]
        running = [task for task in self._tasks if _kind(self._states[task]) == "running"]
        self._done |= {task: task.iterations_done for task in (*changed, *running)}
        ended = [task for task in changed if before and _kind(self._states[task]) in ("finished", "failed")]
        return [_line(task, self._states[task]) for task in ended]

    def summary(self) -> str:
        """All tasks in one line."""
        kinds = Counter(map(_kind, self._states.values()))
        done, total = sum(self._done.values()), sum(task.iterations for task in self._tasks)
        rate = (done - self._first) / (time.monotonic() - self._begun + 1e-9)
        left = [f"{(total - done) / rate / 60:.0f} min left"] if rate and kinds["running"] else []
        counts = [f"{kinds[kind]} {kind}" for kind in reversed(ORDER) if kinds[kind]]
        return f"{self._description}: {done}/{total} iterations  {'  '.join([*counts, *left])}"

    def table(self) -> Group:
        """The line of all tasks, and a row for each."""
        table = Table()
        table.add_column("task", overflow="fold")
        table.add_column("iterations", justify="right", no_wrap=True)
        table.add_column("state", overflow="fold")
        for task in sorted(self._tasks, key=lambda task: ORDER.index(_kind(self._states[task]))):
            table.add_row(task.folder.name, f"{self._done[task]}/{task.iterations}", Text(self._states[task]))
        return Group(Text(self.summary()), table)


@contextlib.contextmanager
def board(description: str, tasks: Sequence[Task]) -> Iterator[Show]:
    """A table of the tasks; without a terminal a line for each that ends, and the table at the end.

    Yields:
        show(tasks that failed, each with its reason), to be called now and then.
    """
    console, known = Console(), Board(description, tasks)
    if console.is_terminal:
        with Live(known.table(), console=console, auto_refresh=False) as live:

            def change(failed: Mapping[Task, str]) -> None:
                known.look(failed)
                live.update(known.table(), refresh=True)

            yield change
        return

    printed = time.monotonic()

    def show(failed: Mapping[Task, str]) -> None:
        nonlocal printed
        lines = known.look(failed)
        if time.monotonic() - printed >= EVERY:
            printed = time.monotonic()
            lines.append(known.summary())
        for line in lines:
            say(line, console)

    say(known.summary(), console)
    try:
        yield show
    finally:
        console.print(known.table())


def _state(task: Task, failed: Mapping[Task, str]) -> str:
    if task in failed:
        return f"failed: {failed[task]}"
    if task.finished:
        return "finished"
    with contextlib.suppress(FileNotFoundError):
        return f"running on {task.mark.read_text().partition(' ')[0]}"
    return "waiting"


def _kind(state: str) -> str:
    return state.split(":")[0].split()[0]


def _line(task: Task, state: str) -> str:
    kind, _, reason = state.partition(": ")
    return f"{kind}: {task.folder.name}" + (f": {reason} ({task.log})" if reason else "")
