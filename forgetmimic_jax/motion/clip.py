"""One motion of one robot on the host, and its file: an uncompressed NPZ."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.files import check_characters, readable, write_atomically
from forgetmimic_jax.motion.recording import numbers

DIMENSIONS = {"fps": 0, "joint_names": 1, "root_pos": 2, "root_quat": 2, "joint_pos": 2}  # of each field's array
FIELDS = tuple(DIMENSIONS)
# Coarser than the last bits that differ between machines' linear algebra, so that a clip regenerates bit for bit;
# 1e-5 rad or m is far below what a motor or a foot can tell.
DECIMALS = 5


@dataclass(frozen=True)
class Clip:
    """A motion of one robot: the floating base's pose in the world (z up) and the joint angles of every frame."""

    name: str
    fps: float
    joint_names: tuple[str, ...]
    root_pos: np.ndarray  # [frame, 3] m
    root_quat: np.ndarray  # [frame, 4] wxyz
    joint_pos: np.ndarray  # [frame, joint] rad

    @property
    def num_frames(self) -> int:
        return len(self.root_pos)

    @property
    def seconds(self) -> float:
        """Duration in s: a frame stands for one control step."""
        return self.num_frames / self.fps

    def part(self, first: int, end: int) -> Clip:
        """The frames first ≤ frame < end."""
        frames = slice(first, end)
        return replace(
            self,
            root_pos=self.root_pos[frames],
            root_quat=self.root_quat[frames],
            joint_pos=self.joint_pos[frames],
        )


def default_name(stem: str) -> str:
    """A clip's name from a file's or a folder's: other characters than letters, digits, - and _ become _."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", stem).strip("_-") or "clip"


def validated(clip: Clip, source: str, first: int = 0) -> Clip:
    """The clip with unit quaternions on one continuous branch, or an InputError that names `source` and the field.

    `first` is the source's frame that the clip begins with.
    """
    frames = len(clip.root_pos)
    if not np.isfinite(clip.fps) or clip.fps <= 0:
        raise InputError(f"{source}: fps: found {clip.fps}; a positive number of frames per second is needed")
    shapes = {"root_pos": (frames, 3), "root_quat": (frames, 4), "joint_pos": (frames, len(clip.joint_names))}
    for field, shape in shapes.items():
        value = getattr(clip, field)
        if value.shape != shape:
            raise InputError(f"{source}: {field}: found shape {list(value.shape)}; {list(shape)} is needed")
        if not np.isfinite(value).all():
            frame = first + int(np.argwhere(~np.isfinite(value))[0][0])
            raise InputError(
                f"{source}: {field}: NaN or infinity in frame {frame} ({frame / clip.fps:.2f} s); every number must be "
                "finite"
            )
    if frames < 2:
        raise InputError(f"{source}: found {frames} frame(s); a clip needs at least 2")
    with np.errstate(over="ignore"):  # of numbers that no quaternion has; the next line refuses them
        norm = np.linalg.norm(clip.root_quat, axis=-1)
    if (np.abs(norm - 1.0) > 0.05).any():
        frame = int(np.argmax(np.abs(norm - 1.0)))
        raise InputError(
            f"{source}: root_quat: norm {norm[frame]:.3g} in frame {first + frame} ({(first + frame) / clip.fps:.2f} "
            "s); unit quaternions are needed"
        )
    quat = continuous(clip.root_quat / norm[:, None])
    return Clip(clip.name, float(clip.fps), tuple(clip.joint_names), clip.root_pos, quat, clip.joint_pos)


def continuous(quat: np.ndarray) -> np.ndarray:
    """Quaternions [frame, 4] with signs flipped so that neighbours lie in one hemisphere."""
    flips = np.sign(np.sum(quat[1:] * quat[:-1], axis=-1))
    signs = np.cumprod(np.concatenate([[1.0], np.where(flips == 0, 1.0, flips)]))
    return quat * signs[:, None]


def rounded(clip: Clip) -> Clip:
    """The clip as its file holds it: rounded, then float32."""

    def cut(values: np.ndarray) -> np.ndarray:
        return (np.round(values, DECIMALS) + 0.0).astype(np.float32)  # + 0.0 turns -0.0 into 0.0

    return Clip(
        clip.name, float(clip.fps), clip.joint_names, cut(clip.root_pos), cut(clip.root_quat), cut(clip.joint_pos)
    )


def write_clip(clip: Clip, path: Path) -> None:
    """Write NAME.npz; the bytes depend on the clip alone (np.savez dates its members 1980)."""
    clip = rounded(clip)
    buffer = io.BytesIO()
    np.savez(
        buffer,
        fps=np.float64(clip.fps),
        joint_names=np.array(clip.joint_names),
        root_pos=clip.root_pos,
        root_quat=clip.root_quat,
        joint_pos=clip.joint_pos,
    )
    write_atomically(path, buffer.getvalue())


def read_clip(path: Path) -> Clip:
    """Read a library's NAME.npz.

    Raises:
        InputError: not an NPZ, a missing field, or numbers that are no motion.
    """
    with readable(path, "clip NPZ"), np.load(path, allow_pickle=False) as archive:
        missing = [field for field in FIELDS if field not in archive]
        if missing:
            raise InputError(f"{path}: missing {', '.join(missing)}; a clip holds {', '.join(FIELDS)}")
        content = {field: np.asarray(archive[field]) for field in FIELDS}
        if content["joint_names"].dtype.kind == "U":
            check_characters(content["joint_names"].reshape(-1).tolist())
    for field, value in content.items():
        accepted = "U" if field == "joint_names" else "iuf"
        if value.dtype.kind not in accepted or value.ndim != DIMENSIONS[field]:
            raise InputError(
                f"{path}: {field}: found {value.dtype.name} of shape {list(value.shape)}; "
                f"{'text' if accepted == 'U' else 'numbers'} in {DIMENSIONS[field]} dimensions are needed"
            )
    return validated(
        Clip(
            name=path.stem,
            fps=float(content["fps"]),
            joint_names=tuple(str(joint) for joint in content["joint_names"]),
            root_pos=numbers(content["root_pos"], "root_pos", path),
            root_quat=numbers(content["root_quat"], "root_quat", path),
            joint_pos=numbers(content["joint_pos"], "joint_pos", path),
        ),
        str(path),
    )
