"""Which of the robot's variants with fewer joints a file without names holds.

Two variants can have as many joints, in another meaning from the waist on. The legs are the same, so the feet stand
either way. Only bodies and joint ranges tell one from the other; where neither does, the user must.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.comparing import BODY_DISTANCE, distances
from forgetmimic_jax.motion.converting import converted, variants_of
from forgetmimic_jax.motion.plausible import LIMIT, beyond_ranges
from forgetmimic_jax.motion.recording import Reading, Recording
from forgetmimic_jax.robot.model import Robot

# A joint that is off its range in a twentieth of the frames. Of 17 real clips of the G1 the right variant gives 0.00
# rad; the wrong one more than LIMIT in 14 where the file lacks waist joints, and in 5 where it lacks the wrists.
OFTEN = 0.95
WITHIN = 0.2 * LIMIT  # rad


def with_variant(
    robot: Robot, recording: Recording, reading: Reading, rate: float, path: Path, first: int = 0
) -> tuple[Reading, list[str]]:
    """The reading with the variant that the file holds, and a note where the file shows it; arguments as `converted`.

    Raises:
        InputError: a variant that the file cannot hold; or several that it can, and nothing decides which.
    """
    count = recording.joint_pos.shape[1]
    if reading.variant is not None:
        _check_named(robot, recording, reading.variant, path)
        return reading, []
    candidates = variants_of(robot, count)
    if recording.joint_names is not None or len(candidates) < 2 or not reading.fill_missing:
        return reading, []
    readings = {name: dataclasses.replace(reading, variant=name) for name in candidates}
    clips = {name: converted(robot, recording, other, rate, path, first)[0] for name, other in readings.items()}
    taken, why = _by_bodies(robot, recording, readings, clips) or _by_ranges(robot, clips) or (None, "")
    if taken is None:
        flags = " or ".join(f"--variant {name} (without {', '.join(lacking)})" for name, lacking in candidates.items())
        raise InputError(
            f"{path}: joint_names are missing, and several variants of {robot.name} have {count} joints; give {flags}"
        )
    return readings[taken], [f"joints: read as the variant {taken}, because {why}"]


def _check_named(robot: Robot, recording: Recording, name: str, path: Path) -> None:
    """Refuse a variant that the user names and the file cannot hold."""
    count = recording.joint_pos.shape[1]
    if name not in robot.variants:
        known = ", ".join(robot.variants) or f"none of {robot.name}"
        raise InputError(f"{path}: --variant: found '{name}'; accepted: {known}")
    if recording.joint_names is not None:
        raise InputError(f"{path}: --variant: found '{name}', but the file names its joints; leave it out")
    if name not in variants_of(robot, count):
        accepted = ", ".join(variants_of(robot, count)) or "no --variant"
        raise InputError(f"{path}: --variant: found '{name}', but the file has {count} joints; accepted: {accepted}")


def _by_bodies(
    robot: Robot, recording: Recording, readings: Mapping[str, Reading], clips: Mapping[str, Clip]
) -> tuple[str, str] | None:
    """The only variant whose bodies lie where the file's do, and why it is taken."""
    found = {name: distances(robot, recording, readings[name], clip) for name, clip in clips.items()}
    fits = [name for name, bodies in found.items() if bodies and max(bodies.values()) <= BODY_DISTANCE]
    return (fits[0], "the file's bodies fit no other") if len(fits) == 1 else None


def _by_ranges(robot: Robot, clips: Mapping[str, Clip]) -> tuple[str, str] | None:
    """The only variant whose joints stay in their ranges, and why it is taken."""
    off = {name: float(np.quantile(beyond_ranges(robot, clip.joint_pos), OFTEN)) for name, clip in clips.items()}
    within = [name for name in off if off[name] < WITHIN]
    beyond = [name for name in off if off[name] > LIMIT]
    if len(within) != 1 or len(beyond) != len(off) - 1:
        return None
    others = ", ".join(f"{name} by {off[name]:.2f} rad" for name in beyond)
    return within[0], f"joints read as another leave their ranges ({others})"
