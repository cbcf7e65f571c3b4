import dataclasses
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

from forgetmimic_jax import __main__ as program
from forgetmimic_jax import unlearn
from forgetmimic_jax.settings.options import parse
from forgetmimic_jax.unlearning.registry import find_method

PACKAGE = Path(program.__file__).parent
HEAVY = {"numpy", "jax", "mujoco", "scipy", "matplotlib", "orbax"}  # what `--help` need not wait for


def run(monkeypatch, *arguments: str) -> int:
    """The exit code of `forgetmimic ARGUMENTS`."""
    monkeypatch.setattr(sys, "argv", ["forgetmimic", *arguments])
    try:
        program.main()
    except SystemExit as exit_:
        return exit_.code
    return 0


def test_the_commands_are_the_modules_at_the_top_of_the_package():
    files = {path.stem.replace("_", "-") for path in PACKAGE.glob("*.py")}
    assert set(program.commands()) == files - {"--init--", "--main--", "robots"} | {"robot"}


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_without_a_command_the_program_lists_them_with_a_line_each(monkeypatch, capsys, arguments):
    assert run(monkeypatch, *arguments) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "usage: forgetmimic COMMAND [flags]"
    assert "  unlearn        Forget chosen clips" in lines
    assert "  import-policy  Make a base of policies of other projects" in lines
    listed = [line.split() for line in lines if line.startswith("  ")]
    assert [name for name, *_ in listed] == list(program.commands())
    assert all(words for _, *words in listed)


def test_an_unknown_command_is_refused_with_the_nearest_name(monkeypatch, capsys):
    assert run(monkeypatch, "unlern", "--robot", "g1") == 2
    assert capsys.readouterr() == ("", "error: no command 'unlern'; did you mean 'unlearn'?\n")


def test_a_command_gets_the_arguments_after_its_name(monkeypatch, capsys):
    assert run(monkeypatch, "import-policy", "model.h5", "--seed", "-1") == 2
    assert capsys.readouterr() == ("", "error: --seed: found -1; accepted: 0 or more\n")


@pytest.mark.parametrize("command", [name for name in program.commands() if name not in ("motions", "robot")])
def test_help_lists_every_option_with_its_default(command, capsys):
    options = importlib.import_module(f"forgetmimic_jax.{command.replace('-', '_')}").Options
    with pytest.raises(SystemExit) as exit_:
        parse(options, command, ["--help"])
    assert exit_.value.code == 0
    text = re.sub(r"[\s│]+", " ", capsys.readouterr().out)
    assert f"usage: forgetmimic {command} [-h]" in text
    for option in dataclasses.fields(options):
        flag = f" --{option.name.replace('_', '-')} "
        assert flag in text or option.name in ("kind", "files")  # which is positional
        if isinstance(option.default, str | int | float | Path):
            assert f"(default: {option.default})" in text.split(flag)[-1]


def test_help_waits_for_no_heavy_import():
    """Every command's module, imported one after the other in a fresh process; each line names what it brought."""
    code = (
        "import importlib, sys\n"
        "for name in sys.argv[2:]:\n"
        "    importlib.import_module(f'forgetmimic_jax.{name}')\n"
        "    print(name, *sorted(set(sys.argv[1].split()) & set(sys.modules)))"
    )
    modules = [program.module_of(name) for name in program.commands()]
    printed = subprocess.run(
        [sys.executable, "-c", code, " ".join(HEAVY), *modules], capture_output=True, text=True, check=True
    )
    assert printed.stdout.splitlines() == modules


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--robto", "g1"], "--robot"), (["--iterations", "many"], "many"), (["--physics", "bullet"], "mjx-warp")],
)
def test_a_wrong_flag_is_refused_with_what_is_accepted(arguments, message, capsys):
    from forgetmimic_jax.train import Options

    with pytest.raises(SystemExit) as exit_:
        parse(Options, "train", arguments)
    assert exit_.value.code == 2
    assert message in capsys.readouterr().err


def test_the_help_of_unlearn_has_the_methods_own_iterations(capsys):
    with pytest.raises(SystemExit):
        parse(unlearn.Options, "unlearn", ["--help"])
    text = re.sub(r"[\s│]+", " ", capsys.readouterr().out)
    arft, distill, stand = (find_method(name).pace.iterations for name in ("arft", "distill", "stand"))
    by_preset = f"{arft['paper']}, {distill['paper']} and {stand['paper']}"
    given = (
        f"{arft['cpu']} by default, distill: {distill['cpu']}, stand: {stand['cpu']} (with --preset paper {by_preset})"
    )
    assert f"PPO iterations; {given}, retrain: as many steps as the base was trained for." in text
