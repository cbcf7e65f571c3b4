"""A policy of another project: read from its files, described in this project's terms, with the clip it comes with."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.exchange import clips, sources
from forgetmimic_jax.exchange.description import ASSUMED, Description, Row, agreed, describe
from forgetmimic_jax.exchange.imported import ImportedActor, behind, check_actor
from forgetmimic_jax.exchange.onnx_actor import OnnxActor
from forgetmimic_jax.exchange.onnx_reader import OnnxContent, read_onnx
from forgetmimic_jax.exchange.rsl_rl import read_rsl_rl
from forgetmimic_jax.motion.clip import Clip, rounded
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.settings.config import Config, ObservationConfig

READERS = (".onnx", ".pt", ".pth")
NO_CONTACT_BOUND = 100.0  # body weights: more than any contact


@dataclass(frozen=True)
class PolicyReading:
    """How files are to be read, where they do not say."""

    layout: str | None = None
    mode: str | None = None
    order: Literal["robot", "isaac"] | None = None  # of joints
    activation: str | None = None  # of a .pt
    fps: float | None = None  # of a motion file beside a policy
    start: float = 0.0  # s, the first of the clip that is taken
    own_clip: bool = True  # whether the clip inside the file or beside it is read


@dataclass(frozen=True)
class ForeignPolicy:
    """An actor that sees our observation, its description and its clip."""

    path: Path
    actor: ImportedActor
    description: Description
    clip: Clip | None  # as a library holds it
    clip_file: Path | None  # where it is from
    original: Callable[[np.ndarray], np.ndarray]  # actions [n, joint] at our observations [n, features], as the file's
    rows: tuple[Row, ...]
    doubts: tuple[str, ...]

    def config(self, config: Config) -> Config:
        """The settings under which it acts: its layout, action and network, and the bounds of its project.

        The tracking tasks of mjlab and BeyondMimic have no bound on contact forces.
        """
        termination = config.termination
        if self.description.layout.name.startswith("mjlab"):
            termination = dataclasses.replace(termination, contact_force=NO_CONTACT_BOUND)
        return dataclasses.replace(
            config,
            observation=ObservationConfig(self.description.layout.name),
            action=self.description.action,
            termination=termination,
            ppo=dataclasses.replace(config.ppo, actor_layers=self.actor.hidden_layers),
        )


def read_policy(path: Path, robot: Robot, step_dt: float, reading: PolicyReading) -> ForeignPolicy:
    """Read a policy and all that its files say of it.

    Args:
        path: an ONNX file, or a checkpoint of rsl_rl.
        robot: that it must be of, without any policy's tables.
        step_dt: s between two actions.
        reading: how.

    Raises:
        InputError: what cannot be read, is not supported, or contradicts itself.
    """
    if path.suffix.lower() not in READERS:
        raise InputError(f"{path}: suffix: found '{path.suffix}'; accepted: {', '.join(READERS)}")
    content = read_onnx(path) if path.suffix.lower() == ".onnx" else None
    actor = content.actor if content else read_rsl_rl(path, reading.activation)
    description = _described(path, content, robot, step_dt, reading)
    check_actor(actor, description.layout, robot, path)
    clip, motion, of_clip = _clip(path, content, description, robot, reading)
    rows = [*description.rows, _network(actor), of_clip]
    doubt = clips.garbage(robot, clip) if clip else None
    return ForeignPolicy(
        path=path,
        actor=behind(actor, description.factor, description.shift),
        description=description,
        clip=clip,
        clip_file=motion,
        original=_original(path, actor, description),
        rows=tuple(rows),
        doubts=(doubt,) if doubt else (),
    )


def _described(
    path: Path, content: OnnxContent | None, robot: Robot, step_dt: float, reading: PolicyReading
) -> Description:
    found = [("the flags", sources.from_flags(reading.layout, reading.mode, reading.order, robot))]
    if content and content.metadata:
        found.append(("the metadata", sources.from_metadata(content.metadata, robot, str(path))))
    found += sources.beside(path, robot)
    return describe(agreed(found, path), robot, step_dt, path)


def _clip(
    path: Path, content: OnnxContent | None, description: Description, robot: Robot, reading: PolicyReading
) -> tuple[Clip | None, Path | None, Row]:
    """The clip inside the file or beside it, where it is from, and the row that says so."""
    if not reading.own_clip:
        return None, None, Row("clip", "those of --library", "--library")
    motion = sources.motion_beside(path)
    if content and content.clip:
        joints = description.action.joint_order or robot.joint_names
        clip, file = clips.clip_inside(content.clip, joints, description.body_names, robot, path), path
        bodies = "" if description.body_names else f"; {ASSUMED}no body_names; the first body is the root"
        source = f"inside the file, at 50 Hz{bodies}"
    elif motion:
        clip, file, source = clips.clip_beside(motion, reading.fps, robot), motion, f"{motion.name} beside the file"
    else:
        return None, None, Row("clip", "those of --library", "not in the file, and not one .csv or .npz beside it")
    clip = rounded(clips.from_second(clip, reading.start))
    return clip, file, Row("clip", f"{clip.name}, {clip.num_frames} frames, {clip.seconds:.1f} s", source)


def _network(actor: ImportedActor) -> Row:
    sizes = [actor.layers[0][0].shape[0], *(kernel.shape[1] for kernel, _ in actor.layers)]
    normaliser = "no normaliser" if actor.scale is None else "a normaliser"
    return Row("network", f"{'-'.join(map(str, sizes))}, {normaliser}", "the weights")


def _original(path: Path, actor: ImportedActor, description: Description) -> Callable[[np.ndarray], np.ndarray]:
    """The file's own actions: of an ONNX under onnxruntime, of a .pt as rsl_rl computes them."""
    if path.suffix.lower() != ".onnx":
        return lambda observations: actor(description.seen(observations).astype(np.float32))
    onnx = OnnxActor(path)
    return lambda observations: np.stack([onnx(each) for each in description.seen(observations)])
