"""CSV files of motions: the columns taken by the names of a header, otherwise by their places."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.recording import Recording
from forgetmimic_jax.motion.text_table import read_table
from forgetmimic_jax.robot.model import Robot

ROOT = r"(?:(?:floating_?base|root|base|pelvis)(?:_?link|_?joint)?[_. ]?)?"
POSITION = re.compile(ROOT + r"(?:position|pos|translation|translate|trans|t|p)?[_. ]?([xyz])(?:[_. ]?\(?m\)?)?")
QUATERNION = re.compile(ROOT + r"(?:quaternion|quat|orientation|rotation|rot|q)[_. ]?([xyzw])|r([xyzw])")
EULER = re.compile(ROOT + r"(?:rotate|rotation|rot|euler|r)[_. ]?([xyz])|(?:root_)?(roll|pitch|yaw)")
CLOCK = re.compile(r"(time|timestamp|t|seconds?|sec)([_. ]?\(?s\)?)?")
VELOCITY = re.compile(r"_(vel|velocity)([_. (].*)?$")
JOINT = re.compile(r"_(joint|dof)(_pos|_position|_angle|_rad|_deg)*$|^(j|q|dof|joint)_?\d+$")
FINGER = re.compile(r"hand|finger|thumb")
COUNTER = re.compile(r"(frames?|index|idx|step|no|nr|id|n)?([_. ]?(id|no|nr|number|index|idx))?")


def read_csv(robot: Robot, path: Path) -> Recording:
    """A row a frame. By names where a header has the root's and the joints'; otherwise as LAFAN1 retargets have it.

    Without names: root x, y, z, a quaternion (xyzw) and the joints in the robot's order; a counter or a clock may stand
    before them.
    """
    table = read_table(path)
    names = [name.lower() for name in table.names or ()]
    joints = named_joints(robot, table.names or ())
    if joints:
        return _by_name(robot, names, joints, table.values, path)
    recording = _by_place(robot, table.values, path)
    if not names:
        return recording
    note = f"the header names no joint of {robot.name} ({', '.join(names[:3])} …): columns taken by their places"
    return Recording(**{**vars(recording), "notes": (*recording.notes, note)})


def plain(joint: str) -> str:
    """A joint's name without what projects put behind it."""
    return re.sub(r"(_joint|_dof|_pos|_position|_angle|_rad|_deg)+$", "", joint.strip().lower())


def named_joints(robot: Robot, names: Sequence[str]) -> dict[int, str]:
    """The robot's joint that each column names, by the column's place; columns of other names are left out."""
    known = {plain(joint): joint for joint in robot.joint_names}
    return {place: known[plain(name)] for place, name in enumerate(names) if plain(name) in known}


def _velocities(robot: Robot, names: Sequence[str]) -> dict[int, str]:
    """The robot's joint whose velocity each column is, by the column's place."""
    return named_joints(robot, [VELOCITY.sub("", name) if VELOCITY.search(name) else "" for name in names])


def _beside(joints: dict[int, str], velocities: dict[int, str], values: np.ndarray) -> np.ndarray | None:
    """Velocities [frame, joint] of the joints; NaN where the file has none, and None where it has none at all."""
    if not velocities:
        return None
    place = {joint: column for column, joint in velocities.items()}
    none = np.full(len(values), np.nan)
    return np.stack([values[:, place[joint]] if joint in place else none for joint in joints.values()], axis=-1)


def _is_other_joint(robot: Robot, name: str) -> bool:
    """Whether a column is a joint that the robot lacks: no finger, and no further quantity of one of its joints."""
    known = [plain(joint) for joint in robot.joint_names]
    if FINGER.search(name) or any(name.startswith(joint) for joint in known):
        return False
    return bool(JOINT.search(name) or difflib.get_close_matches(plain(name), known, n=1, cutoff=0.7))


def _by_name(robot: Robot, names: list[str], joints: dict[int, str], values: np.ndarray, path: Path) -> Recording:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(f"{path}: line 1: two columns are called {', '.join(twice)}; a name a column is needed")
    velocities = _velocities(robot, names)
    others = {place: name for place, name in enumerate(names) if place not in joints}
    position, quaternion = _root_columns(others, path)
    others = {place: name for place, name in others.items() if place not in (*position, *quaternion)}
    rate, field, clock = _clock(others, values)
    spare = [
        name
        for place, name in others.items()
        if place not in velocities and not CLOCK.fullmatch(name) and not COUNTER.fullmatch(name)
    ]
    notes = ["columns taken by the names of the header"]
    notes += ["joint velocities stand beside the positions"] if velocities else []
    notes += [f"columns that are no joint of the robot's are left out: {', '.join(spare)}"] if spare else []
    return Recording(
        joint_pos=values[:, list(joints)],
        joint_names=tuple(joints.values()),
        root_pos=values[:, position],
        root_quat=values[:, quaternion],
        quaternion="wxyz",  # put so, by the names
        other_joints=tuple(name for name in spare if _is_other_joint(robot, name)),
        fps=rate,
        fps_field=field,
        clock=clock,
        joint_vel=_beside(joints, velocities, values),
        notes=tuple(notes),
    )


def _root_columns(others: dict[int, str], path: Path) -> tuple[list[int], list[int]]:
    """Places of the root's position xyz and quaternion wxyz among columns that are no joints."""
    position = {m[1]: place for place, name in others.items() if (m := POSITION.fullmatch(name))}
    quaternion = {m[1] or m[2]: place for place, name in others.items() if (m := QUATERNION.fullmatch(name))}
    if len(position) == 3 and len(quaternion) == 4:
        return [position[axis] for axis in "xyz"], [quaternion[axis] for axis in "wxyz"]
    if "w" not in quaternion and sum(bool(EULER.fullmatch(name)) for name in others.values()) >= 3:
        raise InputError(f"{path}: line 1: the root's orientation is in Euler angles; a quaternion is needed")
    raise InputError(
        f"{path}: line 1: the root's columns are not found among {', '.join(others.values()) or 'no names'}; "
        "needed: x, y, z, qx, qy, qz, qw"
    )


def _clock(others: dict[int, str], values: np.ndarray) -> tuple[float | None, str, np.ndarray | None]:
    """Frames per s by the last column of seconds, what to call that column in messages, and the column [frame]."""
    for place, name in reversed(others.items()):
        if CLOCK.fullmatch(name) and (rate := _rate_of_clock(values[:, place])) is not None:
            return rate, f"column {name}", values[:, place]
    return None, "fps", None


def _by_place(robot: Robot, values: np.ndarray, path: Path) -> Recording:
    rate, clock, notes = None, None, []
    widths = {7 + robot.num_joints - lacking for lacking in (0, *map(len, robot.variants.values()))}
    if values.shape[1] - 1 in widths and _is_steady(values[:, 0]):
        rate = _rate_of_clock(values[:, 0])
        clock = values[:, 0] if rate is not None else None
        notes.append(f"the first column is a {'counter' if rate is None else 'clock'}: left out")
        values = values[:, 1:]
    if values.shape[1] not in widths:
        raise InputError(
            f"{path}: found {values.shape[1]} columns; {7 + robot.num_joints} are needed: root position 3, "
            f"quaternion 4, {robot.num_joints} joints of {robot.name}"
        )
    return Recording(
        joint_pos=values[:, 7:],
        root_pos=values[:, :3],
        root_quat=values[:, 3:7],
        quaternion="xyzw",
        fps=rate,
        fps_field="fps" if clock is None else "first column, a clock",
        clock=clock,
        notes=tuple(notes),
    )


def _is_steady(column: np.ndarray) -> bool:
    """Whether a column rises by one step from row to row."""
    steps = np.diff(column)
    return len(steps) > 2 and bool(np.median(steps) > 0) and bool(np.allclose(steps, np.median(steps), rtol=0.1))


def _rate_of_clock(column: np.ndarray) -> float | None:
    """Frames per s of a column of seconds; None for a counter, or for a clock that counts in another unit."""
    steps = np.diff(column)
    usual = float(np.median(steps)) if len(steps) else 0.0
    if not 0.0 < usual < 1.0:
        return None
    kept = steps[(steps >= 0.0) & (steps <= 2.0 * usual)]  # a gap is no step; clocks of few decimals step unevenly
    return round(1.0 / float(np.mean(kept)), 3)
