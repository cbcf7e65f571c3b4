"""From a motion file to a clip for a library: read, fitted to the robot, measured. Nothing is written here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.fit import fit, on_floor
from forgetmimic_jax.motion.library import file_hash
from forgetmimic_jax.motion.quality import Quality, measure
from forgetmimic_jax.motion.readers import Reading, read_motion
from forgetmimic_jax.robot.model import Robot

FPS = 50.0  # of every library: the control rate


@dataclass(frozen=True)
class Imported:
    """A clip at the control rate, its measures, and where it came from, for the manifest."""

    clip: Clip
    quality: Quality
    facts: dict[str, Any]


def import_motion(
    robot: Robot,
    file: Path,
    reading: Reading,
    *,
    start: float = 0.0,
    end: float | None = None,
    keep_height: bool = False,
) -> Imported:
    """Make a clip of a motion file.

    Args:
        robot: whose motion it is.
        file: the motion file.
        reading: how to read it.
        start: first second to take.
        end: last second to take; all by default.
        keep_height: leave the heights as they are, instead of setting the soles on the floor.

    Raises:
        InputError: the file is no motion of the robot, or holds no such seconds.
    """
    read = read_motion(robot, file, reading)
    clip, raised = fit(robot, read, FPS, start, end), 0.0
    if not keep_height:
        clip, raised = on_floor(robot, clip)
    facts = {
        "source": file.name,
        "source_sha256": file_hash(file),
        "source_fps": read.fps,
        "start": start,
        "end": end,
        "raised": round(raised, 5),
        "cyclic": False,
    }
    return Imported(clip, measure(robot, clip), facts)
