"""The process of a task: a command of this package that ends at once when the program that started it is gone.

Otherwise a task whose worker was killed would still write to its folder while another worker continues it.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import threading


def _end_with_starter() -> None:
    """End this process when its standard input is closed, which happens when its starter ends."""
    while os.read(sys.stdin.fileno(), 1):
        pass
    os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    threading.Thread(target=_end_with_starter, daemon=True).start()
    runpy.run_module("forgetmimic_jax", run_name="__main__", alter_sys=True)
