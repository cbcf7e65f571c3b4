"""Ctrl-C and SIGTERM: the first asks a command to stop, the second ends its process at once."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator

STOP = (signal.SIGINT, signal.SIGTERM)
SHOW_CURSOR = "\x1b[?25h"  # a progress bar hides it


@contextlib.contextmanager
def stop_requests() -> Iterator[list[int]]:
    """A list that becomes non-empty at Ctrl-C or SIGTERM, for a run that obeys between two iterations."""
    received: list[int] = []
    old = {number: signal.signal(number, lambda number, _frame: received.append(number)) for number in STOP}
    try:
        yield received
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def second_signal_ends() -> Iterator[None]:
    """Inside, a second Ctrl-C or SIGTERM ends the process at once: one line, exit code 128 + the signal's number.

    A handler in Python runs in the main thread between two instructions of Python, so not while XLA computes. Python's
    handler in C writes the number to the wakeup descriptor at once, and a thread reads it there.
    """
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    old = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    threading.Thread(target=_watch, args=(reader,), daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(old)
        os.close(writer)


def _watch(reader: int) -> None:
    """End the process at the second number of STOP that `reader` gives; return when its other end is closed."""
    received = 0
    while number := os.read(reader, 1):
        received += number[0] in STOP
        if received == 2:
            cursor = SHOW_CURSOR if sys.stdout.isatty() else ""
            os.write(2, f"{cursor}stopped at once; what was saved before is kept\n".encode())
            os._exit(128 + number[0])
    os.close(reader)
