"""Pickles of motions: GMR's, its relatives' of one clip a file, and MimicKit's."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.recording import Recording, needed, numbers, rate_of, shaped
from forgetmimic_jax.motion.unpickle import unpickled
from forgetmimic_jax.robot.model import Robot

OTHER_NAMES = {"root_trans_offset": "root_pos", "root_trans": "root_pos", "dof": "dof_pos"}  # ASAP's, HumanoidVerse's


def read_pickle(robot: Robot, path: Path) -> Recording:
    """GMR: fps, root_pos, root_rot (xyzw), dof_pos in the robot's order. MimicKit: fps and frames. Runs no code."""
    if path.read_bytes()[:2] in (b"\x78\x01", b"\x78\x9c", b"\x78\xda", b"\x1f\x8b"):
        raise InputError(
            f"{path}: a compressed file, as joblib writes them; mend: write it anew with "
            "pickle.dump(joblib.load(FILE), open(NEW, 'wb')), from a source that you trust"
        )
    with path.open("rb") as file:
        content = unpickled(file, path)
    if not isinstance(content, Mapping):
        raise InputError(f"{path}: found a {type(content).__name__}; a dict with root_pos, root_rot, dof_pos is needed")
    content, notes = _one_clip(dict(content), path)
    if "frames" in content:
        return _of_mimickit(robot, content, path, notes)
    content = {OTHER_NAMES.get(field, field): value for field, value in content.items()}
    needed(content, ("root_pos", "root_rot", "dof_pos"), path)
    joint_pos = shaped(content["dof_pos"], "dof_pos", path, (None, None))
    frames = len(joint_pos)
    bodies = content.get("link_body_list")
    positions = content.get("local_body_pos")
    named = isinstance(bodies, list | tuple) and positions is not None
    return Recording(
        joint_pos=joint_pos,
        root_pos=shaped(content["root_pos"], "root_pos", path, (frames, 3)),
        root_quat=shaped(content["root_rot"], "root_rot", path, (frames, 4)),
        quaternion="xyzw",
        fps=rate_of(content, path),
        body_names=tuple(map(str, bodies)) if named else None,  # type: ignore[arg-type]
        body_pos=shaped(positions, "local_body_pos", path, (frames, len(bodies), 3)) if named else None,  # type: ignore[arg-type]
        bodies_in_root_frame=True,
        notes=notes,
    )


def _one_clip(content: dict[str, Any], path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """A file's only clip, where it holds clips by name."""
    if not content or not all(isinstance(clip, Mapping) for clip in content.values()):
        return content, ()
    if len(content) > 1:
        names = ", ".join(map(str, list(content)[:4]))
        raise InputError(f"{path}: found {len(content)} clips ({names} …); mend: write each into a file of its own")
    name, clip = next(iter(content.items()))
    return dict(clip), (f"the file's only clip: {name}",)


def _of_mimickit(robot: Robot, content: dict[str, Any], path: Path, notes: tuple[str, ...]) -> Recording:
    """MimicKit: frames of root position 3, root rotation vector 3, joints."""
    frames = numbers(content["frames"], "frames", path)
    if frames.ndim != 2 or frames.shape[1] < 7:
        raise InputError(f"{path}: frames: found shape {list(frames.shape)}; [frames, 6 + joints] is needed")
    return Recording(
        joint_pos=frames[:, 6:],
        root_pos=frames[:, :3],
        root_quat=Rotation.from_rotvec(frames[:, 3:6]).as_quat(),
        quaternion="xyzw",
        fps=rate_of(content, path),
        notes=(*notes, "MimicKit's file"),
    )
