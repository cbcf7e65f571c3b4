"""The process of a task: a command of this package that ends at once when the program that started it is gone.

Otherwise a task whose worker was killed would still write to its folder while another worker continues it. It also ends
where its code is not that of its starter, as after a commit: the checkout is read when the process starts.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import threading

CODE = "FORGETMIMIC_CODE"  # the environment variable with the `code_hash` of the program that started this one


def _end_with_starter() -> None:
    """End this process when its standard input is closed, which happens when its starter ends."""
    while os.read(sys.stdin.fileno(), 1):
        pass
    os.kill(os.getpid(), signal.SIGKILL)


def _check_code(wanted: str) -> None:
    """End with a message where this process has other code."""
    from forgetmimic_jax.basics.provenance import provenance

    here = provenance().code
    if here != wanted:
        sys.exit(f"error: the checkout has changed: found code {here}; accepted: {wanted}, which wants the task")


if __name__ == "__main__":
    _check_code(os.environ.pop(CODE))
    threading.Thread(target=_end_with_starter, daemon=True).start()
    runpy.run_module("forgetmimic_jax", run_name="__main__", alter_sys=True)
