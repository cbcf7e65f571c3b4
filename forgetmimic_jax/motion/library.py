"""The motion library: clips of one robot, one after the other in arrays [frame, ...] for the training, and its folder.

A folder holds one NAME.npz a clip and manifest.json with each file's hash, origin and settings.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from forgetmimic_jax.basics.errors import InputError, nearest
from forgetmimic_jax.basics.files import write_json
from forgetmimic_jax.basics.places import shipped
from forgetmimic_jax.motion.clip import Clip, read_clip, write_clip
from forgetmimic_jax.motion.kinematics import body_motion, configuration, rate, resample
from forgetmimic_jax.robot.bodies import Bodies, Values
from forgetmimic_jax.robot.model import Robot

DATA_DIR = shipped("data")
MANIFEST = "manifest.json"
SCHEMA = 1
MAX_LINEAR_ACCELERATION = 50.0  # m/s^2, the assistive wrench's clip on the reference
MAX_ANGULAR_ACCELERATION = 100.0  # rad/s^2


@struct.dataclass
class Frames:
    """Frames of reference motion. Leading dimensions are free: [frame] or [env]."""

    joint_pos: Values  # [..., joint] rad
    joint_vel: Values  # [..., joint] rad/s
    bodies: Bodies  # [..., key_body]
    anchor_lin_acc: Values  # [..., 3] m/s², norm at most 50
    anchor_ang_acc: Values  # [..., 3] rad/s², norm at most 100


@struct.dataclass
class MotionLibrary:
    """Reference motions of one robot."""

    frames: Frames  # [frame] of all clips, one clip after the other
    start: Array  # i32[clip] where each clip begins
    length: Array  # i32[clip] frames of each clip
    names: tuple[str, ...] = struct.field(pytree_node=False)

    def at(self, clip: Array | int, frame: Array | int) -> Frames:
        """Frames of clips, both of any one shape; past a clip's end its last frame."""
        place = self.start[clip] + jnp.minimum(frame, self.length[clip] - 1)
        return jax.tree.map(lambda values: values[place], self.frames)

    def clip(self, clip: int) -> Frames:
        """All frames of a clip [frame], as numpy arrays."""
        first, length = int(self.start[clip]), int(self.length[clip])
        return jax.tree.map(lambda values: np.asarray(values)[first : first + length], self.frames)


def build_library(robot: Robot, clips: Sequence[Clip], fps: float = 50.0) -> MotionLibrary:
    """Resample clips of the robot to the control rate `fps` in Hz, and derive body motion."""
    rows = [_frames(robot, clip if clip.fps == fps else resample(clip, fps)) for clip in clips]
    return _one_after_the_other(rows, [clip.name for clip in clips])


def load_library(
    robot: Robot, path: Path | None = None, clips: Sequence[str] | None = None, fps: float = 50.0
) -> MotionLibrary:
    """Load a library folder.

    Args:
        robot: whose clips they are.
        path: the folder; data/ROBOT by default.
        clips: names to load, in this order; all in the manifest's order by default.
        fps: control rate in Hz; clips at another rate are resampled.

    Raises:
        InputError: no or empty library, another robot's, an unknown clip, or a file that differs from its hash.
    """
    return build_library(robot, read_library(robot, path, clips), fps)


def only_clips(library: MotionLibrary, names: Sequence[str]) -> MotionLibrary:
    """The clips called `names`, in this order."""
    return _one_after_the_other([library.clip(library.names.index(name)) for name in names], names)


def read_library(robot: Robot, path: Path | None = None, clips: Sequence[str] | None = None) -> list[Clip]:
    """The library's clips as they are on disk; arguments and errors as in `load_library`."""
    path = DATA_DIR / robot.name if path is None else Path(path)
    manifest = read_manifest(path)
    if manifest["robot"] != robot.name:
        raise InputError(f"{path / MANIFEST}: robot: found '{manifest['robot']}'; '{robot.name}' is needed")
    known = list(manifest["clips"])
    if not known:
        raise InputError(f"{path / MANIFEST}: clips: the library is empty; import or retarget a clip first")
    loaded = []
    for name in known if clips is None else clips:
        if name not in known:
            raise InputError(f"{path}: no clip '{name}'; {nearest(name, known)}")
        file = path / f"{name}.npz"
        found = file_hash(file)
        if found != manifest["clips"][name]["sha256"]:
            raise InputError(
                f"{file}: sha256 {found[:16]}… differs from the manifest's "
                f"{manifest['clips'][name]['sha256'][:16]}…; the file was changed or damaged, import it again"
            )
        clip = read_clip(file)
        _check_joints(clip, robot, str(file))
        loaded.append(clip)
    return loaded


def read_manifest(path: Path) -> dict[str, Any]:
    """The folder's manifest: robot, fps, schema and one entry a clip."""
    file = path / MANIFEST
    if not file.is_file():
        raise InputError(f"{file}: not found; a library is a folder with {MANIFEST}")
    try:
        manifest = json.loads(file.read_text())
    except ValueError as error:
        raise InputError(f"{file}: not JSON ({error})") from error
    for field in ("schema", "robot", "fps", "clips"):
        if not isinstance(manifest, dict) or field not in manifest:
            raise InputError(f"{file}: missing field '{field}'")
    if manifest["schema"] != SCHEMA:
        raise InputError(f"{file}: schema: found {manifest['schema']}; this version reads {SCHEMA}")
    return manifest


def write_manifest(path: Path, manifest: dict[str, Any]) -> None:
    """Write the folder's manifest in one atomic step."""
    write_json(path / MANIFEST, manifest)


def manifest_for(path: Path, robot: Robot, name: str, fps: float, *, overwrite: bool = False) -> dict[str, Any]:
    """The manifest of a folder that is to get a clip; a new one for a folder that is no library yet.

    Raises:
        InputError: a name that cannot be a file's, another robot's library, another rate, or a name that is taken.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", name):
        raise InputError(f"name: found '{name}'; letters, digits, - and _ are accepted, a letter or digit first")
    if (path / MANIFEST).exists():
        manifest = read_manifest(path)
    else:
        if path.is_dir() and any(path.iterdir()):
            raise InputError(f"{path}: has files but no {MANIFEST}; give an empty or a new folder, or a library")
        manifest = {"schema": SCHEMA, "robot": robot.name, "fps": fps, "default_targets": [], "clips": {}}
    if manifest["robot"] != robot.name:
        raise InputError(f"{path / MANIFEST}: robot: found '{manifest['robot']}'; the clip is '{robot.name}'s")
    if manifest["fps"] != fps:
        raise InputError(f"{path / MANIFEST}: fps: found {manifest['fps']}; the clip has {fps}")
    if name in manifest["clips"] and not overwrite:
        raise InputError(f"{path}: already has a clip '{name}'; give another --name, or --force to replace it")
    return manifest


def add_clip(path: Path, robot: Robot, clip: Clip, facts: Mapping[str, Any], *, overwrite: bool = False) -> Path:
    """Write a clip and its manifest entry; a folder that is no library yet becomes one.

    Args:
        path: the library's folder.
        robot: whose clip it is.
        clip: at the library's rate.
        facts: for the manifest, such as source and licence.
        overwrite: replace a clip of that name.

    Raises:
        InputError: other joints than the robot's, or as `manifest_for`.
    """
    _check_joints(clip, robot)
    manifest = manifest_for(path, robot, clip.name, clip.fps, overwrite=overwrite)
    path.mkdir(parents=True, exist_ok=True)
    if not (path / MANIFEST).exists():
        write_manifest(path, manifest)  # first, so that what a crash leaves is a library too
    file = path / f"{clip.name}.npz"
    write_clip(clip, file)
    measures = {"frames": clip.num_frames, "seconds": clip.seconds}
    manifest["clips"][clip.name] = {"sha256": file_hash(file), **facts, **measures}
    write_manifest(path, manifest)
    return file


def file_hash(path: Path) -> str:
    """sha256 of a file, hex."""
    if not path.is_file():
        raise InputError(f"{path}: not found, though the manifest lists it")
    return hashlib.sha256(path.read_bytes()).hexdigest()


def library_hash(path: Path) -> str:
    """16 hex digits over the clips' names and contents: what a result was computed on."""
    path = Path(path)
    digest = hashlib.sha256()
    for name in sorted(read_manifest(path)["clips"]):
        digest.update(f"{name}\0{file_hash(path / f'{name}.npz')}\n".encode())
    return digest.hexdigest()[:16]


def _check_joints(clip: Clip, robot: Robot, source: str | None = None) -> None:
    if set(clip.joint_names) != set(robot.joint_names):
        missing = sorted(set(robot.joint_names) - set(clip.joint_names))
        unknown = sorted(set(clip.joint_names) - set(robot.joint_names))
        raise InputError(
            f"{source or clip.name}: joint_names: found {len(clip.joint_names)} joints that are not the {robot.name}'s "
            f"{robot.num_joints} (missing: {', '.join(missing[:3]) or 'none'}; "
            f"unknown: {', '.join(unknown[:3]) or 'none'})"
        )


def _one_after_the_other(clips: Sequence[Frames], names: Sequence[str]) -> MotionLibrary:
    """A library of clips [frame], given as numpy arrays."""
    lengths = np.array([len(clip.joint_pos) for clip in clips])
    return MotionLibrary(
        frames=jax.tree.map(lambda *values: jnp.asarray(np.concatenate(values), jnp.float32), *clips),
        start=jnp.asarray(np.cumsum(lengths) - lengths, jnp.int32),
        length=jnp.asarray(lengths, jnp.int32),
        names=tuple(names),
    )


def _frames(robot: Robot, clip: Clip) -> Frames:
    """A clip's frames [frame], as numpy arrays."""
    qpos = configuration(clip, robot)
    bodies = body_motion(robot.model, qpos, clip.fps, robot.key_body_ids)
    return Frames(
        joint_pos=qpos[:, 7:],
        joint_vel=rate(qpos[:, 7:], clip.fps),
        bodies=bodies,
        anchor_lin_acc=_clipped(rate(bodies.lin_vel[:, robot.anchor], clip.fps), MAX_LINEAR_ACCELERATION),
        anchor_ang_acc=_clipped(rate(bodies.ang_vel[:, robot.anchor], clip.fps), MAX_ANGULAR_ACCELERATION),
    )


def _clipped(vectors: np.ndarray, limit: float) -> np.ndarray:
    """Vectors [frame, 3] shortened to a norm of at most `limit`."""
    norm = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors * np.minimum(1.0, limit / np.maximum(norm, 1e-9))
