"""Checkpoints: orbax trees, the config and a note of what they belong to, in a folder that appears whole or not at all.

`policy/` holds the networks and their normalisers, `sampler/` the failure levels of the clips' bins: what goes from one
run to another. `run/` holds all the rest of the TrainState, for resuming; a shipped checkpoint may lack it.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
from jax import Array

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.library import MotionLibrary
from forgetmimic_jax.ppo.state import Policy, TrainState
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.settings.config import Config, load_config, save_config, to_dict

POLICY, SAMPLER, RUN, CONFIG, META = "policy", "sampler", "run", "config.yaml", "meta.json"
SCHEMA = 1


@dataclass(frozen=True)
class CheckpointInfo:
    """What a checkpoint says of itself."""

    path: Path
    config: Config
    robot: str
    joints: tuple[str, ...]
    clips: tuple[str, ...]
    library_hash: str
    iteration: int
    environment_steps: int
    files: dict[str, str]  # sha256 of each file of the trees
    base: str | None  # `policy_hash` of the checkpoint that unlearning started from


def save_checkpoint(
    path: Path,
    state: TrainState,
    config: Config,
    robot: Robot,
    library: MotionLibrary,
    library_hash: str,
    *,
    environment_steps: int,
    base: str | None = None,
    resumable: bool = True,
) -> None:
    """Write a run's state to folder `path`; one of the same name is replaced only once the new one is complete.

    A run that is killed while it saves leaves a hidden folder, which the next save removes.

    Args:
        path: the checkpoint's folder.
        state: of the run.
        config: of the run.
        robot: the robot trained.
        library: the clips trained on.
        library_hash: of those clips.
        environment_steps: control steps lived so far, all environments together, with those of the base that
            training went on from.
        base: of an unlearning run, the `policy_hash` of the checkpoint it started from.
        resumable: with `run/`; without, the checkpoint is small and serves evaluation and warm starts only.

    Raises:
        OSError: the system refused; a full disk, for one. Nothing is left of the attempt.
    """
    state = jax.tree.map(np.asarray, state)
    trees: dict[str, Any] = {POLICY: {"policy": state.policy}, SAMPLER: {"failure_level": state.failure_level}}
    if resumable:
        trees[RUN] = _run_part(state)
    meta: dict[str, Any] = {
        "schema": SCHEMA,
        "robot": robot.name,
        "joints": list(robot.joint_names),
        "clips": list(library.names),
        "library_hash": library_hash,
        "iteration": int(state.iteration),
        "environment_steps": environment_steps,
        "base": base,
    }
    for abandoned in path.parent.glob(".*.tmp"):
        shutil.rmtree(abandoned, ignore_errors=True)
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        temporary.mkdir(parents=True)
        _check_space(temporary, trees)
        with ocp.StandardCheckpointer() as checkpointer:
            for name, tree in trees.items():
                checkpointer.save((temporary / name).resolve(), tree)
                checkpointer.wait_until_finished()
                # Orbax notes there where the folder was written, which is nobody else's business; it is not read back.
                (temporary / name / "commit_success.txt").unlink(missing_ok=True)
        meta["files"] = _hashes(temporary)
        save_config(config, temporary / CONFIG)
        (temporary / META).write_text(json.dumps(meta, indent=2) + "\n")
        shutil.rmtree(path, ignore_errors=True)
        temporary.rename(path)
    except ValueError as error:
        # Tensorstore tells what the system refused inside the text of a ValueError.
        code = re.search(r"os_error_code='(\d+)'", str(error))
        if not code:
            raise
        raise OSError(int(code[1]), os.strerror(int(code[1])), str(path)) from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def fingerprint(path: Path) -> str:
    """SHA-256 of what a checkpoint says of itself: another policy, or other settings, give another."""
    return hashlib.sha256((path / META).read_bytes() + (path / CONFIG).read_bytes()).hexdigest()


def read_info(path: Path) -> CheckpointInfo:
    """A checkpoint's note and config.

    Raises:
        InputError: not a checkpoint, or a damaged one.
    """
    if not path.is_dir():
        raise InputError(f"{path}: no such checkpoint folder")
    try:
        meta = json.loads((path / META).read_text())
        if meta["schema"] != SCHEMA:
            raise InputError(f"{path / META}: schema: found {meta['schema']!r}; this version reads {SCHEMA}")
        known = dict(
            robot=meta["robot"],
            joints=tuple(meta["joints"]),
            clips=tuple(meta["clips"]),
            library_hash=meta["library_hash"],
            iteration=int(meta["iteration"]),
            environment_steps=int(meta["environment_steps"]),
            files=dict(meta.get("files", {})),
            base=meta.get("base"),
        )
    except FileNotFoundError:
        newest = newest_checkpoint(path)
        hint = f"; it is a run, whose newest checkpoint is {newest}" if newest else ""
        raise InputError(f"{path}: not a checkpoint: no {META}{hint}") from None
    except KeyError as error:
        raise InputError(f"{path / META}: damaged: no {error.args[0]}") from None
    except (ValueError, TypeError) as error:
        raise InputError(f"{path / META}: damaged: {error}") from None
    return CheckpointInfo(path=path, config=load_config(path / CONFIG), **known)


def check_matches(
    info: CheckpointInfo,
    robot: Robot,
    library: MotionLibrary,
    library_hash: str,
    config: Config,
    *,
    other_library: bool = False,
    other_robot: bool = False,
    resume: bool = False,
) -> None:
    """Say which of robot, joints, library or network differs between a checkpoint and what is asked.

    `other_library` accepts other clips: a policy may be trained on with them; `other_robot` another robot: its policy
    may be carried over. `resume` needs the same environments and
    bins too.

    Raises:
        InputError: something differs.
    """
    if not other_robot and (info.robot != robot.name or info.joints != robot.joint_names):
        raise InputError(f"{info.path}: robot: the checkpoint's is '{info.robot}' ({len(info.joints)} joints), asked "
                         f"for '{robot.name}' ({robot.num_joints} joints)")  # fmt: skip
    if not other_library and (info.clips != library.names or info.library_hash != library_hash):
        missing, added = set(info.clips) - set(library.names), set(library.names) - set(info.clips)
        difference = "; ".join(
            part
            for part in (
                f"missing here: {', '.join(sorted(missing))}" if missing else "",
                f"new here: {', '.join(sorted(added))}" if added else "",
            )
            if part
        )
        raise InputError(
            f"{info.path}: library: the checkpoint's hash is {info.library_hash}, this library's {library_hash} "
            f"({difference or 'same clip names, other content'})"
        )
    shaping = [("ppo", "actor_layers"), ("ppo", "critic_layers")]
    if resume:
        shaping += [("ppo", "num_envs"), ("sampling", "bin_seconds")]
    theirs, ours = to_dict(info.config), to_dict(config)
    for section, name in shaping:
        if theirs[section][name] != ours[section][name]:
            raise InputError(
                f"{info.path}: {section}.{name}: the checkpoint's is {theirs[section][name]}, "
                f"asked for {ours[section][name]}"
            )


def policy_hash(info: CheckpointInfo) -> str:
    """Content hash (16 hex digits) of a checkpoint's policy as it lies on the disk."""
    policy = {name: sha256 for name, sha256 in info.files.items() if name.startswith(f"{POLICY}/")}
    return hashlib.sha256(json.dumps(policy, sort_keys=True).encode()).hexdigest()[:16]


def load_policy(path: Path, template: TrainState) -> Policy:
    """A checkpoint's networks and normalisers; `template` gives the shapes (`jax.eval_shape` of `init_state`)."""
    return _restore(path, POLICY, {"policy": template.policy})["policy"]


def load_failure_level(path: Path, template: TrainState) -> Array:
    """A checkpoint's failure levels L [clip, bin]."""
    return _restore(path, SAMPLER, {"failure_level": template.failure_level})["failure_level"]


def load_state(path: Path, template: TrainState) -> TrainState:
    """The whole TrainState of a resumable checkpoint."""
    if not (path / RUN).is_dir():
        raise InputError(f"{path}: holds a policy but no {RUN}/ to resume from; start a new run with --base {path}")
    policy, failure_level = load_policy(path, template), load_failure_level(path, template)
    return TrainState(policy=policy, failure_level=failure_level, **_restore(path, RUN, _run_part(template)))


def checkpoints(directory: Path) -> list[Path]:
    """The checkpoints of a run by iteration; a folder whose name is no number was named by hand and is not one."""
    found = [path for path in (directory / "checkpoints").glob("*") if path.name.isdigit() and (path / META).is_file()]
    return sorted(found, key=lambda path: int(path.name))


def newest_checkpoint(directory: Path) -> Path | None:
    """The checkpoint of the highest iteration under `directory`/checkpoints, if any."""
    return next(reversed(checkpoints(directory)), None)


def _run_part(state: TrainState) -> dict[str, Any]:
    return {name: getattr(state, name) for name in vars(state) if name not in ("policy", "failure_level")}


def _restore(path: Path, part: str, template: Any) -> Any:
    """One tree of a checkpoint, in the structure and of the shapes of `template`."""
    _check_files(read_info(path), part)
    abstract = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), template)
    try:
        with ocp.StandardCheckpointer() as checkpointer:
            restored = checkpointer.restore((path / part).resolve(), abstract)
    except Exception as error:
        # Orbax reports another structure by many exception types; all of them mean the same to a user.
        first = str(error).strip().splitlines() or [type(error).__name__]
        raise InputError(f"{path / part}: damaged or of another structure: {first[0][:200]}") from error
    # Orbax gives what is there, whatever shape was asked for.
    for (where, found), asked in zip(
        jax.tree_util.tree_leaves_with_path(restored), jax.tree.leaves(abstract), strict=True
    ):
        if found.shape != asked.shape:
            name = jax.tree_util.keystr(where, simple=True, separator=".")
            raise InputError(f"{path / part}: {name}: found shape {list(found.shape)}; {list(asked.shape)} is needed")
    return restored


def _check_space(folder: Path, trees: Any) -> None:
    """OSError, as the system would say it, unless the trees fit on the disk: Orbax's threads say it in many lines."""
    needed = sum(leaf.nbytes for leaf in jax.tree.leaves(trees)) + 2**20  # 1 MiB for what describes them
    if shutil.disk_usage(folder).free < needed:
        raise OSError(
            errno.ENOSPC, f"{os.strerror(errno.ENOSPC)}: {needed / 2**20:.0f} MiB are needed", str(folder.parent)
        )


def _hashes(folder: Path) -> dict[str, str]:
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    return {file.relative_to(folder).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def _check_files(info: CheckpointInfo, part: str) -> None:
    """InputError unless every file of a tree is there and as it was written."""
    found = {f"{part}/{name}": sha256 for name, sha256 in _hashes(info.path / part).items()}
    for name, sha256 in info.files.items():
        if name.startswith(f"{part}/") and found.get(name) != sha256:
            trouble = "damaged: not what was saved" if name in found else "missing"
            raise InputError(f"{info.path / name}: {trouble}; the checkpoint cannot be used")
