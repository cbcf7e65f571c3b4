import io
from pathlib import Path

from rich.console import Console

from forgetmimic_jax.basics.console import closing, command_line, progress


def test_without_a_terminal_there_are_plain_lines():
    console = Console(file=io.StringIO(), force_terminal=False, width=40)
    with progress("training", 3, every_seconds=1e6, console=console) as show:
        for iteration in (1, 2, 3):
            show(iteration, 100 * iteration, {"tracking_reward": 0.5})
    lines = console.file.getvalue().splitlines()
    assert lines[0] == "training: 0/3"
    assert len(lines) == 2  # the interval has not passed: only the start and the end
    assert lines[1].startswith("training: 3/3  0 min left  ")
    assert lines[1].endswith("steps/s  tracking reward 0.5")


def test_what_may_end_sooner_has_at_most_so_long_left():
    console = Console(file=io.StringIO(), force_terminal=False, width=40)
    with progress("forget", 3, at_most=True, every_seconds=0.0, console=console) as show:
        for iteration in (1, 2, 3):
            show(iteration, 100 * iteration, {})
    assert console.file.getvalue().splitlines()[-1].startswith("forget: 3/3  at most 0 min left  ")


def test_closing_names_files_and_the_next_command_unbroken():
    console = Console(file=io.StringIO(), force_terminal=False, width=20)
    closing(
        {"table": Path("runs/a/long/enough/to/wrap/evaluation.md")}, "make evaluate CHECKPOINT=[x]", console=console
    )
    assert "table  runs/a/long/enough/to/wrap/evaluation.md\n" in console.file.getvalue()
    assert console.file.getvalue().endswith("Next: make evaluate CHECKPOINT=[x]\n")


def test_make_is_answered_with_targets_of_make(monkeypatch):
    monkeypatch.setenv("MAKELEVEL", "1")
    assert command_line("train", robot="g1", base=None, resume=True) == "make train ROBOT=g1 RESUME=1"
    assert command_line("motions", "show kick", library=Path("a b")) == "make motions ARGS='show kick' LIBRARY='a b'"


def test_the_program_is_answered_with_its_own_flags(monkeypatch):
    monkeypatch.delenv("MAKELEVEL", raising=False)
    assert command_line("train", robot="g1", base=None, resume=True) == "forgetmimic train --robot g1 --resume"
    assert command_line("motions", "show kick", library=Path("a b")) == "forgetmimic motions show kick --library 'a b'"
