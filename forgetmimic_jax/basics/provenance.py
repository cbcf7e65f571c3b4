"""What a number was made with: the code and its commit, the versions that decide it, and the machine."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
import os
import platform
import re
import subprocess
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, entry_points, version
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
CODE = (PACKAGE.name, "robots", "experiments/*.py")  # of a checkout: a change of these may change a number
CHANGED = "+changes"


@dataclass(frozen=True)
class Provenance:
    """Where a number comes from; it goes into every JSON of results."""

    code: str  # content of the code; see `code_hash`
    commit: str  # of the code; see `commit`
    python: str
    jax: str
    mujoco: str
    processor: str
    cores: int  # that this process may use


@functools.cache
def provenance() -> Provenance:
    """Of this process. It is found once: a checkout that changes later does not change the code that is loaded."""
    return Provenance(
        code=code_hash(PACKAGE),
        commit=commit(PACKAGE),
        python=platform.python_version(),
        jax=installed("jax"),
        mujoco=installed("mujoco"),
        processor=processor(),
        cores=cores(),
    )


def code_hash(package: Path) -> str:
    """Content hash (8 hex digits) of every Python file below a folder; what a commit changes elsewhere keeps it."""
    content = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        file = path.read_bytes()
        content.update(f"{path.relative_to(package).as_posix()}:{len(file)}:".encode() + file)
    return content.hexdigest()[:8]


def made_here() -> Provenance:
    """`provenance` of numbers that JAX computes here: on an accelerator, its name stands before the processor's."""
    import jax

    made = provenance()
    if jax.default_backend() == "cpu":
        return made
    return dataclasses.replace(made, processor=f"{jax.devices()[0].device_kind}, {made.processor}")


def commit(package: Path) -> str:
    """The git commit (40 hex digits) of the package in folder `package`, or its version where it is installed.

    "+changes" follows a commit whose code was changed since, files that git does not know included.
    """
    # An environment inside a checkout holds installed packages, which are not the checkout's code.
    if _git(package, "ls-files", "--error-unmatch", "__init__.py") is None:
        return installed("forgetmimic-jax")
    head = _git(package, "rev-parse", "HEAD")
    changes = _git(package.parent, "status", "--porcelain", "--", *CODE)
    if head is None or changes is None:
        return installed("forgetmimic-jax")
    return head + (CHANGED if changes else "")


def installed(package: str) -> str:
    """Version of an installed package, or `unknown`."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"


def processor() -> str:
    """Name of the processor."""
    return _first_core().get("model name") or platform.processor() or platform.machine()


def compiled_for() -> str:
    """What a compiled program depends on besides its code: the processor, its instructions, the number of cores."""
    described = [_first_core().get(field) for field in ("flags", "Features", "CPU part")]  # the last two on ARM
    instructions = hashlib.sha256(repr(described).encode()).hexdigest()[:8]
    name = "-".join(re.findall(r"\w+", processor()))
    return f"{name}-{instructions}-{_schedulable()}-cores"


@functools.cache
def _first_core() -> dict[str, str]:
    """Linux's description of the first core; empty on other systems."""
    try:
        first = Path("/proc/cpuinfo").read_text().partition("\n\n")[0]
    except OSError:
        return {}
    return {name.strip(): value.strip() for name, _, value in (line.partition(":") for line in first.splitlines())}


def cores() -> int:
    """How many cores this process may use; `PYTHON_CPU_COUNT` sets it, as Python itself does from 3.13 on."""
    given = os.environ.get("PYTHON_CPU_COUNT", "")
    return int(given) if given.isdigit() and int(given) else _schedulable()


def gpus() -> list[str]:
    """The NVIDIA GPUs that JAX would take here, as CUDA_VISIBLE_DEVICES names them; JAX does not start for it."""
    wanted = os.environ.get("JAX_PLATFORMS", "").split(",")[0]
    if wanted not in ("", "cuda", "gpu") or not any(
        "cuda" in plugin.name for plugin in entry_points(group="jax_plugins")
    ):
        return []
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:  # CUDA ignores what follows a name that no GPU has
        names = [name.strip() for name in visible.split(",")]
        return list(itertools.takewhile(lambda name: name not in ("", "-1", "NoDevFiles"), names))
    try:
        found = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=30).stdout
    except (OSError, subprocess.TimeoutExpired):
        return []
    return [str(number) for number in range(len(re.findall(r"^GPU \d+:", found, re.MULTILINE)))]


def _schedulable() -> int:
    """How many cores the system gives this process, whatever `PYTHON_CPU_COUNT` is."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _git(folder: Path, *arguments: str) -> str | None:
    """What git prints; None where there is no git, no repository or no such thing in it."""
    try:
        done = subprocess.run(
            ["git", "--no-optional-locks", "-C", str(folder), *arguments], capture_output=True, text=True, timeout=10
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None
