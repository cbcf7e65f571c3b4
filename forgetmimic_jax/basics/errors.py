"""The one way a user learns of bad input: a clear line and exit code 2."""

from __future__ import annotations

import difflib
import os
import sys
from collections.abc import Callable, Iterable

from forgetmimic_jax.basics.drawing import draw_later
from forgetmimic_jax.basics.signals import second_signal_ends


class InputError(Exception):
    """Bad input: the message names the file, the field, what was found and what is accepted."""


class Interrupted(KeyboardInterrupt):
    """A run that was stopped: the message says what was saved and how to continue."""


def nearest(name: str, known: Iterable[str]) -> str:
    """`; did you mean 'x'?` for the closest known name, or the list of known names."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"did you mean '{close[0]}'?" if close else f"known: {', '.join(known) or 'none'}"


def run_command(command: Callable[[], None]) -> None:
    """Run a command's body; bad input, a full disk and Ctrl-C end it with one line.

    Exit codes: 2 for bad input or an operating system's refusal, 130 for Ctrl-C, 141 where nothing reads the output any
    more (`| head`), as a shell gives them. A second Ctrl-C or SIGTERM waits for nothing.
    """
    draw_later()
    try:
        with second_signal_ends():
            command()
        sys.stdout.flush()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes once more at its end
        sys.exit(141)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        print(f"error: {where}{error.strerror or error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt as stop:
        print(str(stop) or "interrupted", file=sys.stderr)
        sys.exit(130)
