"""The commands that make a run, and its page, again."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from forgetmimic_jax.reporting.subject import Subject
from forgetmimic_jax.settings.config import Config, by_name


def flags_of(subject: Subject, base: Path | None) -> dict[str, Any]:
    """The flags of `unlearn` that a run was made with, as far as they are flags of their own.

    Args:
        subject: the run.
        base: where its base is now, if that is not where its settings say.
    """
    config = subject.info.config
    return {
        "robot": config.robot,
        "targets": ",".join(config.unlearn.targets),
        "method": config.unlearn.method,
        "penalty": config.unlearn.settings.get("penalty"),
        "iterations": config.iterations,
        "seed": config.seed,
        "base": base or (None if config.base is None else Path(config.base)),
        "episodes": subject.document.episodes,
        "library": None if config.library is None else Path(config.library),
    }


def settings_changed(config: Config, plain: Config) -> list[str]:
    """Values for `--set`: where a run's settings differ from those that its flags alone give."""
    default = by_name(plain)
    return [
        f"{name}={json.dumps(value, separators=(',', ':')) if isinstance(value, list) else value}"
        for name, value in by_name(config).items()
        if default[name] != value and name not in ("iterations", "base")
    ]


def words(flags: Mapping[str, Any], settings: Sequence[str] = ()) -> str:
    """Flags as they are typed; those of None are omitted."""
    typed = [
        f"--{flag} {value:g}" if isinstance(value, float) else f"--{flag} {value}"
        for flag, value in flags.items()
        if value is not None
    ]
    return " ".join([*typed, *(["--set", *settings] if settings else [])])
