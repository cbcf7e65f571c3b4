"""The roles of a robot: which bodies, joints and motors of its MJCF are which, read from its YAML."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import mujoco
import yaml

from forgetmimic_jax.basics.errors import InputError, nearest
from forgetmimic_jax.robot.check import first_match, misfits
from forgetmimic_jax.robot.sides import Pairs
from forgetmimic_jax.robot.vendor import Additions, Unreadable, compiled, read_mjcf

T = TypeVar("T")


@dataclass(frozen=True)
class Motor:
    """One kind of motor."""

    armature: float  # reflected inertia, kg m^2
    effort: float  # torque limit, N m
    velocity: float  # no-load speed, rad/s


@dataclass(frozen=True)
class Roles:
    """A robot's YAML. Bodies and joints are names; a pattern is a regular expression for a joint's whole name."""

    model: str  # the MJCF's file name
    anchor: str
    key_bodies: tuple[str, ...]
    end_effectors: tuple[str, ...]
    pairs: Pairs[str]
    head: tuple[str, ...]  # shapes that touch the floor; none for a robot without a head
    natural_frequency_hz: float
    damping_ratio: float
    soft_limit_factor: float
    default_height: float  # of the root in the default pose, m
    motors: Mapping[str, Motor]
    joint_motors: tuple[tuple[str, str], ...]  # (pattern, motor): the first pattern that matches gives the motor
    ignored_motors: tuple[str, ...]  # patterns of the joints whose motor load does not count
    default_pose: Mapping[str, float]  # rad; a joint that is not named is 0
    # What a vendor's MJCF lacks; see `vendor.Additions`.
    fixed: tuple[str, ...]
    ranges: Mapping[str, tuple[float, float]]
    spheres: tuple[tuple[str, float, float, float, float], ...]
    variants: Mapping[str, tuple[str, ...]]  # patterns of the joints that a variant lacks, by its name

    def motor_of(self, joint: str) -> Motor:
        """The motor of a joint."""
        return self.motors[first_match(self.joint_motors, joint) or ""]

    def counts_motor_of(self, joint: str) -> bool:
        """Whether the load of a joint's motor counts."""
        return not any(re.fullmatch(pattern, joint) for pattern in self.ignored_motors)


def read_roles(path: Path) -> tuple[Roles, mujoco.MjSpec]:
    """Read a robot's YAML and check it against the MJCF that it names, a file in the same folder.

    Returns:
        The roles, and the MJCF: mended where it is a vendor's, with the shapes that are only seen.

    Raises:
        InputError: not YAML; or every field that is missing, unknown, wrong or at odds with the MJCF, one a line.
    """
    try:
        content = yaml.safe_load(path.read_bytes())
    except yaml.YAMLError as error:
        raise InputError(f"{path}: not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: found {content!r}; accepted: a table of {', '.join(FIELDS)}")
    problems = [f"unknown field '{name}'; {nearest(str(name), FIELDS)}" for name in content if name not in FIELDS]
    content = {**OPTIONAL, **content}
    problems += [f"missing field '{name}'" for name in FIELDS if name not in content]
    values: dict[str, Any] = {}
    for name in FIELDS:
        if name in content:
            try:
                values[name] = FIELDS[name](content[name])
            except _Wrong as wrong:
                problems += [f"{name}: {line}" for line in wrong.args]
    if "model" in values:
        try:
            spec, model = _read_model(path.parent / values["model"], values)
            problems += misfits(values, model)
        except _Wrong as wrong:
            problems += [f"model: {line}" for line in wrong.args]
    if problems:
        raise InputError("\n".join(f"{path}: {problem}" for problem in problems))
    return Roles(**values), spec


class _Wrong(Exception):
    """What is wrong with a field, a line an argument."""


def _read_model(file: Path, values: Mapping[str, Any]) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """The MJCF, mended, and what it compiles to."""
    if not file.is_file():
        raise _Wrong(f"no file '{file.name}'")
    additions = {name: values[name] for name in ("fixed", "ranges", "spheres") if name in values}
    try:
        spec, _ = read_mjcf(file, Additions(**additions))
        return spec, compiled(spec.copy())[0]
    except Unreadable as error:
        raise _Wrong(str(error)) from None
    except ValueError as error:
        raise _Wrong(f"{file.name}: {' '.join(str(error).split())}") from None


def _name(value: Any) -> str:
    if not isinstance(value, str) or not value:
        raise _Wrong(f"found {value!r}; accepted: a name")
    return value


def _names(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list):
        raise _Wrong(f"found {value!r}; accepted: a list of names")
    names = tuple(_name(item) for item in value)
    for name in names:
        if names.count(name) > 1:
            raise _Wrong(f"'{name}' stands there twice")
    return names


def _pair(value: Any) -> tuple[str, str]:
    names = _names(value)
    if len(names) != 2:
        raise _Wrong(f"found {len(names)} names; accepted: two, left and right")
    return names[0], names[1]


def _pattern(value: Any) -> str:
    try:
        re.compile(_name(value))
    except re.error as error:
        raise _Wrong(f"'{value}' is no regular expression ({error})") from None
    return value


def _patterns(value: Any) -> tuple[str, ...]:
    return tuple(_pattern(pattern) for pattern in _names(value))


def _rules(value: Any) -> tuple[tuple[str, str], ...]:
    if not isinstance(value, list) or not all(isinstance(rule, list) and len(rule) == 2 for rule in value):
        raise _Wrong(f"found {value!r}; accepted: a list of [pattern, motor]")
    return tuple((_pattern(pattern), _name(motor)) for pattern, motor in value)


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise _Wrong(f"found {value!r}; accepted: a finite number")
    return float(value)


def _limits(value: Any) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise _Wrong(f"found {value!r}; accepted: [lower, upper] in rad")
    lower, upper = map(_number, value)
    if lower >= upper:
        raise _Wrong(f"found {value!r}; accepted: the lower limit first")
    return lower, upper


def _spheres(value: Any) -> tuple[tuple[str, float, float, float, float], ...]:
    if not isinstance(value, list) or not all(isinstance(sphere, list) and len(sphere) == 5 for sphere in value):
        raise _Wrong(f"found {value!r}; accepted: a list of [body, x, y, z, radius], in m")
    return tuple(
        (_name(body), _number(x), _number(y), _number(z), _positive(radius)) for body, x, y, z, radius in value
    )


def _positive(value: Any) -> float:
    if _number(value) <= 0.0:
        raise _Wrong(f"found {value:g}; accepted: above 0")
    return float(value)


def _share(value: Any) -> float:
    if _positive(value) > 1.0:
        raise _Wrong(f"found {value:g}; accepted: above 0, at most 1")
    return float(value)


def _table(value: Any, read: Callable[[Any], T]) -> dict[str, T]:
    """A table by name, each entry read; every wrong entry is a line."""
    if not isinstance(value, dict):
        raise _Wrong(f"found {value!r}; accepted: a table by name")
    entries, problems = {}, []
    for name, entry in value.items():
        try:
            entries[str(name)] = read(entry)
        except _Wrong as wrong:
            problems += [f"{name}: {line}" for line in wrong.args]
    if problems:
        raise _Wrong(*problems)
    return entries


def _record(cls: type[T], value: Any, read: Callable[[Any], Any]) -> T:
    """A dataclass from a table of its fields, each read alike."""
    entries, names = _table(value, read), [field.name for field in fields(cls)]  # type: ignore[arg-type]
    problems = [f"missing '{name}'" for name in names if name not in entries]
    problems += [f"unknown '{name}'; {nearest(name, names)}" for name in entries if name not in names]
    if problems:
        raise _Wrong(*problems)
    return cls(**entries)


FIELDS: Mapping[str, Callable[[Any], Any]] = {
    "model": _name,
    "anchor": _name,
    "key_bodies": _names,
    "end_effectors": _names,
    "pairs": lambda value: _record(Pairs, value, _pair),
    "head": _names,
    "natural_frequency_hz": _positive,
    "damping_ratio": _positive,
    "soft_limit_factor": _share,
    "default_height": _positive,
    "motors": lambda value: _table(value, lambda motor: _record(Motor, motor, _positive)),
    "joint_motors": _rules,
    "ignored_motors": _patterns,
    "default_pose": lambda value: _table(value, _number),
    "fixed": _patterns,
    "ranges": lambda value: _table(value, _limits),
    "spheres": _spheres,
    "variants": lambda value: _table(value, _patterns),
}
OPTIONAL: Mapping[str, Any] = {"fixed": [], "ranges": {}, "spheres": [], "variants": {}}
