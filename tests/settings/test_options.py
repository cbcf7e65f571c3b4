import dataclasses
from pathlib import Path

import pytest

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.settings.options import comma_separated, on_engine, override, replace_given


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("punch,kick", ("punch", "kick")),
        (" punch , kick ,", ("punch", "kick")),
        ("punch,kick,punch", ("punch", "kick")),
        ("", ()),
        (" , ", ()),
    ],
)
def test_names_between_commas(text, parts):
    assert comma_separated(text) == parts


@pytest.mark.parametrize(
    ("setting", "section", "name", "value"),
    [
        ("ppo.learning_rate=1e-4", "ppo", "learning_rate", 1e-4),
        ("ppo.learning_rate=2", "ppo", "learning_rate", 2.0),
        ("ppo.clip_value=false", "ppo", "clip_value", False),
        ("ppo.actor_layers=[64, 32]", "ppo", "actor_layers", (64, 32)),
        ("sampling.rule=uniform_bins", "sampling", "rule", "uniform_bins"),
        ("unlearn.targets=[punch]", "unlearn", "targets", ("punch",)),
        ("noise.reset_position=[0.1, 0.2, 0.3]", "noise", "reset_position", (0.1, 0.2, 0.3)),
    ],
)
def test_a_setting_replaces_one_value_and_no_other(setting, section, name, value):
    changed = dataclasses.replace(getattr(Config(), section), **{name: value})
    assert override(Config(), [setting]) == dataclasses.replace(Config(), **{section: changed})


def test_settings_of_the_run_itself_have_no_section():
    assert override(Config(), ["seed=7", "library=clips", "max_episode_steps=100"]) == dataclasses.replace(
        Config(), seed=7, library="clips", max_episode_steps=100
    )


def test_a_value_may_hold_an_equals_sign():
    assert override(Config(), ["library=a=b"]).library == "a=b"


def test_no_settings_change_nothing():
    assert override(Config(), []) == Config()


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("seed", "--set seed: accepted: SECTION.NAME=VALUE"),
        ("pppo.clip_range=1", "--set: no setting 'pppo'; did you mean 'ppo'?"),
        ("ppo.clip_range.x=1", "--set: ppo.clip_range: found {'x': 1}; accepted: a number above 0"),
        ("robot.x=1", "--set: robot: found {'x': 1}; accepted: text"),
        ("ppo.clip_rang=1", "--set: no setting 'ppo.clip_rang'; did you mean 'clip_range'?"),
        ("sed=1", "--set: no setting 'sed'; did you mean 'seed'?"),
        ("ppo=3", "--set: ppo: found 3; accepted: a table of settings"),
        ("ppo.epochs=many", "--set: ppo.epochs: found 'many'; accepted: a whole number from 1"),
        ("ppo.epochs=0", "--set: ppo.epochs: found 0; accepted: a whole number from 1"),
        ("ppo.epochs=", "--set: ppo.epochs: found None; accepted: a whole number from 1"),
        ("physics.engine=fast", "--set: physics.engine: found 'fast'; accepted: auto, native, mjx, mjx-warp"),
        ("ppo.actor_layers=[1", "--set ppo.actor_layers=[1: found '[1'; accepted: a number, a word or [a, list]"),
    ],
)
def test_a_bad_setting_is_refused_in_one_line(setting, message):
    with pytest.raises(InputError) as caught:
        override(Config(), [setting])
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_a_bad_value_of_another_flag_does_not_name_set():
    with pytest.raises(InputError, match=r"^seed: found -1; accepted: "):
        override(dataclasses.replace(Config(), seed=-1), ["ppo.epochs=3"])


def test_only_given_values_replace():
    config = replace_given(Config(), seed=None, robot="h2", library=Path("clips"))
    assert config == dataclasses.replace(Config(), robot="h2", library="clips")


def test_a_zero_is_given():
    assert replace_given(dataclasses.replace(Config(), seed=3), seed=0).seed == 0


def test_the_engine_replaces_the_configs_only_when_named():
    assert on_engine(Config(), "mjx").physics.engine == "mjx"
    assert on_engine(Config(), None) == Config()
