"""From a recording to a clip of the robot, by the conversions that were named. Every one is said in a note."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from forgetmimic_jax.basics.errors import InputError, nearest
from forgetmimic_jax.motion.clip import Clip, validated
from forgetmimic_jax.motion.columns import plain
from forgetmimic_jax.motion.kinematics import rotation
from forgetmimic_jax.motion.recording import Reading, Recording
from forgetmimic_jax.robot.model import Robot

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
UPRIGHT = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])  # wxyz: turns a world with y up into one with z up
TURN = 2.0 * np.pi
NEAR_RANGE = 0.5  # rad: joints closer to their range than this are not a turn off
MENDED_NORM = 1e-3  # a quaternion's norm further from 1 is said


def breadth_first(robot: Robot) -> tuple[str, ...]:
    """The joints in Isaac Lab's order: level by level of the tree of bodies."""
    return tuple(joint for body in bodies_by_level(robot) for joint in _joints_of(robot, body))


def bodies_by_level(robot: Robot) -> list[int]:
    """Ids of the robot's bodies level by level, as Isaac Lab counts them."""
    parents = robot.model.body_parentid
    level, found = [1], []
    while level:
        found += level
        level = [int(child) for body in level for child in np.flatnonzero(parents == body)]
    return found


def _joints_of(robot: Robot, body: int) -> list[str]:
    return [joint for joint in robot.joint_names if robot.model.joint(joint).bodyid[0] == body]


def converted(
    robot: Robot, recording: Recording, reading: Reading, rate: float, path: Path, first: int = 0
) -> tuple[Clip, list[str]]:
    """The recording as a clip of the robot, and what was done to it; `first` is the file's frame that it begins with.

    Raises:
        InputError: numbers that are no motion, or other joints than the robot's.
    """
    notes: list[str] = []
    order = recording.quaternion if reading.quaternion == "auto" else reading.quaternion
    quat = np.roll(recording.root_quat, 1, axis=-1) if order == "xyzw" else recording.root_quat
    joint_pos = recording.joint_pos * (np.pi / 180.0 if reading.angles == "degrees" else 1.0)
    joint_pos, filled = _in_robot_order(robot, recording, reading, joint_pos, path)
    if filled:
        notes.append(f"joints that the file lacks are at their default angle: {', '.join(filled)}")
    frames = Clip(
        path.stem, rate, robot.joint_names, recording.root_pos * METRES[reading.unit], np.asarray(quat), joint_pos
    )
    norm = np.linalg.norm(frames.root_quat, axis=-1)
    clip = validated(frames, str(path), first)
    if np.abs(norm - 1.0).max() > MENDED_NORM:
        notes.append(f"root quaternions of norm {norm.min():.3g} to {norm.max():.3g} made 1")
    joint_pos, turned = _without_turns(robot, clip.joint_pos)
    notes += [f"{joint}: turns of 2 pi taken out" for joint in turned]
    root_pos, root_quat = clip.root_pos, clip.root_quat
    if reading.up == "y":
        turn = rotation(UPRIGHT)
        root_pos, root_quat = turn.apply(root_pos), (turn * rotation(root_quat)).as_quat(scalar_first=True)
    return validated(Clip(clip.name, clip.fps, clip.joint_names, root_pos, root_quat, joint_pos), str(path)), notes


def _in_robot_order(
    robot: Robot, recording: Recording, reading: Reading, joint_pos: np.ndarray, path: Path
) -> tuple[np.ndarray, list[str]]:
    """The columns [frame, joint] in the robot's order, and the joints that were filled."""
    names = recording.joint_names or _unnamed(robot, reading, joint_pos.shape[1], path)
    if len(names) != joint_pos.shape[1]:
        raise InputError(
            f"{path}: joint_pos: found shape {list(joint_pos.shape)}; [frames, {len(names)}] is needed: one a name"
        )
    known = {plain(joint): joint for joint in robot.joint_names}
    given = [known.get(plain(name), name) for name in names]
    missing = [joint for joint in robot.joint_names if joint not in given]
    unknown = [name for name in given if name not in robot.joint_names]
    unknown += recording.other_joints if missing else ()  # another robot's file
    twice = sorted({name for name in given if given.count(name) > 1})
    if unknown or twice or (missing and not reading.fill_missing):
        hint = f"; {nearest(unknown[0], missing)}" if unknown and missing else ""
        named = f"; twice: {', '.join(twice)}" if twice else ""
        fill = "" if unknown or twice else "; --fill-missing holds them at their default angle"
        raise InputError(
            f"{path}: joint_names: not {robot.name}'s {robot.num_joints} joints, each once (missing: "
            f"{', '.join(missing) or 'none'}; unknown: {', '.join(unknown) or 'none'}{named}){hint}"
            f"{fill if missing else ''}"
        )
    columns = np.tile(np.asarray(robot.arrays.default_joint_pos, np.float64), (len(joint_pos), 1))
    columns[:, [robot.joint_names.index(joint) for joint in given]] = joint_pos
    return columns, missing


def _unnamed(robot: Robot, reading: Reading, count: int, path: Path) -> tuple[str, ...]:
    """The names of columns that the file does not name."""
    if count == robot.num_joints:
        return breadth_first(robot) if reading.joint_order == "isaac" else robot.joint_names
    candidates = variants_of(robot, count)
    if not candidates or reading.joint_order == "isaac":
        raise InputError(f"{path}: found {count} joints; {robot.num_joints} of {robot.name} are needed")
    if not reading.fill_missing:
        looks = ", or ".join(f"{name} without {', '.join(lacking)}" for name, lacking in candidates.items())
        raise InputError(
            f"{path}: found {count} joints; {robot.num_joints} of {robot.name} are needed. It looks like the variant "
            f"{looks}; --fill-missing holds these at their default angle"
        )
    lacking = candidates[reading.variant or next(iter(candidates))]
    return tuple(joint for joint in robot.joint_names if joint not in lacking)


def variants_of(robot: Robot, count: int) -> dict[str, tuple[str, ...]]:
    """The joints that each variant of the robot with so many joints lacks, by the variant's name."""
    return {name: lacking for name, lacking in robot.variants.items() if robot.num_joints - len(lacking) == count}


def _without_turns(robot: Robot, joint_pos: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Joint angles [frame, joint] with whole turns taken out where they then lie in the joint's range."""

    def beyond(angles: np.ndarray) -> np.ndarray:
        return np.maximum(robot.beyond(angles), 0.0)

    candidates = np.stack([joint_pos, joint_pos - TURN, joint_pos + TURN])
    best = np.take_along_axis(candidates, np.argmin([beyond(angles) for angles in candidates], axis=0)[None], axis=0)[0]
    wrong = np.median(beyond(best), axis=0) > NEAR_RANGE  # no turns: degrees, or another robot's joint
    best = np.where(wrong | (beyond(joint_pos) < NEAR_RANGE), joint_pos, best)
    turned = [joint for joint, any_ in zip(robot.joint_names, (best != joint_pos).any(axis=0), strict=True) if any_]
    return best, turned
