"""Where the shipped robots and clips are, and where a cache is kept."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

PACKAGE = Path(__file__).resolve().parents[1]


def shipped(folder: Literal["robots", "data"]) -> Path:
    """The folder `robots/` or `data/` of the project: inside an installed package, beside the package in a checkout."""
    inside = PACKAGE / "shipped" / folder
    return inside if inside.is_dir() else PACKAGE.parent / folder


def cache_folder() -> Path:
    """The user's folder for files that this project can make again; `XDG_CACHE_HOME` moves it."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "forgetmimic-jax"
