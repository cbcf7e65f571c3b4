"""The devices of a training and the processes that hold them.

The environments are divided over the devices; everything else is on all of them. Several processes, on one host or on
many, may hold the devices together. Every one of them does the same, and what could differ between two hosts is that
of the first. Only the first one's folder and output are kept.
"""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NoReturn, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.provenance import cores
from forgetmimic_jax.basics.shards import AXIS
from forgetmimic_jax.ppo.sharding import EVERYWHERE, PLACES
from forgetmimic_jax.ppo.state import TrainState
from forgetmimic_jax.settings.config import Config, validate
from forgetmimic_jax.tracking.env import Assets, Environment, make_environment
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.tracking.stand import STAND

T = TypeVar("T")

# For processes that no launcher counts, such as those started over ssh: where the first one listens, how many there
# are, and which one this is, from 0.
ADDRESS, PROCESSES, PROCESS = "JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID"
LAUNCHERS = ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")  # srun and mpirun set how many they started

_copies: list[Path] = []  # folders of `own_folder`, which this process removes at its end


def join(config: Config) -> None:
    """Prepare this process for a run on `config.devices` devices in all, before anything else of JAX starts.

    On a CPU a device is a share of the cores. Processes that were started together find each other.

    Raises:
        InputError: settings that no run can work with, more devices than there are, or a number of them that the
            processes cannot share.
    """
    validate(config)
    devices, processes = config.devices, _processes()
    if devices % processes:
        raise InputError(
            f"--devices: found {devices}; accepted: a multiple of {processes}, the processes that were started together"
        )
    if devices == 1:
        return
    here = devices // processes
    # XLA's pool needs a thread for each device's program, which waits there for the others, and more for the work.
    os.environ["NPROC"] = str(cores() + here)
    with contextlib.suppress(RuntimeError):  # JAX has started: its devices are what there is
        jax.config.update("jax_num_cpu_devices", here)
    if processes > 1:
        _find_each_other(processes)
    there, what = jax.device_count(), "devices"
    if jax.default_backend() == "cpu":
        there, what = min(there, processes * cores()), "cores"
    if devices > there or (processes > 1 and devices != there):
        least = there if processes > 1 else 1
        accepted = f"{there}" if least == there else f"1 to {there}"
        raise InputError(f"--devices: found {devices}; accepted: {accepted} (the {what} that there are)")
    if jax.process_index() > 0:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # one process prints


def _processes() -> int:
    """How many processes were started together."""
    if ADDRESS not in os.environ:
        return next((int(os.environ[name]) for name in LAUNCHERS if name in os.environ), 1)
    return _number(PROCESSES)


def _find_each_other(processes: int) -> None:
    if ADDRESS in os.environ:
        jax.distributed.initialize(os.environ[ADDRESS], processes, _number(PROCESS))
    else:
        jax.distributed.initialize()


def _number(name: str) -> int:
    """The number in an environment variable that must go with the address."""
    found = os.environ.get(name, "")
    if not found.isdigit():
        raise InputError(f"{name}: found '{found}'; accepted: a whole number, beside {ADDRESS}")
    return int(found)


def without_others(environment: Mapping[str, str]) -> dict[str, str]:
    """Environment variables for a process that runs on its own, whatever started this one."""
    return {name: value for name, value in environment.items() if name not in (ADDRESS, PROCESSES, PROCESS, *LAUNCHERS)}


def own_folder(directory: Path) -> Path:
    """Where this process writes the run in `directory`: there, or in a copy of it that the process removes at its end.

    Every process returns only when all have what they need of `directory`.
    """
    if jax.process_count() == 1:
        return directory
    own = directory
    if jax.process_index() > 0:
        temporary = Path(tempfile.mkdtemp(prefix="forgetmimic-"))
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        _copies.append(temporary)
        own = temporary / directory.name
        for name in (directory.name, f"{directory.name}-{STAND}"):
            if directory.with_name(name).is_dir():
                shutil.copytree(directory.with_name(name), temporary / name)
    multihost_utils.sync_global_devices("folders")
    return own


def is_of_xla(error: BaseException) -> bool:
    """Whether XLA failed, as it does where it waits for a process that has ended; JAX raises ValueError for some."""
    status = re.match(r"[A-Z_]+: ", str(error))
    return status is not None and isinstance(error, jax.errors.JaxRuntimeError | ValueError)


def leave(message: str) -> NoReturn:
    """End this process with one line and exit code 1.

    Only where another process may have ended: at a normal end JAX waits for it, in vain, and then aborts.
    """
    print(message, file=sys.stderr, flush=True)
    for copy in _copies:
        shutil.rmtree(copy, ignore_errors=True)
    os._exit(1)


def mesh_of(devices: int) -> Mesh | None:
    """The devices of a training, one shard each; None for a training on one device."""
    return Mesh(np.asarray(jax.devices()[:devices]), (AXIS,)) if devices > 1 else None


def shard_environment(mesh: Mesh | None, setup: Setup, env: Environment) -> Environment:
    """The environment of one shard of the mesh, of all whose robots `env` is; without a mesh that is `env` itself."""
    if mesh is None:
        return env
    runs_on, shards = env.runs_on * env.control_step, len(mesh.local_devices)
    return make_environment(
        setup,
        env.num_envs // mesh.size,
        noisy=env.noisy,
        runs_on=runs_on,
        replace_reference=env.replace_reference,
        shards=shards,
    )


def spread(mesh: Mesh | None, state: TrainState) -> TrainState:
    """The first process's state on the mesh: every device gets its environments, and all else."""
    if mesh is None:
        return state
    state = multihost_utils.broadcast_one_to_all(state)
    return jax.tree.map(lambda place, part: _put(part, NamedSharding(mesh, place)), PLACES, state)


def share(mesh: Mesh | None, assets: Assets) -> Assets:
    """The assets on every device of the mesh; what is there already stays."""
    return assets if mesh is None else _put(assets, NamedSharding(mesh, EVERYWHERE))


def local(mesh: Mesh | None, state: TrainState) -> TrainState:
    """A state on the mesh with all but its environments on this process's first device, without a copy."""
    if mesh is None:
        return state
    everywhere = {name: part for name, part in vars(state).items() if name != "env"}
    return dataclasses.replace(state, **jax.tree.map(lambda x: x.addressable_data(0), everywhere))


def gathered(state: TrainState) -> TrainState:
    """A state with the environments of all processes, to be saved."""
    if jax.process_count() == 1:
        return state
    return dataclasses.replace(state, env=multihost_utils.process_allgather(state.env, tiled=True))


def agreed(value: float) -> float:
    """The first process's value: another host may round differently, and all must take the same way from here."""
    return value if jax.process_count() == 1 else float(multihost_utils.broadcast_one_to_all(np.float32(value)))


def anywhere(flag: bool) -> bool:
    """Whether the flag is set in any process."""
    return flag if jax.process_count() == 1 else bool(multihost_utils.process_allgather(np.array(flag)).any())


def _put(tree: T, sharding: NamedSharding) -> T:
    def put(leaf: jax.Array) -> jax.Array:
        if isinstance(leaf, jax.Array) and leaf.sharding == sharding:
            return leaf
        values = np.asarray(leaf)
        return jax.make_array_from_callback(values.shape, sharding, lambda index: values[index])

    return jax.tree.map(put, tree)
