"""Dataclasses from plain dicts, with every name, type and bound checked.

A bound is part of a field's type, such as `Share`; its description stands in the message.
"""

from __future__ import annotations

import builtins
import re
import sys
import typing
from collections.abc import Mapping
from dataclasses import is_dataclass
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

from forgetmimic_jax.basics.errors import InputError, nearest

T = TypeVar("T")

LARGEST = sys.float_info.max
Amount = Annotated[float, Meta(ge=0, le=LARGEST, description="a number from 0")]
Positive = Annotated[float, Meta(gt=0, le=LARGEST, description="a number above 0")]
BodyWeights = Annotated[float, Meta(ge=0, le=100, description="0 to 100 body weights")]
Share = Annotated[float, Meta(ge=0, le=1, description="a number from 0 to 1")]
Weight = Annotated[float, Meta(ge=-LARGEST, le=LARGEST, description="a finite number")]
Angle = Annotated[float, Meta(ge=-LARGEST, le=LARGEST, description="a finite number of rad")]
NotComputed = Annotated[float, Meta(ge=0, le=0, description="0 (this term is not computed)")]
Count = Annotated[int, Meta(ge=1, description="a whole number from 1")]
Period = Annotated[int, Meta(ge=0, description="a whole number from 0")]
Seed = Annotated[int, Meta(ge=0, lt=2**32, description="a whole number from 0 to 4294967295")]
Vector = tuple[Amount, Amount, Amount]
Interval = tuple[Amount, Amount]


def from_dict(cls: type[T], content: Any, where: str = "", *, strict: bool = True) -> T:
    """A config, or a section of one, from a plain dict; a setting that is left out has its default.

    Args:
        cls: the dataclass.
        content: the dict.
        where: what to name first in a message, such as the file.
        strict: without it, text such as '1e-4' counts as the number it spells.

    Raises:
        InputError: an unknown setting, or a value of the wrong type or out of bounds.
    """
    where = f"{where}: " if where else ""
    _check_names(cls, content, where)
    try:
        return msgspec.convert(content, cls, strict=strict)
    except msgspec.ValidationError as error:
        # The message ends with the place of the value, such as `$.ppo.actor_layers[1]`.
        hint: Any = cls
        path = re.findall(r"\w+", str(error).partition(" - at `$")[2])
        for key in path:
            content = content[int(key) if key.isdigit() else key]
            hint = get_args(hint)[0] if key.isdigit() else get_type_hints(hint, include_extras=True)[key]
        setting = ".".join(key for key in path if not key.isdigit())
        name = f"{setting}: " if setting else ""
        raise InputError(f"{where}{name}found {content!r}; accepted: {_accepted(hint)}") from None


def _check_names(cls: Any, content: Any, where: str, section: str = "") -> None:
    """InputError for a name that is no setting: msgspec would pass over it."""
    if not isinstance(content, Mapping):
        return
    hints = get_type_hints(cls)
    for name, value in content.items():
        if name not in hints:
            raise InputError(f"{where}no setting '{section}{name}'; {nearest(str(name), hints)}")
        if is_dataclass(hints[name]):
            _check_names(hints[name], value, where, f"{section}{name}.")


def _accepted(hint: Any) -> str:
    """A type of the config in words."""
    match get_origin(hint), get_args(hint):
        case typing.Annotated, (_, meta):
            return meta.description
        case typing.Literal, names:
            return ", ".join(map(str, names))
        case builtins.tuple, (item, *others):
            count = "" if others == [...] else f" {len(others) + 1}"
            return f"a list of{count}: {_accepted(item)}"
        case builtins.dict, (_, value):
            return f"a table of: {_accepted(value)}"
        case _, (first, *_):  # first | None
            return _accepted(first)
    return {bool: "true or false", float: "a number", str: "text"}.get(hint, "a table of settings")
