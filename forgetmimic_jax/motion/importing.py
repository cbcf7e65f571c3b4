"""From a motion file to a clip for a library: read, fitted to the robot, measured. Nothing is written here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.fit import check_touches, fit, lowest_points, on_floor
from forgetmimic_jax.motion.library import file_hash
from forgetmimic_jax.motion.quality import Quality, measure
from forgetmimic_jax.motion.readers import read_motion
from forgetmimic_jax.motion.recording import Reading
from forgetmimic_jax.motion.roughness import stretches_in_the_air
from forgetmimic_jax.robot.model import Robot

FPS = 50.0  # of every library: the control rate


@dataclass(frozen=True)
class Imported:
    """A clip at the control rate, and how it became that."""

    clip: Clip
    quality: Quality
    facts: dict[str, Any]  # where it came from, for the manifest
    notes: tuple[str, ...]  # what was taken from where, compared, converted, moved


def import_motion(robot: Robot, file: Path, reading: Reading, *, keep_height: bool = False) -> Imported:
    """Make a clip of a motion file.

    Args:
        robot: whose motion it is.
        file: the motion file.
        reading: how to read it, and which seconds.
        keep_height: leave the heights as they are, instead of setting the soles on the ground.

    Raises:
        InputError: the file is no motion of the robot, or holds no such seconds.
    """
    read = read_motion(robot, file, reading)
    clip, raised = fit(robot, read.clip, FPS), 0.0
    if not keep_height:
        clip, raised = on_floor(robot, clip)
    lowest = lowest_points(robot, clip)
    check_touches(clip, lowest)
    height = (
        "kept" if keep_height else f"the whole clip is {'raised' if raised > 0.0 else 'lowered'} by {abs(raised):.3f} m"
    )
    facts = {
        "source": file.name,
        "source_sha256": file_hash(file),
        "source_fps": read.clip.fps,
        "start": reading.start,
        "end": reading.end,
        "raised": round(raised, 5),
        "cyclic": False,
    }
    taken = f"{read.clip.num_frames} frames at {read.clip.fps:g} Hz: {read.clip.seconds:.2f} s"
    notes = (taken, *read.notes, f"heights: {height}", *stretches_in_the_air(lowest, FPS, reading.start))
    return Imported(clip, measure(robot, clip), facts, notes)
