"""Setup: a config with what it names loaded. The value that training, evaluation and the viewers are given whole."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path

import jax

from forgetmimic_jax.basics.errors import InputError, nearest
from forgetmimic_jax.basics.places import cache_folder
from forgetmimic_jax.basics.provenance import compiled_for
from forgetmimic_jax.motion.library import (
    DATA_DIR,
    MotionLibrary,
    library_hash,
    load_library,
    only_clips,
    read_manifest,
)
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.robot.model import Robot, load_robot
from forgetmimic_jax.settings.config import Config, validate
from forgetmimic_jax.tracking.layouts import find_layout
from forgetmimic_jax.tracking.stand import STAND, stand_library

MONTH = 30 * 24 * 3600.0  # s


@dataclass(frozen=True)
class Setup:
    """A config, its robot and its clips."""

    config: Config
    robot: Robot
    library: MotionLibrary
    library_hash: str
    base: Policy | None = None  # the frozen policy that an unlearning run starts from and compares with
    teacher: Policy | None = None  # the policy that shows what to do instead of a target
    instead: MotionLibrary | None = None  # its only clip is what to do instead of a target


def make_setup(config: Config) -> Setup:
    """Load what a config names.

    Raises:
        InputError: a number that no run can work with, or an unknown layout, robot, library or target.
    """
    validate(config)
    find_layout(config.observation.layout)
    if not jax.config.values["jax_compilation_cache_dir"]:
        jax.config.update("jax_compilation_cache_dir", str(cache_of_programs()))
    robot = load_robot(config.robot, config.physics, config.action)
    folder = library_folder(config)
    library = load_library(robot, folder, fps=1.0 / config.physics.control_step)
    check_targets(config.unlearn.targets, library.names)
    instead = instead_of_targets(config, robot, library)
    return Setup(config, robot, library, library_hash(folder), instead=instead)


def cache_of_programs() -> Path:
    """The folder of XLA's cache of compiled programs; those that are older than 30 days are deleted."""
    folder = cache_folder() / "jax" / compiled_for()
    for program in folder.glob("*-cache"):
        with contextlib.suppress(OSError):  # another process may be faster
            if time.time() - program.stat().st_mtime > MONTH:
                program.unlink()
    return folder


def library_folder(config: Config) -> Path:
    """The folder of a config's clips."""
    return DATA_DIR / config.robot if config.library is None else Path(config.library)


def on_library(config: Config, library: Path | None) -> Config:
    """The config with the clips of another library, if one is named, and of its targets those that are among them."""
    if library is None:
        return config
    known = read_manifest(library)["clips"]
    targets = tuple(target for target in config.unlearn.targets if target in known)
    unlearn, sampling = dataclasses.replace(config.unlearn, targets=targets), config.sampling
    if not targets:
        sampling = dataclasses.replace(sampling, target_share=0.0)
    return dataclasses.replace(config, library=str(library), unlearn=unlearn, sampling=sampling)


def default_targets(config: Config) -> tuple[str, ...]:
    """The clips that the library itself proposes to forget."""
    return tuple(read_manifest(library_folder(config)).get("default_targets", ()))


def instead_of_targets(config: Config, robot: Robot, library: MotionLibrary) -> MotionLibrary | None:
    """A library of the one clip that the targets are replaced with (`unlearn.instead`); None where there is none.

    Raises:
        InputError: a clip that is not in the library, or one to forget.
    """
    name, targets = config.unlearn.instead, config.unlearn.targets
    if name is None:
        return None
    if name == STAND:
        return stand_library(robot, fps=1.0 / config.physics.control_step)
    kept = [clip for clip in library.names if clip not in targets]
    if name not in kept:
        found = f"'{name}' is a clip to forget" if name in targets else f"no clip '{name}' in the library"
        raise InputError(f"unlearn.instead: {found}; {nearest(name, [STAND, *kept])}")
    return only_clips(library, [name])


def check_targets(targets: tuple[str, ...], names: tuple[str, ...]) -> None:
    """Targets must be clips of the library, and not all of them.

    Raises:
        InputError: an unknown clip, or nothing left to keep.
    """
    for target in targets:
        if target not in names:
            raise InputError(f"targets: no clip '{target}' in the library; {nearest(target, names)}")
    if targets and set(targets) == set(names):
        raise InputError(f"targets: all {len(names)} clips of the library; leave at least one to keep")
