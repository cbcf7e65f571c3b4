"""A motion as its file has it, before any conversion, and how the user says it is to be read."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from forgetmimic_jax.basics.errors import InputError

MIN_SECONDS = 0.5  # of a clip

JointOrder = Literal["auto", "robot", "isaac"]
QuaternionOrder = Literal["auto", "xyzw", "wxyz"]
Up = Literal["z", "y"]
Unit = Literal["m", "cm", "mm"]
Angles = Literal["radians", "degrees"]


@dataclass(frozen=True)
class Reading:
    """How a motion file is to be read, where it does not say."""

    name: str | None = None  # of the clip; the file's stem by default
    fps: float | None = None  # frames per s of a CSV, which does not say; of another file, instead of its own
    joint_order: JointOrder = "auto"  # of joints without names: the robot's own, or Isaac Lab's (breadth first)
    quaternion: QuaternionOrder = "auto"  # of the root; auto: the format's own (CSV and pickle xyzw, NPZ wxyz)
    up: Up = "z"  # the world's axis that points up
    unit: Unit = "m"  # of positions
    angles: Angles = "radians"  # of joints
    fill_missing: bool = False  # joints that the file lacks keep their default angle
    variant: str | None = None  # of the robot, with fewer joints: its name in the robot's YAML
    start: float = 0.0  # first second to take
    end: float | None = None  # last second to take; the file's end by default


@dataclass(frozen=True)
class Recording:
    """The numbers of a motion file, none of them converted, and the names that it gives them."""

    joint_pos: np.ndarray  # [frame, column]
    root_pos: np.ndarray  # [frame, 3]
    root_quat: np.ndarray  # [frame, 4]
    quaternion: Literal["xyzw", "wxyz"]  # the order that the format has
    joint_names: tuple[str, ...] | None = None  # of the columns of joint_pos
    order_is_given: bool = True  # the format has the robot's order where it names no joints
    other_joints: tuple[str, ...] = ()  # that the file has besides and the robot lacks
    fps: float | None = None
    fps_field: str = "fps"  # what of the file says its rate
    clock: np.ndarray | None = None  # [frame] s
    joint_vel: np.ndarray | None = None  # [frame, column]
    body_names: tuple[str, ...] | None = None
    body_pos: np.ndarray | None = None  # [frame, body, 3]
    bodies_in_root_frame: bool = False  # body_pos is relative to the root, turned with it; otherwise world
    notes: tuple[str, ...] = ()  # what was taken from where


def trimmed(recording: Recording, reading: Reading, rate: float, path: Path) -> tuple[Recording, int]:
    """The frames from `start` to `end` in s, and the file's frame that comes first.

    Raises:
        InputError: fewer than two frames lie between.
    """
    frames = len(recording.root_pos)
    if reading.start == 0.0 and reading.end is None:
        return recording, 0
    end = (frames - 1) / rate if reading.end is None else reading.end
    first, stop = np.ceil(reading.start * rate - 1e-6), np.floor(end * rate + 1e-6) + 1
    if not 0 <= first < stop - 1 or stop > frames:  # NaN compares as false
        raise InputError(
            f"{path}: --start {reading.start:g} --end {end:g}: two frames or more between 0 and "
            f"{(frames - 1) / rate:.2f} s are needed"
        )
    cut: dict[str, Any] = {
        field: value[int(first) : int(stop)]
        for field, value in vars(recording).items()
        if isinstance(value, np.ndarray)
    }
    return dataclasses.replace(recording, **cut), int(first)


def numbers(value: Any, field: str, path: Path) -> np.ndarray:
    """The value as float64; InputError where it holds anything else."""
    try:
        with np.errstate(invalid="ignore", over="ignore"):  # a damaged file's numbers; who reads them refuses NaN
            return np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{path}: {field}: found a {type(value).__name__}; numbers are needed") from None


def shaped(value: Any, field: str, path: Path, shape: tuple[int | None, ...]) -> np.ndarray:
    """The value as float64 of a shape; None stands for any length."""
    array = numbers(value, field, path)
    fits = array.ndim == len(shape) and all(
        wanted in (None, found) for wanted, found in zip(shape, array.shape, strict=True)
    )
    if not fits:
        needed = ", ".join("any" if length is None else str(length) for length in shape)
        raise InputError(f"{path}: {field}: found shape {list(array.shape)}; [{needed}] is needed")
    return array


def rate_of(content: dict[str, Any], path: Path) -> float | None:
    """Frames per s, which some files hold as an array of one; None where the file does not say them."""
    if "fps" not in content:
        return None
    rates = numbers(content["fps"], "fps", path).reshape(-1)
    if len(rates) != 1:
        raise InputError(f"{path}: fps: found {len(rates)} numbers; one is needed")
    return float(rates[0])


def needed(content: dict[str, Any], fields: tuple[str, ...], path: Path) -> None:
    """InputError that lists the missing fields and what is there."""
    missing = [field for field in fields if field not in content]
    if missing:
        found = ", ".join(map(str, content)) or "nothing"
        raise InputError(f"{path}: missing {', '.join(missing)}; found {found}")
