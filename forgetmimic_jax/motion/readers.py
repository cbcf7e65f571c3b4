"""Readers of other projects' motion files: LAFAN1-style CSV, mjlab / BeyondMimic NPZ, and GMR's pickle.

Each returns a `Clip` of the robot or raises an InputError that names the file, the field, what was found and what is
accepted.
"""

from __future__ import annotations

import dataclasses
import io
import pickle
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.clip import Clip, validated
from forgetmimic_jax.motion.contact import floor_points, floor_positions
from forgetmimic_jax.motion.kinematics import configuration
from forgetmimic_jax.robot.model import Robot

BODY_DISTANCE = 0.1  # m between a file's body and the robot's: more, and the joints are in another order
MISPLACED = 0.12  # m that the robot's lowest point lies from the floor on average: more calls for a doubt
JOINT_SLACK = 1.0  # rad beyond a joint's range: other robots, degrees and shuffled joints are further off


@dataclass(frozen=True)
class Reading:
    """How a motion file is to be read, where it does not say."""

    name: str | None = None  # of the clip; the file's stem by default
    fps: float | None = None  # frames per s of a CSV, which does not say; of another file, instead of its own
    quaternion_order: str = "auto"  # of the root: 'xyzw', 'wxyz', or the format's own (CSV and pickle xyzw, NPZ wxyz)
    assume_robot_order: bool = False  # an NPZ without joint names is in the robot's order

    def order(self, own: str) -> str:
        """The order of the quaternion in a format whose own order this is."""
        return own if self.quaternion_order == "auto" else self.quaternion_order


def read_motion(robot: Robot, path: Path, reading: Reading | None = None) -> Clip:
    """Read a motion file of the robot by its suffix: .csv, .npz or .pkl."""
    reading = reading or Reading()
    readers: dict[str, Callable[[Robot, Path, Reading], Clip]] = {".csv": read_csv, ".npz": read_npz, ".pkl": read_gmr}
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: suffix: found '{path.suffix}'; accepted: {', '.join(readers)}")
    if not path.is_file():
        raise InputError(f"{path}: not found")
    clip = validated(readers[path.suffix.lower()](robot, path, reading), str(path))
    _check_plausible(robot, clip, path)
    return dataclasses.replace(clip, name=reading.name or path.stem)


def read_csv(robot: Robot, path: Path, reading: Reading) -> Clip:
    """LAFAN1-style CSV: a row a frame of root x, y, z in m, a quaternion (xyzw) and the joints in rad, robot order.

    A first line of words is taken for a header.
    """
    if reading.fps is None:
        raise InputError(f"{path}: fps: a CSV does not say its rate; give it with --fps (LAFAN1 retargets: 30)")
    columns = 7 + robot.num_joints
    rows = []
    for line, text in enumerate(path.read_text(errors="replace").splitlines(), start=1):
        if not text.strip():
            continue
        cells = [cell.strip() for cell in text.split(",")]
        try:
            row = [float(cell) for cell in cells]
        except ValueError:
            if line == 1:
                continue
            raise InputError(f"{path}: line {line}: found '{text[:40]}'; {columns} numbers are needed") from None
        if len(row) != columns:
            raise InputError(
                f"{path}: line {line}: found {len(row)} columns; {columns} are needed: root position 3, quaternion 4, "
                f"{robot.num_joints} joints of {robot.name}"
            )
        rows.append(row)
    values = np.array(rows, np.float64).reshape(-1, columns)
    quat = _wxyz(values[:, 3:7], reading.order("xyzw"), path, "columns 4-7")
    return Clip(path.stem, float(reading.fps), robot.joint_names, values[:, :3], quat, values[:, 7:])


def read_npz(robot: Robot, path: Path, reading: Reading) -> Clip:
    """mjlab / BeyondMimic NPZ: fps, joint_pos, body_pos_w, body_quat_w (wxyz), and joint_names and body_names.

    Without body_names the first body is taken for the root; both only with `assume_robot_order`, and then the file's
    bodies must lie where the robot's lie, if there are as many.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            content = {field: archive[field] for field in archive.files}
    except (ValueError, zipfile.BadZipFile, EOFError) as error:
        raise InputError(f"{path}: not a readable NPZ ({error})") from None
    needed = ["joint_pos", "body_pos_w", "body_quat_w"] + (["fps"] if reading.fps is None else [])
    missing = [field for field in needed if field not in content]
    if missing:
        raise InputError(f"{path}: missing {', '.join(missing)}; found {', '.join(content) or 'nothing'}")
    names = [field for field in ("joint_names", "body_names") if field not in content]
    if names and not reading.assume_robot_order:
        raise InputError(
            f"{path}: missing {' and '.join(names)}, so the order is unknown; "
            f"give --assume-robot-order if it is {robot.name}'s own (root first)"
        )
    joint_pos = _numbers(content["joint_pos"], "joint_pos", path)
    body_pos = _numbers(content["body_pos_w"], "body_pos_w", path)
    body_quat = _numbers(content["body_quat_w"], "body_quat_w", path)
    for field, value, tail in (("body_pos_w", body_pos, 3), ("body_quat_w", body_quat, 4)):
        if value.ndim != 3 or value.shape[-1] != tail or len(value) != len(joint_pos):
            raise InputError(
                f"{path}: {field}: found shape {list(value.shape)}; [{len(joint_pos)}, bodies, {tail}] is needed"
            )
    joints = tuple(str(joint) for joint in content.get("joint_names", robot.joint_names))
    if joint_pos.ndim != 2 or joint_pos.shape[1] != len(joints):
        raise InputError(f"{path}: joint_pos: found shape {list(joint_pos.shape)}; [frames, {len(joints)}] is needed")
    root_name = robot.key_bodies[robot.root]
    bodies = [str(body) for body in content.get("body_names", [root_name])]
    if root_name not in bodies:
        raise InputError(f"{path}: body_names: no '{root_name}'; found {', '.join(bodies[:4])} …")
    root = bodies.index(root_name)
    rate = _rate(content["fps"] if reading.fps is None else reading.fps, path)
    quat = _wxyz(body_quat[:, root], reading.order("wxyz"), path, "body_quat_w")
    clip = _ordered(robot, Clip(path.stem, rate, joints, body_pos[:, root], quat, joint_pos), path)
    if names and body_pos.shape[1] == robot.model.nbody - 1:
        _check_bodies(robot, validated(clip, str(path)), body_pos, path)
    return clip


def read_gmr(robot: Robot, path: Path, reading: Reading) -> Clip:
    """GMR's pickle: fps, root_pos, root_rot (xyzw), dof_pos in the robot's order. Only numbers are unpickled."""
    try:
        content = NumbersOnly(io.BytesIO(path.read_bytes())).load()
    except Refused as error:
        raise InputError(
            f"{path}: refused: the pickle would call {error}; accepted: numpy arrays and numbers"
        ) from None
    except Exception as error:  # a damaged pickle raises almost anything
        raise InputError(f"{path}: not a readable pickle ({type(error).__name__}: {error})") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: found a {type(content).__name__}; a dict with root_pos, root_rot, dof_pos is needed")
    needed = ["root_pos", "root_rot", "dof_pos"] + (["fps"] if reading.fps is None else [])
    missing = [field for field in needed if field not in content]
    if missing:
        found = ", ".join(str(field) for field in content) or "nothing"
        raise InputError(f"{path}: missing {', '.join(missing)}; found {found}")
    arrays = {field: _numbers(content[field], field, path) for field in ("root_pos", "root_rot", "dof_pos")}
    joints = arrays["dof_pos"].shape[-1] if arrays["dof_pos"].ndim else 0
    if joints != robot.num_joints:
        raise InputError(f"{path}: dof_pos: found {joints} joints; {robot.num_joints} of {robot.name} are needed")
    rate = _rate(content["fps"] if reading.fps is None else reading.fps, path)
    quat = _wxyz(arrays["root_rot"], reading.order("xyzw"), path, "root_rot")
    return Clip(path.stem, rate, robot.joint_names, arrays["root_pos"], quat, arrays["dof_pos"])


class Refused(Exception):
    """A pickle names something other than numpy's reconstruction."""


class NumbersOnly(pickle.Unpickler):
    """An unpickler that can build numpy arrays, scalars and plain containers, and call nothing else."""

    ALLOWED = frozenset(
        [("numpy", "ndarray"), ("numpy", "dtype"), ("_codecs", "encode")]
        + [
            (f"numpy.{core}.{module}", name)
            for core in ("core", "_core")
            for module, name in (
                ("multiarray", "_reconstruct"),
                ("multiarray", "scalar"),
                ("numeric", "_frombuffer"),
            )
        ]
    )

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in self.ALLOWED:
            raise Refused(f"{module}.{name}")
        return super().find_class(module.replace("numpy.core", "numpy._core"), name)


def _numbers(value: Any, field: str, path: Path) -> np.ndarray:
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{path}: {field}: found a {type(value).__name__}; numbers are needed") from None


def _rate(value: Any, path: Path) -> float:
    """Frames per s; some files hold an array of one."""
    rates = _numbers(value, "fps", path).reshape(-1)
    if len(rates) != 1:
        raise InputError(f"{path}: fps: found {len(rates)} numbers; one is needed")
    return float(rates[0])


def _wxyz(quat: np.ndarray, order: str, path: Path, field: str) -> np.ndarray:
    """Quaternions [frame, 4] with the scalar first."""
    if quat.ndim != 2 or quat.shape[-1] != 4:
        raise InputError(f"{path}: {field}: found shape {list(quat.shape)}; [frames, 4] is needed")
    return np.roll(quat, 1, axis=-1) if order == "xyzw" else quat


def _ordered(robot: Robot, clip: Clip, path: Path) -> Clip:
    """The clip with its joints in the robot's order."""
    missing = [joint for joint in robot.joint_names if joint not in clip.joint_names]
    unknown = [joint for joint in clip.joint_names if joint not in robot.joint_names]
    if missing or unknown or len(clip.joint_names) != robot.num_joints:
        raise InputError(
            f"{path}: joint_names: not {robot.name}'s {robot.num_joints} joints "
            f"(missing: {', '.join(missing[:3]) or 'none'}; unknown: {', '.join(unknown[:3]) or 'none'})"
        )
    order = [clip.joint_names.index(joint) for joint in robot.joint_names]
    return Clip(clip.name, clip.fps, robot.joint_names, clip.root_pos, clip.root_quat, clip.joint_pos[:, order])


def _check_plausible(robot: Robot, clip: Clip, path: Path) -> None:
    """Refuse what is no motion of this robot: swapped quaternions, degrees, joints of another robot or order."""
    beyond = np.maximum(clip.joint_pos - robot.joint_upper, robot.joint_lower - clip.joint_pos)
    frame, joint = np.unravel_index(np.argmax(beyond), beyond.shape)
    if beyond[frame, joint] > JOINT_SLACK:
        raise InputError(
            f"{path}: {robot.joint_names[joint]}: {clip.joint_pos[frame, joint]:.2f} rad in frame {frame}; "
            f"{robot.name}'s range is {robot.joint_lower[joint]:.2f} to {robot.joint_upper[joint]:.2f} "
            f"(degrees, or another robot's joints?)"
        )
    here = _implausibility(robot, clip, clip.root_quat)
    # xyzw taken for wxyz, or the reverse: the numbers are one place too far left, or right.
    swapped = min(_implausibility(robot, clip, np.roll(clip.root_quat, shift, axis=-1)) for shift in (1, -1))
    if here > MISPLACED and swapped < 0.5 * here:
        raise InputError(
            f"{path}: root quaternion: read in this order the feet are {here:.2f} m from the floor on average, in the "
            f"other {swapped:.2f} m; give --quaternion-order xyzw or wxyz"
        )


def _implausibility(robot: Robot, clip: Clip, quat: np.ndarray) -> float:
    """Mean distance in m of the robot's lowest point from the floor, over a few frames."""
    rows = np.linspace(0, clip.num_frames - 1, min(20, clip.num_frames)).astype(int)
    qpos = configuration(clip, robot)[rows]
    qpos[:, 3:7] = quat[rows]
    return float(np.abs(floor_positions(robot, floor_points(robot), qpos)[..., 2].min(axis=1)).mean())


def _check_bodies(robot: Robot, clip: Clip, body_pos: np.ndarray, path: Path) -> None:
    """The file's bodies [frame, body, 3] lie where the robot's do, frame 0."""
    data = mujoco.MjData(robot.model)
    data.qpos[:] = configuration(clip, robot)[0]
    mujoco.mj_kinematics(robot.model, data)
    distance = np.linalg.norm(data.xpos[1:] - body_pos[0], axis=-1)
    worst = int(np.argmax(distance))
    if distance[worst] > BODY_DISTANCE:
        raise InputError(
            f"{path}: joint_pos: not in {robot.name}'s order: body {worst} of body_pos_w lies {distance[worst]:.2f} m "
            f"from {robot.model.body(worst + 1).name}"
        )
