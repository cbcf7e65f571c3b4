"""NPZ files of motions: mjlab's, BeyondMimic's, wbc-mjlab's, holosoma's, and a library's own clips."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.files import check_characters, readable
from forgetmimic_jax.motion.recording import Recording, needed, rate_of, shaped
from forgetmimic_jax.motion.unpickle import unpickled
from forgetmimic_jax.robot.model import Robot


def read_npz(robot: Robot, path: Path) -> Recording:
    """An NPZ by the fields that it has.

    mjlab, BeyondMimic, wbc-mjlab: joint_pos, body_pos_w, body_quat_w (wxyz). holosoma: the same with the root's seven
    numbers before the joints, or qpos. A library's own: root_pos, root_quat, joint_pos.
    """
    content = read_fields(path)
    if "qpos" in content and "joint_pos" not in content:
        return _of_qpos(content, path)
    if "root_pos" in content and "root_quat" in content:
        return _of_root(content, path)
    needed(content, ("joint_pos", "body_pos_w", "body_quat_w"), path)
    joint_pos = shaped(content["joint_pos"], "joint_pos", path, (None, None))
    body_pos = shaped(content["body_pos_w"], "body_pos_w", path, (len(joint_pos), None, 3))
    body_quat = shaped(content["body_quat_w"], "body_quat_w", path, (len(joint_pos), body_pos.shape[1], 4))
    joints, bodies = _names(content, "joint_names"), _names(content, "body_names")
    if bodies is not None and len(bodies) != body_pos.shape[1]:
        raise InputError(f"{path}: body_names: found {len(bodies)} names for {body_pos.shape[1]} bodies")
    root_name = robot.key_bodies[robot.root]
    if bodies is not None and root_name not in bodies:
        raise InputError(f"{path}: body_names: no '{root_name}'; found {', '.join(bodies[:4])} …")
    root = bodies.index(root_name) if bodies else 0
    notes = [] if bodies or body_pos.shape[1] == 1 else ["body_names are missing: the first body is taken for the root"]
    joint_vel = content.get("joint_vel")
    width = len(joints) if joints is not None else robot.num_joints
    if joint_pos.shape[1] == width + 7:
        joint_pos, joint_vel = joint_pos[:, 7:], None
        notes.append("holosoma's file: joint_pos holds the root's seven numbers first")
    return Recording(
        joint_pos=joint_pos,
        joint_names=joints,
        order_is_given=False,
        root_pos=body_pos[:, root],
        root_quat=body_quat[:, root],
        quaternion="wxyz",
        fps=rate_of(content, path),
        joint_vel=None if joint_vel is None else shaped(joint_vel, "joint_vel", path, joint_pos.shape),
        body_names=bodies,
        body_pos=body_pos,
        notes=tuple(notes),
    )


def read_fields(path: Path) -> dict[str, Any]:
    """Every field of an NPZ; Python objects are admitted where they are strings and numbers.

    Raises:
        InputError: no NPZ, or a field that would run code.
    """
    content: dict[str, Any] = {}
    with readable(path, "NPZ"), zipfile.ZipFile(path) as archive:
        for member in archive.namelist():
            with archive.open(member) as file:
                version = npy.read_magic(file)
                header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
                if header(file)[2].hasobject:
                    content[member.removesuffix(".npy")] = unpickled(file, path)
                    continue
                file.seek(0)
                content[member.removesuffix(".npy")] = array = npy.read_array(file, allow_pickle=False)
                if array.dtype.kind == "U":
                    check_characters(array.reshape(-1).tolist())
    return content


def _names(content: dict[str, Any], field: str) -> tuple[str, ...] | None:
    """The names in a field; some files hold them as bytes."""
    if field not in content:
        return None
    names = np.asarray(content[field]).reshape(-1)
    return tuple(name.decode("utf-8", "replace") if isinstance(name, bytes) else str(name) for name in names)


def _of_qpos(content: dict[str, Any], path: Path) -> Recording:
    qpos = shaped(content["qpos"], "qpos", path, (None, None))
    return Recording(
        joint_pos=qpos[:, 7:],
        joint_names=_names(content, "joint_names"),
        root_pos=qpos[:, :3],
        root_quat=qpos[:, 3:7],
        quaternion="wxyz",
        fps=rate_of(content, path),
        notes=("MuJoCo's qpos, as holosoma's retargeting writes it",),
    )


def _of_root(content: dict[str, Any], path: Path) -> Recording:
    needed(content, ("joint_pos",), path)
    joint_pos = shaped(content["joint_pos"], "joint_pos", path, (None, None))
    return Recording(
        joint_pos=joint_pos,
        joint_names=_names(content, "joint_names"),
        order_is_given=False,
        root_pos=shaped(content["root_pos"], "root_pos", path, (len(joint_pos), 3)),
        root_quat=shaped(content["root_quat"], "root_quat", path, (len(joint_pos), 4)),
        quaternion="wxyz",
        fps=rate_of(content, path),
    )
