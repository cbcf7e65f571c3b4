"""Checkpoints: a folder that appears whole or not at all.

policy.safetensors  networks, normalisers and the failure levels of the clips' bins: what goes from one run to another
run/                the rest of the TrainState (orbax), for resuming; a shipped checkpoint may lack it
config.yaml         every setting
meta.json           what the checkpoint belongs to, and the SHA-256 of its files
"""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import safetensors
from jax import Array
from safetensors.numpy import load_file, save_file

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.provenance import made_here
from forgetmimic_jax.policy.policy import Policy, init_policy
from forgetmimic_jax.ppo.state import TrainState
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.settings.config import ActionConfig, Config, by_name, load_config, save_config
from forgetmimic_jax.tracking.layouts import find_layout
from forgetmimic_jax.tracking.observation import critic_size
from forgetmimic_jax.tracking.rsi import Bins
from forgetmimic_jax.tracking.setup import Setup

POLICY, RUN, CONFIG, META = "policy.safetensors", "run", "config.yaml", "meta.json"
BEST, BASE = "best", "base"  # folders of policies: the best of a run, that of a library or an import
FAILURE_LEVEL = "failure_level"  # the tensor beside those of the policy
SCHEMA = 3


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
    files: dict[str, str]  # sha256 of policy.safetensors and of each file of run/
    base: str | None  # `policy_hash` of the checkpoint that unlearning started from
    made: dict[str, Any]  # its Provenance; empty in a checkpoint of an earlier version
    curriculum: Mapping[str, Any] | None  # of pretraining, how far it had come


@dataclass(frozen=True)
class Progress:
    """How far a policy's training has come."""

    iteration: int
    environment_steps: int  # control steps of all environments, with those of the base that training continued from
    base: str | None = None  # of an unlearning run, the `policy_hash` of the checkpoint it started from
    curriculum: Mapping[str, Any] | None = None  # of pretraining, how far it has come, in plain values


def save_checkpoint(path: Path, setup: Setup, state: TrainState, progress: Progress) -> None:
    """Write a run's whole state to folder `path`, for resuming; see `save_policy`.

    Of the processes of a training only the first one's folder is kept, so the others write no more than the policy.
    """
    whole = state if jax.process_index() == 0 else None
    _save(path, setup, progress, state.policy, state.failure_level, whole)


def save_policy(path: Path, setup: Setup, policy: Policy, failure_level: Array, progress: Progress) -> None:
    """Write a policy to folder `path`, for evaluation and warm starts only.

    A folder of the same name is replaced only once the new one is complete. A run that is killed while it saves leaves
    a hidden folder, which the next save removes.

    Args:
        path: the checkpoint's folder.
        setup: of the run.
        policy: to be saved.
        failure_level: L [clip, bin].
        progress: of its training.

    Raises:
        OSError: the system refused; a full disk, for one. Nothing remains of the attempt.
    """
    _save(path, setup, progress, policy, failure_level, None)


def _save(
    path: Path, setup: Setup, progress: Progress, policy: Policy, failure_level: Array, state: TrainState | None
) -> None:
    meta: dict[str, Any] = {
        "schema": SCHEMA,
        "robot": setup.robot.name,
        "joints": list(setup.robot.joint_names),
        "clips": list(setup.library.names),
        "library_hash": setup.library_hash,
        **dataclasses.asdict(progress),
        "made": dataclasses.asdict(made_here()),
    }
    tensors = {name: np.array(values, order="C") for name, values in _named(policy).items()}
    tensors[FAILURE_LEVEL] = np.array(failure_level, order="C")
    run = None if state is None else jax.tree.map(np.asarray, _run_part(state))
    for abandoned in path.parent.glob(".*.tmp"):
        shutil.rmtree(abandoned, ignore_errors=True)
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        temporary.mkdir(parents=True)
        _check_space(temporary, (tensors, run))
        save_file(tensors, temporary / POLICY)
        (temporary / POLICY).chmod(0o644)
        if run is not None:
            with _orbax() as checkpointer:
                checkpointer.save((temporary / RUN).resolve(), run)
            # Orbax notes there where the folder was written, which is nobody else's business; it is not read back.
            (temporary / RUN / "commit_success.txt").unlink(missing_ok=True)
        meta["files"] = _hashes(temporary)
        save_config(setup.config, temporary / CONFIG)
        (temporary / META).write_text(json.dumps(meta, indent=2) + "\n")
        shutil.rmtree(path, ignore_errors=True)
        temporary.rename(path)
    except safetensors.SafetensorError as error:
        raise _system_error(r"os error (\d+)", error, path) from None
    except ValueError as error:
        raise _system_error(r"os_error_code='(\d+)'", error, path) from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def fingerprint(path: Path) -> str:
    """SHA-256 of what a checkpoint says of itself: another policy, or other settings, give another."""
    return hashlib.sha256((path / META).read_bytes() + (path / CONFIG).read_bytes()).hexdigest()


def read_info(path: Path) -> CheckpointInfo:
    """A checkpoint's note and config; of a run's folder, those of its best policy, else of its newest checkpoint.

    Raises:
        InputError: not a checkpoint, or a damaged one.
    """
    if not path.is_dir():
        raise InputError(f"{path}: no such checkpoint folder")
    path = path if (path / META).exists() else policy_of(path) or path
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
            files=dict(meta["files"]),
            base=meta.get("base"),
            made=dict(meta.get("made", {})),
            curriculum=meta.get("curriculum"),
        )
    except FileNotFoundError:
        raise InputError(f"{path}: neither a checkpoint nor a run: no {META}") from None
    except KeyError as error:
        raise InputError(f"{path / META}: damaged: no {error.args[0]}") from None
    except (ValueError, TypeError) as error:
        raise InputError(f"{path / META}: damaged: {error}") from None
    return CheckpointInfo(path=path, config=load_config(path / CONFIG), **known)


def policy_of(directory: Path) -> Path | None:
    """The checkpoint that the folder of a run stands for, if any: its best policy, else its newest one.

    A library's folder, and that of an import, stand for the policy in base/.
    """
    best, base = (directory / name if (directory / name / META).is_file() else None for name in (BEST, BASE))
    return best or newest_checkpoint(directory) or base


def checkpoints(directory: Path) -> list[Path]:
    """The checkpoints of a run by iteration; a folder whose name is no number was named by hand and is not one."""
    found = [path for path in (directory / "checkpoints").glob("*") if path.name.isdigit() and (path / META).is_file()]
    return sorted(found, key=lambda path: int(path.name))


def newest_checkpoint(directory: Path) -> Path | None:
    """The checkpoint of the highest iteration in the folder of a run, if any."""
    return next(reversed(checkpoints(directory)), None)


def check_matches(
    info: CheckpointInfo,
    setup: Setup,
    *,
    other_library: bool = False,
    other_robot: bool = False,
    resume: bool = False,
) -> None:
    """InputError where robot, joints, library, observation, action or network of a checkpoint differ from the setup's.

    Args:
        info: of the checkpoint.
        setup: what it is to be used for.
        other_library: other clips are accepted: training may continue with them.
        other_robot: another robot is accepted: its policy may be carried over.
        resume: the environments and bins must be the same too.

    Raises:
        InputError: something differs.
    """
    robot, library, library_hash = setup.robot, setup.library, setup.library_hash
    if not other_robot and (info.robot != robot.name or info.joints != robot.joint_names):
        raise InputError(f"{info.path}: robot: the checkpoint's is '{info.robot}' ({len(info.joints)} joints), this "
                         f"run's '{robot.name}' ({robot.num_joints} joints)")  # fmt: skip
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
    shaping = ["observation.layout", "action.mode", "ppo.actor_layers", "ppo.critic_layers"]
    if not other_robot:
        shaping += [f"action.{field.name}" for field in dataclasses.fields(ActionConfig)]
    if resume:
        shaping += ["ppo.num_envs", "sampling.bin_seconds"]
    theirs, ours = by_name(info.config), by_name(setup.config)
    for name in {**theirs, **ours}:
        found, needed = theirs.get(name, "the robot's own"), ours.get(name, "the robot's own")
        if found != needed and any(name == of or name.startswith(f"{of}.") for of in shaping):
            raise InputError(f"{info.path}: {name}: the checkpoint's is {found}, this run's {needed}")


def policy_hash(info: CheckpointInfo) -> str:
    """Content hash (16 hex digits) of a checkpoint's policy file."""
    return info.files[POLICY][:16]


def load_policy(info: CheckpointInfo, robot: Robot) -> Policy:
    """A checkpoint's networks and normalisers.

    Args:
        info: of the checkpoint.
        robot: the checkpoint's.

    Raises:
        InputError: the file is damaged, or is not of the observations and the network that the checkpoint's config
            names.
    """
    layout = find_layout(info.config.observation.layout)
    return _policy(info, layout.size(robot.num_joints), critic_size(layout, robot))


def _policy(info: CheckpointInfo, actor_size: int, critic_size: int) -> Policy:
    tensors, file = _tensors(info), info.path / POLICY
    for part, size in (("actor", actor_size), ("critic", critic_size)):
        found = len(tensors.get(f"{part}_normalizer/mean", ()))
        if found != size:
            raise InputError(
                f"{file}: {part}: found {found} observations; {size} are needed, with layout "
                f"{info.config.observation.layout} of '{info.robot}'"
            )
    ppo, joints, key = info.config.ppo, len(info.joints), jax.random.PRNGKey(0)
    template = jax.eval_shape(lambda: init_policy(ppo, joints, actor_size, critic_size, key))
    values = []
    for name, expected in _named(template).items():
        shape = list(tensors[name].shape) if name in tensors else "none"
        if shape != list(expected.shape):
            raise InputError(f"{file}: {name}: found shape {shape}; {list(expected.shape)} is needed")
        values.append(jnp.asarray(tensors[name], expected.dtype))
    return jax.tree.unflatten(jax.tree.structure(template), values)


def load_failure_level(path: Path, bins: Bins) -> Array:
    """A checkpoint's failure levels L [clip, bin], of as many bins as the run has.

    Raises:
        InputError: the file is damaged, or of other bins.
    """
    level = _tensors(read_info(path)).get(FAILURE_LEVEL, np.zeros(0, np.float32))
    if level.shape != bins.valid.shape:
        raise InputError(
            f"{path / POLICY}: {FAILURE_LEVEL}: found shape {list(level.shape)}; {list(bins.valid.shape)} is needed"
        )
    return jnp.asarray(level)


def is_whole(info: CheckpointInfo) -> bool:
    """Whether a checkpoint has the whole state, so that a run can be resumed from it."""
    return (info.path / RUN).is_dir()


def load_state(info: CheckpointInfo, template: TrainState) -> TrainState:
    """The whole TrainState of a resumable checkpoint; `template` gives the shapes (`jax.eval_shape` of `init_state`).

    Raises:
        InputError: the checkpoint has no `run/`, is damaged, or is of other shapes.
    """
    folder = info.path / RUN
    if not is_whole(info):
        raise InputError(f"{info.path}: no {RUN}/ to resume from; start a new run with --base {info.path}")
    _check_files(info, f"{RUN}/")
    abstract = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), _run_part(template))
    try:
        with _orbax() as checkpointer:
            restored = checkpointer.restore(folder.resolve(), abstract)
    except Exception as error:
        # Orbax reports another structure by many exception types; all of them mean the same to a user.
        first = str(error).strip().splitlines() or [type(error).__name__]
        raise InputError(f"{folder}: damaged or of another structure: {first[0][:200]}") from error
    # Orbax returns what is there, whatever shape was requested.
    for (where, found), needed in zip(
        jax.tree_util.tree_leaves_with_path(restored), jax.tree.leaves(abstract), strict=True
    ):
        if found.shape != needed.shape:
            name = jax.tree_util.keystr(where, simple=True, separator=".")
            raise InputError(f"{folder}: {name}: found shape {list(found.shape)}; {list(needed.shape)} is needed")
    sizes = (x.mean.size for x in (template.policy.actor_normalizer, template.policy.critic_normalizer))
    return TrainState(
        policy=_policy(info, *sizes),
        failure_level=jnp.asarray(_tensors(info)[FAILURE_LEVEL]),
        **restored,
    )


def _orbax() -> ocp.StandardCheckpointer:
    """Orbax in this process alone, which waits for no other process of a training."""
    me = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(primary_host=me, active_processes={me})
    return ocp.StandardCheckpointer(multiprocessing_options=alone)


def _named(policy: Policy) -> dict[str, Any]:
    """The policy's arrays by their place in the tree, such as actor/params/MLP_0/Dense_0/kernel."""
    leaves = jax.tree_util.tree_leaves_with_path(policy)
    return {jax.tree_util.keystr(where, simple=True, separator="/"): leaf for where, leaf in leaves}


def _tensors(info: CheckpointInfo) -> dict[str, np.ndarray]:
    _check_files(info, POLICY)
    try:
        return load_file(info.path / POLICY)
    except safetensors.SafetensorError as error:
        raise InputError(f"{info.path / POLICY}: damaged: {error}") from None


def _run_part(state: TrainState) -> dict[str, Any]:
    parts = {name: value for name, value in vars(state).items() if name not in ("policy", FAILURE_LEVEL)}
    return {name: value for name, value in parts.items() if value is not None}


def _system_error(pattern: str, error: Exception, path: Path) -> Exception:
    """The system's error, whose number the libraries give only inside the text of their own error."""
    code = re.search(pattern, str(error))
    return OSError(int(code[1]), os.strerror(int(code[1])), str(path)) if code else error


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
    """InputError unless every file whose name starts with `part` is there and as it was written."""
    for name, sha256 in info.files.items():
        if not name.startswith(part):
            continue
        file = info.path / name
        if not file.is_file():
            raise InputError(f"{file}: missing; the checkpoint cannot be used")
        if hashlib.sha256(file.read_bytes()).hexdigest() != sha256:
            raise InputError(f"{file}: damaged: not what was saved; the checkpoint cannot be used")
