"""What the options of the commands share: parsing, checks, and settings given with --set."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro
import yaml

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.settings.checked import from_dict
from forgetmimic_jax.settings.config import Config, EngineName, PhysicsConfig, SamplingConfig, to_dict

T = TypeVar("T")
C = TypeVar("C", Config, PhysicsConfig, SamplingConfig)

# A list for each --set: a later one adds to an earlier one and does not replace it.
Settings = Annotated[list[list[str]], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="SECTION.NAME=VALUE")]


def parse(options: type[T], command: str, arguments: Sequence[str] | None = None) -> T:
    """The command line, or `arguments`, as `options`; an unknown flag or a wrong value ends it with exit code 2."""
    return tyro.cli(options, prog=f"forgetmimic {command}", args=arguments, config=(tyro.conf.FlagCreatePairsOff,))


def flags_of(options: Any) -> tuple[str, ...]:
    """The command line of those options that are not the defaults."""
    flags: list[str] = []
    for option in dataclasses.fields(options):
        value, default = getattr(options, option.name), option.default
        if option.name == "set":
            value, default = list(itertools.chain(*value)), []
        if value != default:
            values = value if isinstance(value, list) else [] if value is True else [value]
            flags += [f"--{option.name.replace('_', '-')}", *map(str, values)]
    return tuple(flags)


def check_same(options: Any, saved: dict[str, Any]) -> None:
    """InputError for a flag that contradicts the `saved` settings of the run to resume."""
    for name, value in saved.items():
        given = getattr(options, name)
        if given != getattr(type(options), name) and str(given) != str(value):
            raise InputError(f"--{name}: found {given}, but the run to resume has {value}; leave the flag out")


def at_least(minimum: int, flag: str, value: int) -> None:
    """InputError unless the value given for `flag` is `minimum` or more."""
    if value < minimum:
        raise InputError(f"{flag}: found {value}; accepted: {minimum} or more")


def comma_separated(text: str) -> tuple[str, ...]:
    """'punch,kick' → ('punch', 'kick'); spaces and empty parts do not matter."""
    return tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))


def override(config: Config, settings: Iterable[str]) -> Config:
    """The config with settings of the form 'ppo.learning_rate=1e-4' replaced.

    Raises:
        InputError: not of that form, an unknown setting, or a value that is not accepted.
    """
    content = to_dict(config)
    from_dict(Config, content)  # a bad value of another flag is not of --set
    for setting in settings:
        path, separator, text = setting.partition("=")
        if not separator:
            raise InputError(f"--set {setting}: accepted: SECTION.NAME=VALUE, such as ppo.learning_rate=1e-4")
        *sections, name = path.split(".")
        table: dict[str, Any] = content
        for section in sections:
            if not isinstance(table.get(section), dict):
                table[section] = {}  # no such section, which `from_dict` says
            table = table[section]
        try:
            table[name] = yaml.safe_load(text)
        except yaml.YAMLError:
            raise InputError(f"--set {setting}: found '{text}'; accepted: a number, a word or [a, list]") from None
    return from_dict(Config, content, "--set", strict=False)  # YAML reads 1e-4 as text


def replace_given(config: C, **values: Any) -> C:
    """The config with every value that is not None replaced; a path becomes text, as the config holds it."""
    given: dict[str, Any] = {
        name: str(value) if isinstance(value, Path) else value for name, value in values.items() if value is not None
    }
    return dataclasses.replace(config, **given)


def on_engine(config: Config, engine: EngineName | None) -> Config:
    """The config on another physics engine, if one is named."""
    return dataclasses.replace(config, physics=replace_given(config.physics, engine=engine))
