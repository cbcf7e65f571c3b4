import dataclasses
import importlib
import re

import pytest

from forgetmimic_jax.settings.options import parse

COMMANDS = ["train", "unlearn", "evaluate", "bench", "export", "import_policy", "play", "report", "video"]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_lists_every_option_with_its_default(command, capsys):
    options = importlib.import_module(f"forgetmimic_jax.{command}").Options
    with pytest.raises(SystemExit) as exit_:
        parse(options, command, ["--help"])
    assert exit_.value.code == 0
    text = re.sub(r"[\s│]+", " ", capsys.readouterr().out)
    assert f"usage: python -m forgetmimic_jax.{command} [-h]" in text
    for option in dataclasses.fields(options):
        assert f" --{option.name} " in text
        if option.default is not dataclasses.MISSING:
            assert f"(default: {option.default})" in text.split(f" --{option.name} ")[-1]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [(["--robto", "g1"], "--robot"), (["--iterations", "many"], "many"), (["--physics", "bullet"], "mjx-warp")],
)
def test_a_flag_that_is_none_is_told_with_what_would_be_one(arguments, told, capsys):
    from forgetmimic_jax.train import Options

    with pytest.raises(SystemExit) as exit_:
        parse(Options, "train", arguments)
    assert exit_.value.code == 2
    assert told in capsys.readouterr().err
