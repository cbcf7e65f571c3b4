"""A clip against what else its file says: its bodies, its joint velocities, and the rate in its name."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.converting import METRES, UPRIGHT, bodies_by_level
from forgetmimic_jax.motion.kinematics import configuration, rate, rotation
from forgetmimic_jax.motion.recording import Reading, Recording
from forgetmimic_jax.robot.model import Robot

FRAMES = 50  # frames whose bodies are compared, spread over the clip
BODY_DISTANCE = 0.05  # m, median over frames: same robot's files 0.00 to 0.02, Isaac's order 0.3 and more
RATE_ERROR = 0.1  # share that velocities may differ from differences of positions by: right rates 0.00 to 0.02
MOVING = 0.05  # rad/s, root mean square: below it velocities say nothing
ALIKE = 0.8  # correlation of velocities with differences: below it they are something else


def check_rate(recording: Recording, clip: Clip, path: Path) -> str:
    """What the rate was compared with.

    Raises:
        InputError: the file's name or its velocities say another rate.
    """
    said = re.search(r"(?<![\d.])(\d{2,3})[ _-]?(?:hz|fps)(?![a-z])", path.name.lower())
    if said and abs(float(said[1]) - clip.fps) > 0.02 * clip.fps:
        raise InputError(
            f"{path}: fps: read at {clip.fps:g}, but the file's name says {said[1]}; "
            f"give --fps {said[1]}, or rename the file if it is at {clip.fps:g}"
        )
    if recording.joint_vel is None:
        return "rate: the file's name says the same" if said else "rate: unchecked (nothing in the file tells it)"
    differences, velocities = rate(recording.joint_pos, clip.fps), recording.joint_vel
    moves = float(np.sqrt(np.mean(differences**2)))
    if moves < MOVING:
        return "rate: unchecked (the joints hardly move)"
    product = float(np.mean(differences * velocities))
    if product < ALIKE * moves * float(np.sqrt(np.mean(velocities**2))):
        raise InputError(
            f"{path}: joint_vel: not the velocities of joint_pos (correlation "
            f"{product / (moves * max(float(np.sqrt(np.mean(velocities**2))), 1e-9)):.2f}); another order of joints?"
        )
    ratio = product / moves**2
    if abs(ratio - 1.0) > RATE_ERROR:
        raise InputError(
            f"{path}: fps: read at {clip.fps:g}, but joint_vel fits {clip.fps * ratio:.0f} frames per s; "
            f"give --fps {clip.fps * ratio:.0f}"
        )
    return f"rate: joint_vel fits {clip.fps * ratio:.1f} frames per s"


def check_bodies(robot: Robot, recording: Recording, reading: Reading, clip: Clip, path: Path) -> str | None:
    """What the forward kinematics were compared with; None where nothing can be.

    Raises:
        InputError: the file's bodies lie elsewhere than the robot's; with the joint order that would fit, if one does.
    """
    names = _named_bodies(robot, recording, reading)
    if recording.body_pos is None or len(names) < 2:
        return None
    distances = _distances(robot, recording, reading, clip, names)
    worst = max(distances, key=lambda body: distances[body])
    if distances[worst] > BODY_DISTANCE:
        raise InputError(
            f"{path}: forward kinematics: {worst} lies {distances[worst]:.2f} m from {robot.name}'s (median over "
            f"frames, worst of {len(names)} bodies): another joint order (--joint-order robot or isaac), quaternion "
            "order (--quaternion xyzw or wxyz), or another robot"
        )
    return f"forward kinematics: {len(names)} bodies within {100 * distances[worst]:.1f} cm of the file's"


def _named_bodies(robot: Robot, recording: Recording, reading: Reading) -> dict[str, int]:
    """Place in body_pos of every body of the robot that can be named."""
    if recording.body_pos is None:
        return {}
    model = robot.model
    if recording.body_names is not None:
        known = {model.body(body).name for body in range(1, model.nbody)}
        return {name: place for place, name in enumerate(recording.body_names) if name in known}
    if recording.body_pos.shape[1] != model.nbody - 1:
        return {}
    order = bodies_by_level(robot) if reading.joint_order == "isaac" else range(1, model.nbody)
    return {model.body(body).name: place for place, body in enumerate(order)}


def _distances(
    robot: Robot, recording: Recording, reading: Reading, clip: Clip, names: dict[str, int]
) -> dict[str, float]:
    """Median distance in m over frames between each body of the file and the robot's."""
    rows = np.unique(np.linspace(0, clip.num_frames - 1, min(clip.num_frames, FRAMES)).astype(int))
    assert recording.body_pos is not None
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
    distance = np.median(np.linalg.norm(found - said, axis=-1), axis=0)
    return dict(zip(names, map(float, distance), strict=True))


def _turned(quat: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Vectors [frame, body, 3] turned by the frames' quaternions [frame, 4]."""
    return np.einsum("tij,tbj->tbi", rotation(quat).as_matrix(), vectors)
