"""What the commands' options have in common: preset, overrides and where a run goes."""

from __future__ import annotations

import dataclasses
from typing import Any

import yaml

from forgetmimic_jax.config import Config, from_dict, to_dict
from forgetmimic_jax.errors import InputError


def comma_separated(text: str) -> tuple[str, ...]:
    """'punch,kick' → ('punch', 'kick'); spaces and empty parts do not matter."""
    return tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))


def override(config: Config, settings: list[str]) -> Config:
    """The config with settings of the form 'ppo.learning_rate=1e-4' replaced.

    Raises:
        InputError: not of that form, an unknown setting or a value of the wrong type.
    """
    content = to_dict(config)
    for setting in settings:
        path, separator, text = setting.partition("=")
        if not separator:
            raise InputError(f"--set {setting}: expected SECTION.NAME=VALUE, such as ppo.learning_rate=1e-4")
        *sections, name = path.split(".")
        table: Any = content
        for section in sections:
            if not isinstance(table.get(section), dict):
                raise InputError(f"--set {setting}: no section '{section}'; known: {', '.join(content)}")
            table = table[section]
        table[name] = _value(text)
    return from_dict(Config, content, "--set")


def _value(text: str) -> Any:
    value = yaml.safe_load(text)
    if isinstance(value, str):
        try:
            return float(value)  # YAML 1.1 reads 1e-4 as a string
        except ValueError:
            return value
    return value


def replace_given(config: Config, **values: Any) -> Config:
    """The config with every value that is not None replaced."""
    return dataclasses.replace(config, **{name: value for name, value in values.items() if value is not None})
