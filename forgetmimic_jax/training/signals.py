"""Ctrl-C and SIGTERM as a request that a run obeys between two iterations."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator


@contextlib.contextmanager
def stop_requests() -> Iterator[list[int]]:
    """A list that becomes non-empty at Ctrl-C or SIGTERM; a second one interrupts at once."""
    received: list[int] = []

    def request(number: int, _frame: object) -> None:
        if received:
            raise KeyboardInterrupt
        received.append(number)

    old = {number: signal.signal(number, request) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, handler in old.items():
            signal.signal(number, handler)
