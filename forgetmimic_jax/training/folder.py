"""A run's folder: where it is, whether it can be written, and which checkpoints are in it.

config.yaml         every setting
metrics.jsonl       a row every few iterations
events/             the same for TensorBoard
checkpoints/NUMBER  the newest ones
best/               with evaluations during training: the policy that did best on the clips to keep
"""

from __future__ import annotations

import dataclasses
import os
import shutil
from pathlib import Path

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.settings.config import Config, load_config
from forgetmimic_jax.training.checkpoint import BEST as BEST
from forgetmimic_jax.training.checkpoint import newest_checkpoint

BEGUN = "metrics.jsonl"  # has a row as soon as a run has made an iteration
AT_FIRST = {  # what a run writes before its first checkpoint, with an evaluation of what it starts from
    *("config.yaml", BEGUN, "events", "checkpoints", "evaluations.jsonl", "evaluations.png", BEST, "policies"),
}


def folder_of(path: Path) -> Path | None:
    """The run that a checkpoint belongs to, if any; of a run's folder, itself."""
    if path.parent.name == "checkpoints":
        return path.parent.parent
    return next((folder for folder in (path, path.parent) if (folder / "checkpoints").is_dir()), None)


def default_folder(kind: str, *, resume: bool) -> Path:
    """The next free folder runs/KIND-NUMBER, or with `resume` the last one."""
    numbers = [int(path.name.rpartition("-")[2]) for path in Path("runs").glob(f"{kind}-[0-9]*")
               if path.name.rpartition("-")[2].isdigit()]  # fmt: skip
    last = max(numbers, default=0)
    return Path("runs") / f"{kind}-{last if resume and last else last + 1:03d}"


def prepare_folder(directory: Path, *, resume: bool) -> Path | None:
    """The newest checkpoint to resume from; without `resume` the folder must be new or empty.

    What a run left that was killed before its first checkpoint is removed.

    Raises:
        InputError: the folder exists or cannot be written, or there is nothing to resume.
    """
    check_writable(directory)
    if resume:
        newest = newest_checkpoint(directory)
        if newest is None:
            raise InputError(f"{directory}: --resume finds no checkpoint there; leave it out to start")
        return newest
    if directory.exists() and any(directory.iterdir()):
        if _has_nothing(directory):
            shutil.rmtree(directory)
            return None
        other = "continue with --resume" if newest_checkpoint(directory) else "remove it"
        raise InputError(f"{directory}: exists already; choose another --output, or {other}")
    return None


def config_there(directory: Path, *accepted: Config) -> Config:
    """The settings of the run in a folder that the same command continues, on any number of devices.

    Args:
        directory: of the run.
        accepted: settings that it may have.

    Raises:
        InputError: it has others, or the folder is of no run.
    """
    file = directory / "config.yaml"
    if not file.is_file():
        raise InputError(f"{directory}: exists already, and is of no run; remove it, or choose another --output")
    found = dataclasses.replace(load_config(file), devices=accepted[0].devices)
    if found not in accepted:
        raise InputError(f"{directory}: is of a run with other settings; remove it, or choose another --output")
    return found


def _has_nothing(directory: Path) -> bool:
    """Whether a folder is that of a run that was killed before its first checkpoint."""
    names, log = {path.name for path in directory.iterdir()}, directory / BEGUN
    rows = log.is_file() and log.stat().st_size > 0
    return "config.yaml" in names and names <= AT_FIRST and not rows and newest_checkpoint(directory) is None


def check_writable(directory: Path) -> None:
    """InputError unless `directory` can be written to or made."""
    existing = next(path for path in (directory, *directory.parents) if path.exists())
    if not existing.is_dir():
        raise InputError(f"{directory}: {existing} is a file; choose another --output")
    if not os.access(existing, os.W_OK):
        raise InputError(f"{directory}: no permission to write in {existing}; choose another --output")
