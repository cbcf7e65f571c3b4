"""Faults on purpose, in numbers: `make soak`. It is no part of `make test`.

kill: kill -9 at random moments of train, unlearn, evaluate, `motions import` and evidence. No folder is half written,
what was saved continues, and the result is that of a run that nobody killed.
full: the same with a disk that becomes full, at a random size. It needs Linux with user namespaces.
inputs: mutated clips, YAML, MJCF, checkpoints, ONNX, pickles and flags (mutations.py). No traceback, no code run.
random: policies with random weights of random size train for hours. No NaN in a parameter, no growth of memory.
mjx: whole runs of both robots with MJX, on one CPU core and on two. Each ends in time.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from commands.miniature import TINY
from conftest import SHARED, SWAY_FRAMES, TURN_FRAMES, invented_clip
from mutations import FAMILIES, OF_OTHERS, half_written

from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.motion.clip import write_clip
from forgetmimic_jax.motion.library import file_hash, write_manifest
from forgetmimic_jax.ppo.state import TrainState, init_state
from forgetmimic_jax.robot.model import load_robot
from forgetmimic_jax.settings.config import preset
from forgetmimic_jax.settings.options import override, replace_given
from forgetmimic_jax.tracking.env import Assets, make_assets, make_environment
from forgetmimic_jax.tracking.setup import make_setup
from forgetmimic_jax.training.checkpoint import POLICY, newest_checkpoint
from forgetmimic_jax.training.run import make_iteration
from forgetmimic_jax.unlearning.registry import method_of

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = ("train", "pretrain", "unlearn", "evaluate", "import", "evidence")
LENGTH = 40  # iterations, with a checkpoint after each second one
AT_START = 0.2  # share of the kills that come at any moment; the others come after the first file was written
RANDOM = (
    *("physics.engine=native", "physics.self_collision=true", "noise.enabled=true", "ppo.num_envs=64"),
    *("ppo.branches=1", "ppo.num_steps=8", "ppo.minibatches=2", "ppo.epochs=2"),
    *("ppo.actor_layers=[64]", "ppo.critic_layers=[64]"),
)
RANDOM_ITERATIONS = 3
PHASES = (  # of pretraining, short enough that a run passes all of them
    *("ppo.schedule=adaptive_iteration", "evaluate_every=4", "evaluate_episodes=4", "pretrain.patience=1"),
    *("pretrain.distil_rounds=2", "pretrain.search_rounds=3", "pretrain.specialist_evaluations=2"),
)
MJX = (
    *("unlearn", "--physics", "mjx", "--iterations", "3", "--episodes", "1"),
    *("--set", "ppo.num_envs=64", "--set", "ppo.minibatches=2", "--set", "ppo.num_steps=8"),
)
MJX_LIMIT = 1800.0  # s; such a run takes some minutes, most of them in the evaluation
GROWTH = 0.05  # of the memory after a tenth of the time
PAGE, TMPFS = 2**12, 2**28  # bytes, the least that a disk has, and more than any run here writes


@dataclass(frozen=True)
class Scene:
    """A command that writes a folder, and what decides whether the folder is right.

    Args:
        arguments: of the command, without its folder.
        output: the flag of the folder.
        resumes: it continues with --resume; otherwise it is given again as it is.
        result: of a folder that is finished, equal in equal runs.
        run: of a command that adds to a run: its folder gets a copy of this one, and the flag names the copy.
    """

    arguments: tuple[str, ...]
    output: str
    resumes: bool
    result: Callable[[Path], Any]
    run: Path | None = None

    def start(self, folder: Path) -> subprocess.Popen:
        """The command, as it starts or continues in the folder."""
        resume = self.resumes and newest_checkpoint(folder) is not None
        named = folder
        if self.run is not None:
            named = folder / self.run.name
            if not folder.exists():
                shutil.copytree(self.run, named)
        command = [sys.executable, "-m", "forgetmimic_jax", *self.arguments, self.output, str(named)]
        environment = os.environ | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
        return subprocess.Popen(
            command + ["--resume"] * resume,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )


def trained(folder: Path) -> Any:
    """The policy's bytes, and what was logged and measured."""
    newest = newest_checkpoint(folder)
    assert newest is not None
    rows = [{**row, "seconds": 0.0} for row in read_rows(folder / "metrics.jsonl")]
    return file_hash(newest / POLICY), rows, evaluated(folder) if (folder / "evaluation.json").exists() else None


def pretrained(folder: Path) -> Any:
    """What a training has, the best policy's bytes, and every evaluation, with the phases."""
    return trained(folder), file_hash(folder / "best" / POLICY), read_rows(folder / "evaluations.jsonl")


def evaluated(folder: Path) -> Any:
    """The measured numbers."""
    return json.loads((folder / "evaluation.json").read_text())["policies"]


def attacked(folder: Path) -> Any:
    """What every attack found, and the control that was made."""
    document = json.loads((folder / "run" / "evidence.json").read_text())
    return {name: value for name, value in document.items() if name != "made"}, trained(folder / "run-control")


def imported(folder: Path) -> Any:
    """The clips' bytes."""
    return {path.name: file_hash(path) for path in folder.glob("*.npz")}


def saved(folder: Path) -> dict[Path, int]:
    """What a later start must not lose: the newest checkpoint's iteration of each run, and every finished attack."""
    newest = {path: newest_checkpoint(path) for path in (folder, folder / "run-control")}
    attacks = {path: 1 for path in folder.glob("run/evidence/*.json")}
    return {path: int(checkpoint.name) for path, checkpoint in newest.items() if checkpoint} | attacks


def lost(before: dict[Path, int], after: dict[Path, int]) -> list[str]:
    """A fault for everything that was saved before and is no longer there, or is older."""
    return [f"{path}: {value} was saved, now {after.get(path)}" for path, value in before.items()
            if after.get(path, -1) < value]  # fmt: skip


def scenes(folder: Path, wanted: Collection[str]) -> dict[str, Scene]:
    """The wanted commands, on two invented clips and a small base, which are made here."""
    robot, library = load_robot("g1"), folder / "library"
    library.mkdir()
    entries = {}
    for name, frames, yaw_rate in (("sway", SWAY_FRAMES, 0.0), ("turn", TURN_FRAMES, 1.0)):
        clip = invented_clip(robot, name, frames, yaw_rate, 0.2)
        write_clip(clip, library / f"{name}.npz")
        entries[name] = {"sha256": file_hash(library / f"{name}.npz")}
    rows = np.concatenate([clip.root_pos, np.roll(clip.root_quat, -1, axis=-1), clip.joint_pos], axis=-1)
    np.savetxt(folder / "turn.csv", rows, delimiter=",", fmt="%.6f")
    write_manifest(library, {"schema": 1, "robot": "g1", "fps": 50.0, "default_targets": ["turn"], "clips": entries})
    length = ("--iterations", str(LENGTH))
    train = ("train", "--library", str(library), *length, "--set", *TINY)
    phases = ("pretrain", "--library", str(library), "--base", "none", "--episodes", "2", *length)
    base = folder / "base"
    if {"unlearn", "evaluate", "evidence"} & set(wanted):
        undisturbed(Scene(train, "--output", True, trained), base)
    checkpoint = str(newest_checkpoint(base))
    forget = ("unlearn", "--base", checkpoint, "--targets", "turn", "--episodes", "2", *length)
    measure = ("evaluate", "--checkpoint", checkpoint, "--episodes", "2")
    convert = ("motions", "import", str(folder / "turn.csv"), "--fps", "50", "--force")
    unlearn, run = Scene(forget, "--output", True, trained), folder / "run"
    if "evidence" in wanted:
        undisturbed(unlearn, run)
    trainings = [f"--{kind}-iterations=8" for kind in ("control", "recovery", "relearning")]
    every = {
        "train": Scene(train, "--output", True, trained),
        "pretrain": Scene((*phases, "--set", *TINY, *PHASES), "--output", True, pretrained),
        "unlearn": unlearn,
        "evaluate": Scene(measure, "--output", False, evaluated),
        "import": Scene(convert, "--library", False, imported),
        "evidence": Scene(("evidence", "--episodes", "2", *trainings), "--run", False, attacked, run),
    }
    return {name: scene for name, scene in every.items() if name in wanted}


def finish(process: subprocess.Popen) -> tuple[str, int]:
    """What a process says until its end, and its exit code."""
    said, _ = process.communicate()
    return said, process.returncode


def undisturbed(scene: Scene, folder: Path) -> tuple[Any, float, float]:
    """The result that nothing disturbed, s until the first file, and s from there to the end."""
    begin, process = time.monotonic(), scene.start(folder)
    while not folder.is_dir() and process.poll() is None:
        time.sleep(0.01)
    first = time.monotonic() - begin
    said, code = finish(process)
    assert code == 0, said
    return scene.result(folder), first, time.monotonic() - begin - first


def wait_for_a_file(process: subprocess.Popen, folder: Path) -> None:
    """Wait until a process writes into a folder, or ends."""

    def seen() -> dict[str, int]:
        times = {}
        for path in (folder, *folder.rglob("*")):
            with contextlib.suppress(FileNotFoundError):  # it was removed since it was listed
                times[str(path)] = path.stat().st_mtime_ns
        return times

    before = seen()
    while process.poll() is None and seen() == before:
        time.sleep(0.005)


def kill(scene: Scene, folder: Path, times: int, rng: random.Random) -> list[str]:
    """Kill a command so many times, each time as it continues or starts over; returns the faults."""
    wanted, before, span = undisturbed(scene, folder / "undisturbed")
    output, faults, killed = folder / "killed", [], 0
    while killed < times:
        before_start = saved(output)
        process = scene.start(output)
        wait = rng.uniform(0.0, before + span)
        if rng.random() >= AT_START:
            wait_for_a_file(process, output)
            wait = rng.uniform(0.0, span)
        try:
            process.wait(wait)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            killed += 1
        said, code = finish(process)
        faults += half_written(output) + lost(before_start, saved(output))
        if code == 0:
            if scene.result(output) != wanted:
                faults.append("the result differs from that of a run that was not killed")
            shutil.rmtree(output)
        elif code != -signal.SIGKILL:
            faults.append(f"exit code {code}: {said[-300:]}")
            shutil.rmtree(output, ignore_errors=True)
    said, code = finish(scene.start(output))
    if code != 0 or scene.result(output) != wanted:
        faults.append(f"after the last kill: exit code {code}: {said[-300:]}")
    return faults


def fill(scene: Scene, folder: Path, times: int, rng: random.Random) -> list[str]:
    """Run a command on disks that become full; then it continues on a larger one. Returns the faults."""
    wanted, *_ = undisturbed(scene, folder / "undisturbed")
    needed, given = _pages(folder / "undisturbed"), _pages(scene.run) if scene.run else 0
    faults, disk = [], folder / "disk"
    disk.mkdir()
    for _ in range(times):
        size = given + rng.randrange(PAGE, needed - given)  # a run that the command adds to fits
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(disk)], check=True)
        try:
            output = disk / "output"
            said, code = finish(scene.start(output))
            if code == 2 and (not said.splitlines()[-1].startswith("error: ") or "Traceback" in said):
                faults.append(f"{size} bytes: {said[-300:]}")
            if code not in (0, 2):
                faults.append(f"{size} bytes: exit code {code}: {said[-300:]}")
            faults += [f"{size} bytes: {fault}" for fault in half_written(output)]
            subprocess.run(["mount", "-o", f"remount,size={TMPFS}", str(disk)], check=True)
            if code != 0:
                before_start = saved(output)
                said, code = finish(scene.start(output))
                faults += lost(before_start, saved(output))
            if code != 0 or scene.result(output) != wanted:
                faults.append(f"{size} bytes, then more: exit code {code}: {said[-300:]}")
        finally:
            subprocess.run(["umount", str(disk)], check=True)
    return faults


def _pages(folder: Path) -> int:
    """Bytes that a folder takes on a disk of pages."""
    return sum(-(-path.stat().st_size // PAGE) * PAGE + PAGE for path in folder.rglob("*"))


def inputs(family: str, times: int, keep: Path) -> list[str]:
    """Read so many mutations of a family; returns the faults."""
    journal = keep / f"{family}.jsonl"
    journal.unlink(missing_ok=True)
    done, faults = 0, []
    while done < times:
        program = [sys.executable, str(Path(__file__).with_name("mutations.py")), family, str(done), str(times)]
        code = subprocess.run([*program, str(journal)], env=os.environ | {"PYTHONPATH": str(ROOT)}).returncode
        last = read_rows(journal)[-1]
        if "begun" in last:
            faults.append(f"{last['begun']}: it ends the process, exit code {code}")
        done = 1 + last.get("ended", last.get("begun"))
    return faults + [f"{row['ended']}: {row['fault']}" for row in read_rows(journal) if row.get("fault")]


def random_policies(minutes: float, seed: int, say: Callable[[str], None]) -> list[str]:
    """Train policies with random weights, each for some iterations, for so many minutes; returns the faults.

    The weights of each are scaled by a factor from 0.1 to 100, so that actions go from none to the joints' limits. The
    robot has noise, pushes and self-collision, and the shipped clips.
    """
    setup = make_setup(replace_given(override(preset("cpu"), RANDOM), robot="g1"))
    env, assets = make_environment(setup, setup.config.ppo.num_envs), make_assets(setup)
    iterate = make_iteration(env, method_of(setup.config))

    @jax.jit
    def fresh(assets: Assets, key: jax.Array, scale: float) -> TrainState:
        state = init_state(env, assets, key)
        larger = jax.tree.map(lambda leaf: leaf * scale, state.policy.parameters)
        return dataclasses.replace(state, policy=state.policy.with_parameters(larger))

    rng, faults, memory, done, begin = random.Random(seed), [], {}, 0, time.monotonic()
    while (passed := (time.monotonic() - begin) / 60.0) < minutes:
        scale = 10.0 ** rng.uniform(-1.0, 2.0)
        state = fresh(assets, jax.random.PRNGKey(rng.randrange(2**31)), scale)
        for _ in range(RANDOM_ITERATIONS):
            state, _ = iterate(assets, state)
        for path, leaf in jax.tree_util.tree_leaves_with_path((state.policy, state.failure_level)):
            if not np.isfinite(leaf).all():
                faults.append(f"policy {done}, weights x {scale:.3g}: {jax.tree_util.keystr(path)} is not finite")
        done += 1
        memory[passed] = resident()
        if done % 1000 == 0:
            say(f"random: {passed:.0f} min, {done} policies, {memory[passed] / 2**20:.0f} MiB, {len(faults)} faults")
    early = max(size for at, size in memory.items() if at <= 0.1 * minutes)
    grown = max(memory.values()) / early - 1.0
    steps = done * RANDOM_ITERATIONS * setup.config.ppo.num_envs * setup.config.ppo.num_steps
    say(f"random: {done} policies, {steps:,} control steps; memory {early / 2**20:.0f} MiB after a tenth of the time, "
        f"then {grown:+.1%} at most")  # fmt: skip
    return faults + [f"memory grew by {grown:.0%}"] * (grown > GROWTH)


def mjx_starts(robot: str, cores: Collection[int], times: int, folder: Path) -> list[str]:
    """Start so many runs that train and evaluate with MJX on these cores; returns the faults."""
    faults = []
    for start in range(times):
        scene = Scene((*MJX, "--robot", robot), "--output", False, evaluated)
        output = folder / f"{robot}-{len(cores)}-{start}"
        process = scene.start(output)
        os.sched_setaffinity(process.pid, cores)  # long before JAX counts the cores
        try:
            said, code = process.communicate(timeout=MJX_LIMIT)[0], process.returncode
        except subprocess.TimeoutExpired:
            process.kill()
            said, code = f"not ended after {MJX_LIMIT:.0f} s: {finish(process)[0]}", -1
        if code != 0:
            faults.append(f"start {start}: exit code {code}: {said[-300:]}")
    return faults


def resident() -> int:
    """Bytes of memory that this process holds."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def main() -> int:
    """The command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="make soak", description="Kill, fill and mutate.")
    parser.add_argument("part", nargs="*", help="kill, full, inputs, random, mjx (default: all)")
    parser.add_argument(
        "--times", type=int, default=50, help="kills, disks, mutations and starts of each kind (default: 50)"
    )
    parser.add_argument("--only", nargs="+", help="commands of kill and full, families of inputs, robots of mjx")
    parser.add_argument("--minutes", type=float, default=120.0, help="of random policies (default: 120)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("runs/soak"), help="folder for inputs with a fault")
    given = parser.parse_args()
    parts, rng, found = given.part or ["kill", "full", "inputs", "random", "mjx"], random.Random(given.seed), {}
    if "full" in parts and "SOAK_NAMESPACE" not in os.environ:  # to mount disks; its own, nobody else sees them
        os.execvpe("unshare", ["unshare", "-rm", sys.executable, *sys.argv], os.environ | {"SOAK_NAMESPACE": "1"})
    with tempfile.TemporaryDirectory() as name:
        wanted = (given.only or COMMANDS) if {"kill", "full"} & set(parts) else ()
        commands = scenes(Path(name), wanted)
        for part, disturb in (("kill", kill), ("full", fill)):
            if part in parts:
                for command, scene in commands.items():
                    folder = Path(name) / f"{part}-{command}"
                    folder.mkdir()
                    found[f"{part} {command}"] = faults = disturb(scene, folder, given.times, rng)
                    print(f"{part} {command}: {given.times} times, {len(faults)} faults", flush=True)
    if "inputs" in parts:
        given.keep.mkdir(parents=True, exist_ok=True)
        for family in (*FAMILIES, "flags", "code"):
            if family in OF_OTHERS and not SHARED.is_dir():
                print(f"inputs {family}: left out, since {SHARED} is not there", flush=True)
            elif not given.only or family in given.only:
                found[f"inputs {family}"] = faults = inputs(family, given.times, given.keep)
                print(f"inputs {family}: {given.times} times, {len(faults)} faults", flush=True)
    if "random" in parts:
        found["random"] = random_policies(given.minutes, given.seed, lambda line: print(line, flush=True))
    if "mjx" in parts:
        with tempfile.TemporaryDirectory() as name:
            for robot, count in itertools.product(("g1", "h2"), (1, 2)):
                if not given.only or robot in given.only:
                    cores = sorted(os.sched_getaffinity(0))[:count]
                    found[f"mjx {robot} {count}"] = faults = mjx_starts(robot, cores, given.times, Path(name))
                    print(f"mjx {robot}, cores {cores}: {given.times} starts, {len(faults)} faults", flush=True)
    faults = [f"{where}: {fault}" for where, some in found.items() for fault in some]
    print("\n".join([*faults, f"{len(faults)} faults"]))
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
