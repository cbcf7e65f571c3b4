"""What a long command says while it works and when it ends."""

from __future__ import annotations

import os
import shlex
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

# Iterations done, environment steps done, and metrics to show.
Show = Callable[[int, int, Mapping[str, float]], None]


@contextmanager
def progress(
    description: str,
    total_iterations: int,
    *,
    start: int = 0,
    at_most: bool = False,
    every_seconds: float = 30.0,
    console: Console | None = None,
) -> Iterator[Show]:
    """A progress bar with time left, environment steps per second and live metrics; plain lines without a terminal.

    Args:
        description: what is being done.
        total_iterations: where it ends.
        start: iterations already done, on a resume.
        at_most: whether it may end sooner.
        every_seconds: between two plain lines.
        console: where to write; the standard output by default.

    Yields:
        show(iterations done, environment steps done, metrics), to be called after each iteration. Time before the first
        call is not counted: it is compilation.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = console or Console()
    clock, bound = _Clock(), "at most " if at_most else ""
    if console.is_terminal:
        columns = (TextColumn("{task.description}"), BarColumn(bar_width=20), MofNCompleteColumn())
        times = (TimeElapsedColumn(), TextColumn(f"{bound}left"), TimeRemainingColumn(compact=True))
        with Progress(*columns, *times, TextColumn("{task.fields[live]}"), console=console) as bar:
            task = bar.add_task(description, total=total_iterations, completed=start, live="compiling")
            yield lambda done, steps, metrics: bar.update(
                task, completed=done, live=_live(clock.rates(done, steps)[1], metrics)
            )
        return

    last_line = time.monotonic()

    def show(done: int, steps: int, metrics: Mapping[str, float]) -> None:
        nonlocal last_line
        iteration_rate, step_rate = clock.rates(done, steps)
        if done >= total_iterations or time.monotonic() - last_line >= every_seconds:
            last_line = time.monotonic()
            minutes = (total_iterations - done) / iteration_rate / 60 if iteration_rate else None
            left = "" if minutes is None else f"{bound}{minutes:.0f} min left  "
            say(f"{description}: {done}/{total_iterations}  {left}{_live(step_rate, metrics)}", console)

    say(f"{description}: {start}/{total_iterations}", console)
    yield show


def command_line(command: str, *words: str, **flags: object) -> str:
    """What to type for a command: a target of make where make started this process, otherwise `forgetmimic COMMAND`.

    Args:
        command: its name.
        words: what comes before the flags, such as `check` of `motions check`.
        flags: values by name; None leaves a flag out, True stands for a flag without a value.
    """
    given = {name: value for name, value in flags.items() if value is not None}
    if "MAKELEVEL" in os.environ:
        arguments = [f"ARGS={_word(' '.join(words))}"] if words else []
        arguments += [f"{name.upper()}={_word(value)}" for name, value in given.items()]
        return " ".join(["make", command, *arguments])
    parts = [f"--{name}" if value is True else f"--{name} {_word(value)}" for name, value in given.items()]
    return " ".join(["forgetmimic", command, *words, *parts])


def _word(value: object) -> str:
    return "1" if value is True else shlex.quote(str(value))


def closing(files: Mapping[str, Path], next_command: str, *, console: Console | None = None) -> None:
    """Where the results went (what they are: path), and what to try next."""
    width = max((len(what) for what in files), default=0)
    lines = [f"{what:<{width}}  {path}" for what, path in files.items()]
    say("\n".join(["", *lines, "", f"Next: {next_command}"]), console)


def say(text: str, console: Console | None = None) -> None:
    """Print text as it is, on the standard output by default; a terminal breaks what is too long for a line."""
    from rich.console import Console

    (console or Console()).print(text, highlight=False, markup=False, soft_wrap=True)


def warn(text: str) -> None:
    """A line on the standard error about what is wrong but does not stop the command."""
    from rich.console import Console

    say(f"warning: {text}", Console(stderr=True))


@dataclass
class _Clock:
    """Iterations and environment steps per second since the first report."""

    first: tuple[float, int, int] | None = None

    def rates(self, done: int, steps: int) -> tuple[float, float]:
        now = time.monotonic()
        self.first = self.first or (now, done, steps)
        seconds = max(now - self.first[0], 1e-9)
        return (done - self.first[1]) / seconds, (steps - self.first[2]) / seconds


def _live(step_rate: float, metrics: Mapping[str, float]) -> str:
    rate = [f"{step_rate:,.0f} steps/s"] if step_rate else []
    return "  ".join([*rate, *(f"{name.replace('_', ' ')} {value:.3g}" for name, value in metrics.items())])
