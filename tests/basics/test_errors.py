import errno
import os
import subprocess
import sys

import pytest

from forgetmimic_jax.basics.errors import InputError, nearest, run_command


def raising(error):
    def command():
        raise error

    return command


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (InputError("a.npz: fps: found 0"), 2, "error: a.npz: fps: found 0"),
        (OSError(errno.ENOSPC, "No space left on device", "runs/a"), 2, "error: runs/a: No space left on device"),
        (PermissionError(errno.EACCES, "Permission denied", "runs"), 2, "error: runs: Permission denied"),
        (OSError("odd"), 2, "error: odd"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_a_failure_is_one_line_and_an_exit_code(capsys, error, code, line):
    with pytest.raises(SystemExit) as exit_:
        run_command(raising(error))
    assert exit_.value.code == code
    assert capsys.readouterr() == ("", line + "\n")


@pytest.mark.parametrize("lines", [1, 100_000])
def test_a_reader_that_leaves_ends_a_command_without_a_word(lines):
    """`| head`: the output may be flushed by a print or at the end of the command."""
    program = f"from forgetmimic_jax.basics.errors import run_command; run_command(lambda: print('a\\n' * {lines}))"
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([sys.executable, "-c", program], stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, "")


def test_a_bug_keeps_its_traceback():
    with pytest.raises(ZeroDivisionError):
        run_command(raising(ZeroDivisionError()))


def test_nearest_name_or_all_of_them():
    assert nearest("spin_kick", ["spinkick", "walk"]) == "did you mean 'spinkick'?"
    assert nearest("zzz", ["spinkick", "walk"]) == "known: spinkick, walk"
    assert nearest("zzz", iter([])) == "known: none"
