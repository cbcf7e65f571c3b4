"""A clip against what else its file says: its bodies, its joint velocities, and the rate in its name."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.converting import METRES, UPRIGHT, bodies_by_level, converted
from forgetmimic_jax.motion.kinematics import configuration, rate, rotation
from forgetmimic_jax.motion.plausible import other_readings
from forgetmimic_jax.motion.recording import Reading, Recording
from forgetmimic_jax.robot.model import Robot

FRAMES = 50  # frames whose bodies are compared, spread over the clip
BODY_DISTANCE = 0.05  # m, median over frames: same robot's files 0.00 to 0.02, Isaac's order 0.3 and more
NAMED_RATE = re.compile(
    r"(?<![\d.])(\d{2,3}(?:\.\d+)?)[ _-]?(?:hz|fps)(?![a-z])|(?<![a-z])(?:hz|fps)[ _-]?(\d{2,3}(?:\.\d+)?)(?!\d)"
)  # walk_60hz, walk 60 fps, fps60, hz_60
SAME_RATE = 0.02  # share that two rates may differ by: 29.97 is 30
COARSE = 0.011  # s: clocks written with two decimals step by as much more than they do
RATE_ERROR = 0.1  # share that velocities may differ from differences of positions by: right rates 0.00 to 0.02
MOVING = 0.05  # rad/s, root mean square: below it velocities say nothing
ALIKE = 0.8  # correlation of velocities with differences: below it they are something else


def named_rate(path: Path) -> float | None:
    """The rate that a file's name says, in frames per s, as that of dance_60hz.csv does."""
    said = NAMED_RATE.search(path.name.lower())
    return float(said[1] or said[2]) if said else None


def check_rate(recording: Recording, clip: Clip, path: Path) -> str:
    """What the rate was compared with.

    Raises:
        InputError: the file's name, its velocities, or its own rate where they decide nothing, give another rate.
    """
    named = named_rate(path)
    if named is not None and not _alike(named, clip.fps):
        flag = "" if recording.fps is not None and _alike(recording.fps, clip.fps) else f"give --fps {named:g}, or "
        raise InputError(
            f"{path}: fps: read at {clip.fps:g}, but the file's name says {named:g}; "
            f"{flag}rename the file if it is at {clip.fps:g}"
        )
    checked, unchecked = _rate_by_velocities(recording, clip.fps, path)
    if checked:
        return checked
    if recording.fps is not None and not _alike(recording.fps, clip.fps):
        raise InputError(
            f"{path}: {recording.fps_field}: --fps is {clip.fps:g}, but the file says {recording.fps:g}; accepted: "
            f"{recording.fps:g}, or no --fps"
        )
    return "rate: the file's name says the same" if named else f"rate: unchecked ({unchecked})"


def check_clock(recording: Recording, clip: Clip, first: int) -> list[str]:
    """A note where the file's clock leaps; `first` is the file's frame that the clip begins with."""
    if recording.clock is None:
        return []
    steps = np.diff(recording.clock)
    usual = float(np.median(steps))
    leaps = np.flatnonzero((steps > 1.5 * usual) & (steps > usual + COARSE) | (steps < 0.0))
    if not len(leaps):
        return []
    worst = int(leaps[np.argmax(np.abs(steps[leaps]))])
    frame, more = first + worst + 1, f"; {len(leaps) - 1} more leaps" if len(leaps) > 1 else ""
    return [
        f"warning: the file's clock leaps by {steps[worst]:.2f} s, not {usual:.3f} s, to frame {frame} "
        f"({frame / clip.fps:.2f} s): frames may be missing there{more}"
    ]


def _alike(rate: float, other: float) -> bool:
    return abs(rate - other) <= SAME_RATE * other


def _rate_by_velocities(recording: Recording, fps: float, path: Path) -> tuple[str | None, str]:
    """What the joint velocities say of the rate, numbers that are not finite left out; or why they say nothing.

    Raises:
        InputError: they fit another rate, or other joints.
    """
    if recording.joint_vel is None:
        return None, "the file has no rate" if recording.fps is None else "the file has only a number for it"
    finite = np.isfinite(recording.joint_vel)
    differences, velocities = rate(recording.joint_pos, fps)[finite], recording.joint_vel[finite]
    if not np.any(velocities):
        return None, "joint_vel is zero or NaN in every frame"
    moves = float(np.sqrt(np.mean(differences**2)))
    moved = float(np.sqrt(np.mean(velocities**2)))
    if moves < MOVING:
        return None, "the joints hardly move"
    product = float(np.mean(differences * velocities))
    if product < ALIKE * moves * moved:
        raise InputError(
            f"{path}: joint_vel: not the velocities of joint_pos (correlation {product / (moves * moved):.2f}); "
            "another order of joints?"
        )
    ratio = product / moves**2
    if abs(ratio - 1.0) > RATE_ERROR:
        raise InputError(
            f"{path}: fps: read at {fps:g}, but joint_vel fits {fps * ratio:.0f} frames per s; "
            f"give --fps {fps * ratio:.0f}"
        )
    return f"rate: joint_vel fits {fps * ratio:.1f} frames per s", ""


def check_bodies(robot: Robot, recording: Recording, reading: Reading, clip: Clip, path: Path) -> str | None:
    """What the forward kinematics were compared with; None where nothing can be.

    Raises:
        InputError: the file's bodies lie elsewhere than the robot's; with the flags of a reading that fits, if any.
    """
    found = distances(robot, recording, reading, clip)
    if not found:
        return None
    worst = max(found, key=lambda body: found[body])
    if found[worst] > BODY_DISTANCE:
        fits = next(_fitting(robot, recording, reading, clip.fps, path), None)
        mend = (
            f"another reading fits: {fits}"
            if fits
            else "another joint order (--joint-order robot or isaac), quaternion order (--quaternion xyzw or wxyz), or "
            "another robot"
        )
        raise InputError(
            f"{path}: forward kinematics: {worst} lies {found[worst]:.2f} m from {robot.name}'s (median over frames, "
            f"worst of {len(found)} bodies): {mend}"
        )
    return f"forward kinematics: {len(found)} bodies within {100 * found[worst]:.1f} cm of the file's"


def _fitting(robot: Robot, recording: Recording, reading: Reading, fps: float, path: Path) -> Iterator[str]:
    """The flags of the other readings in which the file's bodies lie where the robot's do."""
    for changes in (1, 2):
        for other, flags in other_readings(recording, reading, changes):
            try:
                clip, _ = converted(robot, recording, other, fps, path)
            except InputError:
                continue
            found = distances(robot, recording, other, clip)
            if found and max(found.values()) <= BODY_DISTANCE:
                yield flags


def distances(robot: Robot, recording: Recording, reading: Reading, clip: Clip) -> dict[str, float]:
    """Median distance in m over frames between each body of the file and the robot's.

    Frames in which a body is not finite do not count. There is none where fewer than two bodies can be named.
    """
    if recording.body_pos is None:
        return {}
    names = _named_bodies(robot, recording.body_names, recording.body_pos.shape[1], reading)
    if len(names) < 2:
        return {}
    rows = np.unique(np.linspace(0, clip.num_frames - 1, min(clip.num_frames, FRAMES)).astype(int))
    said = recording.body_pos[rows][:, list(names.values())] * METRES[reading.unit]
    if recording.bodies_in_root_frame:
        said = clip.root_pos[rows, None] + _turned(clip.root_quat[rows], said)
    elif reading.up == "y":
        said = _turned(np.tile(UPRIGHT, (len(rows), 1)), said)
    bodies = [robot.model.body(name).id for name in names]
    data, found = mujoco.MjData(robot.model), np.empty_like(said)
    for row, qpos in enumerate(configuration(clip, robot)[rows]):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(robot.model, data)
        found[row] = data.xpos[bodies]
    off = np.linalg.norm(found - said, axis=-1)
    finite = {name: column[np.isfinite(column)] for name, column in zip(names, off.T, strict=True)}
    median = {name: float(np.median(column)) for name, column in finite.items() if len(column)}
    return median if len(median) > 1 else {}


def _named_bodies(robot: Robot, names: Sequence[str] | None, count: int, reading: Reading) -> dict[str, int]:
    """Place of every body of the robot that can be named among the `count` bodies of a file."""
    model = robot.model
    if names is not None:
        known = {model.body(body).name for body in range(1, model.nbody)}
        return {name: place for place, name in enumerate(names) if name in known}
    if count != model.nbody - 1:
        return {}
    order = bodies_by_level(robot) if reading.joint_order == "isaac" else range(1, model.nbody)
    return {model.body(body).name: place for place, body in enumerate(order)}


def _turned(quat: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors [frame, body, 3] turned by the frames' quaternions [frame, 4]."""
    return np.einsum("tij,tbj->tbi", rotation(quat).as_matrix(), vectors)
