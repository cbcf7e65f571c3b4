"""A policy's interface: the settings that say what it observes, what its actions do, and which bodies collide."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

from forgetmimic_jax.settings.config import ActionConfig, Config, by_name

INTERFACE = ("observation.", "action.", "physics.self_collision")


def with_interface(config: Config, base: Config) -> Config:
    """The config with the interface of a base.

    Of another robot's base only the action's mode is taken: its tables are of other joints.
    """
    action = base.action if base.robot == config.robot else ActionConfig(mode=base.action.mode)
    physics = dataclasses.replace(config.physics, self_collision=base.physics.self_collision)
    return dataclasses.replace(config, observation=base.observation, action=action, physics=physics)


def differences(one: Config, other: Config) -> Iterator[tuple[str, Any, Any]]:
    """The settings of the interface in which two configs differ: name, value of the one and of the other."""
    mine, theirs = by_name(one), by_name(other)
    for name in {**mine, **theirs}:
        if name.startswith(INTERFACE) and mine.get(name) != theirs.get(name):
            yield name, mine.get(name), theirs.get(name)
