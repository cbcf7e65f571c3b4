"""The library that MuJoCo draws with: what draws loads it (viewing/offscreen.py), and nothing else does."""

from __future__ import annotations

import os

CHOICE = "FORGETMIMIC_GL"  # the value that the user gave MUJOCO_GL, also for the processes that this one starts


def draw_later() -> None:
    """Keep MuJoCo from loading the library that MUJOCO_GL names as soon as it is imported.

    It would fail in a container without that library, also for a command that draws nothing.
    """
    os.environ.setdefault(CHOICE, os.environ.get("MUJOCO_GL", ""))
    os.environ["MUJOCO_GL"] = "disable"


def chosen_library() -> str:
    """What the user chose, such as `egl`; empty: nothing."""
    return os.environ.get(CHOICE, os.environ.get("MUJOCO_GL", "")).lower()
