"""Waiting for what another thread or process does."""

import time
from collections.abc import Callable

LIMIT = 600.0  # s, far above what a busy machine needs: only what never happens takes longer


def until(true: Callable[[], bool]) -> None:
    """Return as soon as `true()`."""
    end = time.monotonic() + LIMIT
    while not true():
        assert time.monotonic() < end, "it never happens"
        time.sleep(0.01)
