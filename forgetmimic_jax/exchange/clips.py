"""The clip that a policy was trained on: inside its ONNX file, or a motion file beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.clip import Clip, default_name, validated
from forgetmimic_jax.motion.comparing import BODY_DISTANCE, named_rate
from forgetmimic_jax.motion.fit import check_touches, fit, lowest_points
from forgetmimic_jax.motion.importing import FPS
from forgetmimic_jax.motion.kinematics import body_motion, configuration, tangent_steps
from forgetmimic_jax.motion.readers import read_motion
from forgetmimic_jax.motion.recording import Reading
from forgetmimic_jax.robot.model import Robot

# A root of a clip is never so fast; what is faster is a jump between frames.
ROOT_SPEED, ROOT_TURN = 5.0, 20.0  # m/s, rad/s
BODY_TURN = 0.2  # rad, median over frames, between a body of a file and the robot's
FIRST = 25  # frames at the start of a clip that may be garbage: half a second


def clip_name(policy: Path) -> str:
    """A name for the clip of a policy: that of its file, or of its folder where the file is called policy."""
    folders = [parent.name for parent in policy.resolve().parents if parent.name not in ("exported", "params")]
    return default_name(folders[0] if policy.stem in ("policy", "model") and folders else policy.stem)


def clip_inside(
    tables: Mapping[str, np.ndarray], joints: Sequence[str], bodies: Sequence[str], robot: Robot, policy: Path
) -> Clip:
    """The clip of an ONNX file: root and joints alone, from which the library rebuilds velocities and bodies.

    BeyondMimic's files have velocities of centres of mass, and the velocities of mjlab's are ours to 2e-3.

    Args:
        tables: `joint_pos` [frame, joint], `body_pos_w` [frame, body, 3] and `body_quat_w` (wxyz) among them.
        joints: names, in the order of the file.
        bodies: names; empty if the file does not say, and the first body is then the root.
        robot: whose root is looked for by name.
        policy: the file.

    Raises:
        InputError: no root, other shapes, what is no motion, or bodies that lie elsewhere than the robot's.
    """
    missing = [name for name in ("joint_pos", "body_pos_w", "body_quat_w") if name not in tables]
    if missing:
        raise InputError(f"{policy}: the clip inside: missing {', '.join(missing)}")
    pos, quat, angles = (tables[name].astype(np.float64) for name in ("body_pos_w", "body_quat_w", "joint_pos"))
    root = robot.key_bodies[robot.root]
    if bodies and root not in bodies:
        raise InputError(
            f"{policy}: body_names: no '{root}', the root of {robot.name}; found {', '.join(bodies[:4])} …"
        )
    same = pos.ndim == 3 and quat.shape == (*pos.shape[:2], 4)
    if not same or angles.shape != (len(pos), len(joints)) or (bodies and pos.shape[1] != len(bodies)):
        raise InputError(f"{policy}: the clip inside: found joint_pos {list(angles.shape)} and body_pos_w "
                         f"{list(pos.shape)}; {len(joints)} joints and {len(bodies) or 'some'} bodies are needed"
                         )  # fmt: skip
    body = list(bodies).index(root) if bodies else 0
    clip = validated(Clip(clip_name(policy), FPS, tuple(joints), pos[:, body], quat[:, body], angles), str(policy))
    _check_bodies(clip, pos, quat, bodies, robot, policy)
    return clip


def _check_bodies(
    clip: Clip, pos: np.ndarray, quat: np.ndarray, bodies: Sequence[str], robot: Robot, policy: Path
) -> None:
    """InputError unless every body of a file lies and is turned as the robot's in the clip, by the median over frames.

    A body is compared with the robot's of its name, or without names with the nearest. Other names are passed over.

    Args:
        clip: root and joints, from which forward kinematics follow.
        pos: m [frame, body, 3] of the file.
        quat: wxyz [frame, body, 4] of the file.
        bodies: names; may be empty.
        robot: compared with.
        policy: the file.
    """
    ids = np.arange(1, robot.model.nbody)
    names = [robot.model.body(body).name for body in ids]
    found = body_motion(robot.model, configuration(clip, robot), clip.fps, ids)
    wrong: list[tuple[float, float, str]] = []  # m, rad, body
    for place in range(pos.shape[1]):
        if bodies and bodies[place] not in names:
            continue
        distances = np.median(np.linalg.norm(found.pos - pos[:, place, None], axis=-1), axis=0)
        ours = names.index(bodies[place]) if bodies else int(np.argmin(distances))
        cosines = np.abs(np.sum(found.quat[:, ours] * quat[:, place], axis=-1))
        distance, turn = float(distances[ours]), 2.0 * float(np.median(np.arccos(np.minimum(cosines, 1.0))))
        if not (distance <= BODY_DISTANCE and turn <= BODY_TURN):
            wrong.append((distance, turn, names[ours]))
    if wrong:
        distance, turn, body = max(wrong)
        raise InputError(
            f"{policy}: the clip inside: forward kinematics: {body} lies {distance:.2f} m from {robot.name}'s and is "
            f"turned by {turn:.1f} rad (median over frames, worst of {pos.shape[1]} bodies); accepted: "
            f"{BODY_DISTANCE:g} m and {BODY_TURN:g} rad: quaternions not wxyz, another order of joints or bodies, or "
            f"another robot?"
        )


def clip_beside(motion: Path, fps: float | None, robot: Robot) -> Clip:
    """The clip of a motion file as it is, at the control rate; without `fps`, read at the rate that its name says.

    Raises:
        InputError: the file does not say its rate, or is no motion of the robot.
    """
    read = read_motion(robot, motion, Reading(fps=fps or named_rate(motion)))
    clip = fit(robot, read.clip, FPS)
    check_touches(clip, lowest_points(robot, clip))
    return clip


def from_second(clip: Clip, start: float) -> Clip:
    """The clip without its first `start` seconds.

    Raises:
        InputError: no half second is left.
    """
    if not 0.0 <= start * clip.fps <= clip.num_frames - 0.5 * clip.fps:  # NaN compares as false
        raise InputError(
            f"--start: found {start:g}; {clip.name} has {clip.seconds:.2f} s, and half a second must remain"
        )
    return clip.part(int(np.ceil(start * clip.fps - 1e-6)), clip.num_frames)


def garbage(robot: Robot, clip: Clip) -> str | None:
    """What is wrong with the first frames of a clip, if they move as no robot can: a sentence; else None.

    A step between two frames is too fast if a joint passes its motor's no-load speed, or the root 5 m/s or 20 rad/s.
    """
    steps = np.abs(tangent_steps(configuration(clip, robot)[: FIRST + 1])) * clip.fps
    joint, root = steps[:, 6:], np.linalg.norm(steps[:, :3], axis=-1)
    turn = np.linalg.norm(steps[:, 3:6], axis=-1)
    wrong = (joint > robot.joint_velocity_limit).any(-1) | (root > ROOT_SPEED) | (turn > ROOT_TURN)
    if not wrong.any():
        return None
    last = int(np.flatnonzero(wrong)[-1])
    fastest = int(joint[: last + 1].max(0).argmax())
    return (
        f"{clip.name}: frames 0 to {last} are garbage: {robot.joint_names[fastest]} moves at "
        f"{joint[: last + 1].max():.0f} rad/s and the root at {root[: last + 1].max():.1f} m/s; "
        f"--start {(last + 1) / clip.fps:.2f} leaves them out"
    )
