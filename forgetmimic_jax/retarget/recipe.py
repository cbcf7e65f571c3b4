"""The shipped library: which human clips it holds, how each is retargeted, and the folder it becomes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from forgetmimic_jax.basics.errors import InputError, nearest
from forgetmimic_jax.motion import library
from forgetmimic_jax.motion.clip import Clip, write_clip
from forgetmimic_jax.motion.kinematics import heading, quaternion, rotation
from forgetmimic_jax.retarget.contact import human_contact
from forgetmimic_jax.retarget.cycle import resampled
from forgetmimic_jax.retarget.deepmimic import forward_kinematics, read_deepmimic
from forgetmimic_jax.retarget.planar import PlanarTransform, tile
from forgetmimic_jax.retarget.refine import Weights, refine
from forgetmimic_jax.retarget.retarget import Goals, inverse_kinematics, leg_scale, make_goals
from forgetmimic_jax.retarget.timeline import Timeline
from forgetmimic_jax.robot.model import Robot

FPS = 50.0
LICENCE = "MIT (xbpeng/DeepMimic) and zlib (pybullet 3.2.7, pybullet_data/data/motions)"
ATTRIBUTION = (
    "Retargeted from DeepMimic's motion clips, Copyright (c) 2018 Xue Bin Peng "
    "(https://github.com/xbpeng/DeepMimic), as carried by the PyPI package pybullet"
)


@dataclass(frozen=True)
class Settings:
    """How one human clip becomes a robot's."""

    ballistic: bool = False
    """Time runs by sqrt(scale), so that a flight of scaled height falls with the same gravity."""
    seconds: float = 10.0
    """Length that a cyclic clip is tiled to; one that does not repeat keeps its own."""


CLIPS: dict[str, Settings] = {
    "walk": Settings(),
    "run": Settings(ballistic=True),
    "jump": Settings(ballistic=True),
    "dance_a": Settings(),
    "dance_b": Settings(),
    "spin": Settings(ballistic=True),
    "punch": Settings(),
    "kick": Settings(),
    "spinkick": Settings(ballistic=True),
    "cartwheel": Settings(ballistic=True),
    "backflip": Settings(ballistic=True),
    "getup_faceup": Settings(),
}
DEFAULT_TARGETS = ("punch", "kick")


@dataclass(frozen=True)
class Retargeted:
    """A robot's clip and how it came about."""

    clip: Clip
    scale: float  # robot's leg length over the human's
    time_scale: float  # robot's time over the human's
    cycle_frames: int | None  # of a cyclic clip
    direction_error: float  # rad, mean angle between the human's limbs and the robot's


def source_file(folder: Path, name: str) -> Path:
    """DeepMimic's file of a clip."""
    return folder / f"humanoid3d_{name}.txt"


def retarget_clip(robot: Robot, path: Path, name: str, settings: Settings) -> Retargeted:
    """Retarget one DeepMimic file."""
    scale = leg_scale(robot)
    time_scale = float(np.sqrt(scale)) if settings.ballistic else 1.0
    motion, human_step = resampled(read_deepmimic(path), FPS, time_scale)
    human = forward_kinematics(motion)
    step = None if human_step is None else PlanarTransform(human_step.yaw, human_step.shift * scale)
    goals = make_goals(robot, human)
    qpos = refine(
        robot,
        goals,
        human_contact(human, FPS * time_scale),  # speeds of the human's own time
        inverse_kinematics(robot, goals),
        Timeline(goals.num_frames, step, FPS),
    )
    cycle = Clip(name, FPS, robot.joint_names, qpos[:, :3], quaternion(rotation(qpos[:, 3:7])), qpos[:, 7:])
    clip = cycle if step is None else tile(cycle, step, settings.seconds)
    return Retargeted(
        _at_origin(clip),
        scale,
        time_scale,
        None if step is None else cycle.num_frames,
        direction_error(robot, goals, qpos),
    )


def direction_error(robot: Robot, goals: Goals, qpos: np.ndarray) -> float:
    """Mean angle in rad between the directions of the human's limbs and the robot's, over limbs and frames."""
    limbs = [vector for vector in goals.vectors if vector.start is not None]
    data = mujoco.MjData(robot.model)
    angles = np.empty((len(qpos), len(limbs)))
    for frame, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(robot.model, data)
        cosines = [limb.value(data) @ limb.goal[frame] for limb in limbs]
        angles[frame] = np.arccos(np.clip(cosines, -1.0, 1.0))
    return float(angles.mean())


def _at_origin(clip: Clip) -> Clip:
    """The clip moved in the plane so that it starts at the origin, facing x."""
    turns = rotation(clip.root_quat)
    yaw = -float(heading(turns[0].as_quat(scalar_first=True)))
    move = PlanarTransform(yaw, np.zeros(2))
    move = PlanarTransform(yaw, -move.apply(clip.root_pos[0])[:2])
    return dataclasses.replace(clip, root_pos=move.apply(clip.root_pos), root_quat=quaternion(move.turn(turns)))


def check_output(folder: Path, *, overwrite: bool) -> None:
    """Raise an InputError where the folder of the library to make holds something that is to be kept."""
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    if not (folder / library.MANIFEST).exists():
        raise InputError(f"{folder}: has files but no {library.MANIFEST}; give an empty or a new folder")
    if not overwrite:
        raise InputError(f"{folder}: already holds a library; give another --output, or --force")


def shipped_clips(robot: str) -> tuple[str, ...]:
    """The clips that are shipped for a robot; every clip of the recipe for another one."""
    folder = library.DATA_DIR / robot
    return tuple(library.read_manifest(folder)["clips"] if folder.is_dir() else CLIPS)


def retarget_library(
    robot: Robot,
    source: Path,
    output: Path,
    names: Iterable[str] = tuple(CLIPS),
    progress: Callable[[str], None] = lambda name: None,
) -> Path:
    """Make the shipped library from a folder of DeepMimic clips; nothing is written before every clip is made.

    Args:
        robot: to retarget to.
        source: folder with humanoid3d_*.txt.
        output: folder of the library.
        names: clips to make.
        progress: called with each clip's name when it is made.

    Raises:
        InputError: no clip of that name, or one that is missing from the folder or is not DeepMimic's.
    """
    names = tuple(names)
    for name in names:
        if name not in CLIPS:
            raise InputError(f"clips: no clip '{name}'; {nearest(name, CLIPS)}")
        if not source_file(source, name).is_file():
            raise InputError(f"{source_file(source, name)}: not found; retarget needs DeepMimic's humanoid3d_*.txt")
        read_deepmimic(source_file(source, name))
    results = {}
    for name in names:
        results[name] = retarget_clip(robot, source_file(source, name), name, CLIPS[name])
        progress(name)
    output.mkdir(parents=True, exist_ok=True)
    entries = {}
    for name, result in results.items():
        write_clip(result.clip, output / f"{name}.npz")
        entries[name] = _entry(result, source_file(source, name), output / f"{name}.npz")
    library.write_manifest(
        output,
        {
            "schema": library.SCHEMA,
            "robot": robot.name,
            "fps": FPS,
            "default_targets": [name for name in DEFAULT_TARGETS if name in names],
            "refinement": dataclasses.asdict(Weights()),
            "clips": entries,
        },
    )
    return output


def _entry(result: Retargeted, source: Path, file: Path) -> dict[str, Any]:
    clip, cycle = result.clip, result.cycle_frames
    return {
        "sha256": library.file_hash(file),
        "source": source.name,
        "source_sha256": library.file_hash(source),
        "licence": LICENCE,
        "attribution": ATTRIBUTION,
        "frames": clip.num_frames,
        "seconds": clip.seconds,
        "cyclic": cycle is not None,
        "cycle_frames": cycle,
        "cycles": None if cycle is None else round(clip.num_frames / cycle, 3),
        "scale": round(result.scale, 6),
        "time_scale": round(result.time_scale, 6),
        "direction_error_deg": round(float(np.degrees(result.direction_error)), 1),
    }
