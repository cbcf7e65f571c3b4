"""The Makefile's targets are the program's commands."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from forgetmimic_jax import __main__ as program

CHECKOUT = Path(program.__file__).parents[1]

pytestmark = pytest.mark.skipif(not shutil.which("make"), reason="no make")


def make(*arguments: str) -> str:
    """What `make ARGUMENTS` prints."""
    return subprocess.run(
        ["make", "--no-print-directory", *arguments], cwd=CHECKOUT, capture_output=True, text=True, check=True
    ).stdout


def test_make_help_lists_every_command():
    assert set(program.commands()) <= set(re.findall("^  ([a-z-]+) ", make("help"), re.MULTILINE))


@pytest.mark.parametrize("command", program.commands())
def test_every_command_has_a_rule(command):
    """-o: as if .venv were made."""
    line = make("-n", "-o", ".venv/.installed", command, "ARGS=a.onnx --std 0.5", "ROBOT=h2").splitlines()[-1]
    assert line.startswith(f".venv/bin/python -m forgetmimic_jax {command} ")
    assert line.endswith(" a.onnx --std 0.5 --robot 'h2'")
