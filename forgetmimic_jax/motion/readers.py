"""Read a motion file of another project as a clip of the robot, or say in one line why it is none.

Formats: CSV (`columns`), NPZ (`archives`), pickle (`pickles`). What a file holds is converted by name (`converting`),
then compared with all that the file says besides (`comparing`) and with the robot itself (`plausible`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.files import check_no_pointer
from forgetmimic_jax.motion.archives import read_npz
from forgetmimic_jax.motion.clip import Clip, default_name
from forgetmimic_jax.motion.columns import read_csv
from forgetmimic_jax.motion.comparing import BODY_DISTANCE, check_bodies, check_clock, check_rate, distances
from forgetmimic_jax.motion.converting import converted
from forgetmimic_jax.motion.pickles import read_pickle
from forgetmimic_jax.motion.plausible import check_plausible
from forgetmimic_jax.motion.recording import MIN_SECONDS, Reading, Recording, trimmed
from forgetmimic_jax.motion.roughness import check_jumps, spikes
from forgetmimic_jax.motion.variants import with_variant
from forgetmimic_jax.robot.model import Robot

READERS: dict[str, Callable[[Robot, Path], Recording]] = {
    ".csv": read_csv,
    ".txt": read_csv,
    ".npz": read_npz,
    ".pkl": read_pickle,
    ".pickle": read_pickle,
}
RATES = (5.0, 1000.0)  # Hz


@dataclasses.dataclass(frozen=True)
class Read:
    """A clip at the file's rate, and what was taken from where, compared, converted or left unchecked."""

    clip: Clip
    notes: tuple[str, ...]


def read_motion(robot: Robot, path: Path, reading: Reading | None = None) -> Read:
    """Read a motion file of the robot by its suffix.

    Raises:
        InputError: no file of a known format, or no motion of the robot as it is read; in one line, with the mend.
    """
    reading = reading or Reading()
    recording = _recording(robot, path)
    rate = _rate(recording, reading, path)
    recording, first = trimmed(recording, reading, rate, path)
    frames = len(recording.root_pos)
    if frames < 2 or frames / rate < MIN_SECONDS:
        seconds = f"{frames} frame(s) at {rate:g} Hz: {frames / rate:.2f} s"
        raise InputError(f"{path}: {seconds}; at least {MIN_SECONDS} s are needed")
    reading, variant = with_variant(robot, recording, reading, rate, path, first)
    if recording.joint_names is None and not recording.order_is_given and reading.joint_order == "auto":
        reading = _order_by_bodies(robot, recording, reading, rate, path)
    clip, changes = converted(robot, recording, reading, rate, path, first)
    notes = [*recording.notes, *variant, *changes]
    compared = check_bodies(robot, recording, reading, clip, path)
    if compared:
        notes.append(compared)
    elif recording.joint_names is None:
        notes.append(f"joint order: unchecked, taken for {_order_name(robot, reading)} (the file names no joints)")
    notes.append(check_rate(recording, clip, path))
    notes += check_clock(recording, clip, first)
    notes += check_plausible(robot, recording, reading, clip, path)
    check_jumps(clip, first, path)
    notes += spikes(robot, clip, first)
    return Read(dataclasses.replace(clip, name=reading.name or default_name(path.stem)), tuple(notes))


def _recording(robot: Robot, path: Path) -> Recording:
    """What the file holds, by its suffix."""
    if path.suffix.lower() not in READERS:
        raise InputError(f"{path}: suffix: found '{path.suffix}'; accepted: {', '.join(READERS)}")
    if not path.is_file():
        raise InputError(f"{path}: not found")
    check_no_pointer(path)
    return READERS[path.suffix.lower()](robot, path)


def _rate(recording: Recording, reading: Reading, path: Path) -> float:
    """Frames per s: as the user says, otherwise as the file does."""
    rate = reading.fps if reading.fps is not None else recording.fps
    if rate is None:
        raise InputError(f"{path}: fps: the file does not say its rate; give it with --fps (LAFAN1 retargets: 30)")
    if not RATES[0] <= rate <= RATES[1]:
        raise InputError(f"{path}: fps: found {rate:g}; {RATES[0]:g} to {RATES[1]:g} frames per second are accepted")
    return float(rate)


def _order_by_bodies(robot: Robot, recording: Recording, reading: Reading, rate: float, path: Path) -> Reading:
    """The reading whose joint order the file's bodies show; InputError where none or another than the robot's fits."""
    orders: tuple[Literal["robot", "isaac"], ...] = ("robot", "isaac")
    readings = {order: dataclasses.replace(reading, joint_order=order) for order in orders}
    fits: dict[str, bool] = {}
    for order, attempt in readings.items():
        if order == "isaac" and recording.joint_pos.shape[1] != robot.num_joints:
            continue  # of a variant, Isaac Lab's order is not known
        clip, _ = converted(robot, recording, attempt, rate, path)
        found = distances(robot, recording, attempt, clip)
        fits |= {order: max(found.values()) <= BODY_DISTANCE} if found else {}
    if fits.get("isaac") and not fits.get("robot"):
        raise InputError(f"{path}: joint_names are missing; the bodies fit Isaac Lab's order: --joint-order isaac")
    if "robot" in fits:
        return readings["robot"]  # where it does not fit, `check_bodies` says so
    raise InputError(
        f"{path}: joint_names are missing, and there are no bodies to compare with, so the order is unknown; "
        f"give --joint-order robot if it is {robot.name}'s own, --joint-order isaac for Isaac Lab's"
    )


def _order_name(robot: Robot, reading: Reading) -> str:
    return "Isaac Lab's" if reading.joint_order == "isaac" else f"{robot.name}'s own"
