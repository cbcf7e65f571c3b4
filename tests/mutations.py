"""Mutated input files and flags for tests/soak.py: whatever a file holds, a command reads it or refuses it in one line.

A case is a family and a number, from which its mutation follows. Reading runs in this process; tests/soak.py runs the
cases of a family in a process of their own, because a file may also crash the reader's C++.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import io
import json
import os
import pickle
import random
import re
import shutil
import signal
import sys
import tempfile
import traceback
import zipfile
from collections.abc import Callable
from pathlib import Path

import jax
import msgspec
import numpy as np
from commands.miniature import TINY, started
from conftest import SHARED, invented_clip

from forgetmimic_jax import (
    bench,
    evaluate,
    evidence,
    export,
    import_policy,
    motions,
    play,
    pretrain,
    report,
    robots,
    sweep,
    train,
    unlearn,
    video,
)
from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.exchange.foreign import PolicyReading, read_policy
from forgetmimic_jax.exchange.rsl_rl import read_rsl_rl
from forgetmimic_jax.motion.clip import write_clip
from forgetmimic_jax.motion.importing import import_motion
from forgetmimic_jax.motion.library import build_library, file_hash, read_library
from forgetmimic_jax.motion.recording import Reading
from forgetmimic_jax.ppo.state import TrainState
from forgetmimic_jax.robot.model import ROBOTS_DIR, load_robot
from forgetmimic_jax.settings.config import load_config, preset
from forgetmimic_jax.settings.options import override, parse
from forgetmimic_jax.tracking.setup import make_setup
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.start import base_folder

LIMIT = 120  # s for one file, on a busy machine; a reader that needs longer hangs
MJLAB = "B_HandsUp_mjlab.npz"  # a motion of SHARED
WORDS = ("", "nan", "inf", "-1", "0", "1e308", "99999999999", "null", "[]", "{}", "!!python/object/apply:os.abort []")
COMMANDS = {
    "train": train, "unlearn": unlearn, "evaluate": evaluate, "evidence": evidence, "export": export, "play": play,
    "pretrain": pretrain, "report": report, "sweep": sweep, "video": video, "bench": bench,
    "import-policy": import_policy, "motions": motions, "robot": robots,
}  # fmt: skip
SUBCOMMANDS = {"motions": ("import", "retarget", "check", "show", "list"), "robot": ("check", "add")}


class Code:
    """A pickle of it runs code as soon as it is loaded: it makes the file `marker`."""

    def __init__(self, marker: Path):
        self._marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self._marker),)


def mutated(content: bytes, rng: random.Random) -> bytes:
    """The content with one to three mutations of bytes, or of numbers and words."""
    for _ in range(rng.randint(1, 3)):
        words = [match.span() for match in re.finditer(rb"[\w.+-]+", content[:200_000])]
        start = rng.randrange(len(content) + 1)
        end = min(len(content), start + rng.choice((1, 4, 64, 4096)))
        match rng.randrange(7 if words else 5):
            case 0:
                content = content[:start] + rng.randbytes(end - start) + content[end:]
            case 1:
                content = content[:start] + content[end:]
            case 2:
                content = content[:end] + content[start:end] + content[end:]
            case 3:
                content = content[:start]
            case 4:
                content = content[:start] + bytes(end - start) + content[end:]
            case 5:
                first, last = rng.choice(words)
                content = content[:first] + rng.choice(WORDS).encode() + content[last:]
            case 6:
                (first, last), (other, end) = rng.choice(words), rng.choice(words)
                content = content[:first] + content[other:end] + content[last:]
    return content


def mutate_file(path: Path, rng: random.Random) -> None:
    """Mutate a file; of an archive, half of the times a member, so that its checksum is right again."""
    if zipfile.is_zipfile(path) and rng.random() < 0.5:
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        name = rng.choice(sorted(members))
        members[name] = mutated(members[name], rng)
        with zipfile.ZipFile(path, "w") as archive:
            for member, content in members.items():
                archive.writestr(member, content)
    else:
        path.write_bytes(mutated(path.read_bytes(), rng))


def half_written(folder: Path) -> list[str]:
    """What is wrong with the files of a folder that a command wrote, or was writing."""
    faults = []
    for path in sorted(folder.rglob("*.json")):
        parts = path.relative_to(folder).parts
        orbax = checkpoint.RUN in parts[parts.index("checkpoints") :] if "checkpoints" in parts else False
        if orbax or any(part.startswith(".") for part in parts):
            continue  # orbax's files are listed with the others of a checkpoint; what is being written is hidden
        try:
            content = json.loads(path.read_text())
        except ValueError as error:
            faults.append(f"{path}: {error}")
            continue
        listed = content.get("files", {}) if path.name == checkpoint.META else {}
        if path.name == "manifest.json":
            listed = {f"{name}.npz": clip["sha256"] for name, clip in content["clips"].items()}
        for name, digest in listed.items():
            file = path.parent / name
            found = hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else "missing"
            if not found.startswith(digest):
                faults.append(f"{file}: {found}, not {digest}")
    return faults


# A family: (folder) → the files to mutate there, and what reads them.
Family = Callable[[Path], tuple[list[Path], Callable[[], object]]]


def _motion(folder: Path, name: str) -> tuple[list[Path], Callable[[], object]]:
    """A motion file, which `motions import` adds to a library or refuses before it writes anything."""
    robot, path = load_robot("g1"), folder / name
    if name == "motion.csv":
        clip = invented_clip(robot, "turn", 41, 1.0, 0.2)
        rows = np.concatenate([clip.root_pos, np.roll(clip.root_quat, -1, axis=-1), clip.joint_pos], axis=-1)
        np.savetxt(path, rows, delimiter=",", fmt="%.6f")
    elif name == "compressed.npz":
        with np.load(SHARED / "motions" / MJLAB) as archive:
            np.savez_compressed(path, **archive)
    else:
        shutil.copyfile(SHARED / "motions" / name, path)
    fps, library = 30.0 if path.suffix == ".csv" else None, folder / "library"
    options = motions.Options(motions.Import(path, fps=fps, end=1.0, library=library))

    def read() -> None:
        try:
            motions.main(options)
        except InputError:
            assert not library.exists(), "it was refused after something was written"
            raise
        finally:
            assert not half_written(library), half_written(library)

    return [path], read


def _library(folder: Path) -> tuple[list[Path], Callable[[], object]]:
    robot = load_robot("g1")
    write_clip(invented_clip(robot, "turn", 41, 1.0, 0.2), folder / "turn.npz")
    entries = {"turn": {"sha256": file_hash(folder / "turn.npz")}}
    manifest = {"schema": 1, "robot": "g1", "fps": 50.0, "default_targets": ["turn"], "clips": entries}
    (folder / "manifest.json").write_text(json.dumps(manifest))

    def read() -> None:
        with contextlib.suppress(ValueError, KeyError, TypeError):  # so that a mutated clip is looked at, too
            content = json.loads((folder / "manifest.json").read_text())
            content["clips"]["turn"]["sha256"] = file_hash(folder / "turn.npz")
            (folder / "manifest.json").write_text(json.dumps(content))
        build_library(robot, read_library(robot, folder))

    return [folder / "manifest.json", folder / "turn.npz"], read


def _robot(folder: Path) -> tuple[list[Path], Callable[[], object]]:
    shutil.copytree(ROBOTS_DIR / "g1", folder / "g1")
    files = [path for path in sorted((folder / "g1").iterdir()) if path.suffix in (".yaml", ".xml")]
    return files, lambda: load_robot("g1", robots_dir=folder)


def _vendor(folder: Path) -> tuple[list[Path], Callable[[], object]]:
    """A vendor's MJCF, of which `robot check` makes a robot."""
    path = Path(shutil.copyfile(SHARED / "robots" / "unitree_h1_raw.xml", folder / "vendor.xml"))

    def check() -> None:
        with contextlib.chdir(folder):  # it writes runs/ there
            robots.check_mjcf(robots.Check(path, force=True))

    return [path], check


def _config(folder: Path) -> tuple[list[Path], Callable[[], object]]:
    shutil.copyfile(base_folder("g1") / "config.yaml", folder / "config.yaml")
    return [folder / "config.yaml"], lambda: load_config(folder / "config.yaml")


def _checkpoint(folder: Path) -> tuple[list[Path], Callable[[], object]]:
    path = Path(shutil.copytree(base_folder("g1"), folder / "base"))
    files = [path / name for name in (checkpoint.POLICY, checkpoint.META, checkpoint.CONFIG)]

    def read() -> None:
        with contextlib.suppress(ValueError, KeyError, TypeError):  # so that mutated tensors are looked at, too
            meta = json.loads((path / checkpoint.META).read_text())
            meta["files"][checkpoint.POLICY] = file_hash(path / checkpoint.POLICY)
            (path / checkpoint.META).write_text(json.dumps(meta))
        info = checkpoint.read_info(path)
        setup = make_setup(info.config)
        checkpoint.check_matches(info, setup)
        checkpoint.load_policy(info, setup.robot)

    return files, read


@functools.cache
def _state() -> tuple[checkpoint.CheckpointInfo, TrainState]:
    """A checkpoint that a run can continue from, and the shapes of its state."""
    folder = Path(tempfile.mkdtemp(prefix="forgetmimic-soak-"))
    setup = make_setup(override(preset("cpu"), TINY))
    state = started(setup)
    checkpoint.save_checkpoint(folder / "00000000", setup, state, checkpoint.Progress(0, 0))
    return checkpoint.read_info(folder / "00000000"), jax.eval_shape(lambda: state)


def _run_part(folder: Path) -> tuple[list[Path], Callable[[], object]]:
    """The part of a checkpoint from which a run continues; its hashes are in the checkpoint's note."""
    info, shapes = _state()
    path = Path(shutil.copytree(info.path, folder / "00000000"))
    files = [file for file in sorted((path / checkpoint.RUN).rglob("*")) if file.is_file()]

    def read() -> None:
        checkpoint.load_state(checkpoint.read_info(path), shapes)

    return files, read


def _pt(folder: Path) -> tuple[list[Path], Callable[[], object]]:
    """A policy of rsl_rl; the small one is none of the robot's, so only its tensors are read."""
    path = Path(shutil.copyfile(Path(__file__).parent / "exchange" / "rsl_rl" / "rsl_rl_5.5.1.pt", folder / "model.pt"))
    return [path], lambda: read_rsl_rl(path, "elu")


def _policy(folder: Path, name: str) -> tuple[list[Path], Callable[[], object]]:
    """A policy of another project, which is read as `import-policy` reads it."""
    source = SHARED / "policies" / name
    path = Path(shutil.copytree(source.parent, folder / "policy")) / source.name
    files = [file for file in path.parent.iterdir() if file.suffix in (".onnx", ".yaml")]
    return files, lambda: read_policy(path, load_robot("g1"), 0.02, PolicyReading())


FAMILIES: dict[str, Family] = {
    "csv": lambda folder: _motion(folder, "motion.csv"),
    "npz": lambda folder: _motion(folder, MJLAB),
    "compressed": lambda folder: _motion(folder, "compressed.npz"),
    "pickle": lambda folder: _motion(folder, "yanjie_walk_001_gmr.pkl"),
    "library": _library,
    "robot": _robot,
    "vendor": _vendor,
    "config": _config,
    "checkpoint": _checkpoint,
    "run": _run_part,
    "onnx": lambda folder: _policy(folder, "wbc_39eff8a/policy.onnx"),
    "pt": _pt,
    "deploy": lambda folder: _policy(folder, "unitree_rl_lab_dance_102/policy.onnx"),
}
OF_OTHERS = ("npz", "compressed", "pickle", "vendor", "onnx", "deploy")  # families of files in SHARED


def flags(rng: random.Random) -> None:
    """A command line of random flags, and random settings."""
    name = rng.choice(sorted(COMMANDS))
    options = COMMANDS[name].Options
    known = [f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(options)]
    words = [
        rng.choice([*known, *SUBCOMMANDS.get(name, ()), *WORDS, "lambda", "punch", "../..", "ppo.epochs=x", "a=b"])
        for _ in range(4)
    ]
    parse(options, name, words)
    settings = by_sections(load_config(base_folder("g1") / "config.yaml"))
    override(load_config(base_folder("g1") / "config.yaml"), [f"{rng.choice(settings)}={rng.choice(WORDS)}"])


def by_sections(config) -> list[str]:
    """Names of all settings, such as ppo.epochs."""
    content = msgspec.to_builtins(config)
    return [f"{name}.{inner}" for name, of in content.items() if isinstance(of, dict) for inner in of] + list(content)


def code(folder: Path, number: int) -> None:
    """Files that run code when a careless reader loads them; none may."""
    marker = folder / "marker"
    load, robot = Code(marker), load_robot("g1")
    apply = f"!!python/object/apply:os.mkdir ['{marker}']\n"
    path = folder / ("motion.pkl", "motion.npz", "config.yaml", "policy.pt", "g1/g1.yaml")[number % 5]
    path.parent.mkdir(exist_ok=True)
    try:
        match path.suffix, path.parent.name:
            case ".pkl", _:
                path.write_bytes(pickle.dumps({"fps": 30, "root_pos": load}))
                import_motion(robot, path, Reading())
            case ".npz", _:
                np.savez(path, fps=np.array([load], object), joint_pos=np.array([load], object))
                import_motion(robot, path, Reading())
            case ".yaml", "g1":
                path.write_text(apply)
                load_robot("g1", robots_dir=folder)
            case ".yaml", _:
                path.write_text(apply)
                load_config(path)
            case _:
                with zipfile.ZipFile(path, "w") as archive:
                    archive.writestr("archive/data.pkl", pickle.dumps({"model_state_dict": load}))
                    archive.writestr("archive/version", "3")
                read_policy(path, robot, 0.02, PolicyReading())
    finally:
        assert not marker.exists(), f"{path.name} ran code"


def fault_of(work: Callable[[], object], *, usage: bool = False) -> str | None:
    """What is wrong with how a command's body ended, if anything: accepted is an end, or one line and exit code 2.

    Args:
        work: the body.
        usage: its lines are those of a wrong command line, of which there may be more.
    """

    def hang(*_: object) -> None:
        raise TimeoutError(f"hangs: {LIMIT} s")

    errors = io.StringIO()
    signal.signal(signal.SIGALRM, hang)
    signal.alarm(LIMIT)
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(errors):
            run_command(lambda: work() and None)
    except SystemExit as end:
        said = errors.getvalue()
        if end.code != 2 or "Traceback" in said:
            return f"exit code {end.code}: {said[:300]!r}"
        # A robot's YAML has a line for each of its faults.
        if not usage and not all(line.startswith(("error: ", "/")) for line in said.splitlines()):
            return f"not one line: {said[:300]!r}"
        return "error: hangs" if "hangs" in said else None
    except BaseException as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {str(error)[:200]!r} at {Path(last.filename).name}:{last.lineno}"
    finally:
        signal.alarm(0)
    return None


def run_case(family: str, number: int, keep: Path) -> str | None:
    """The fault of a case, if it has one; then its files are kept in folder `keep`."""
    rng = random.Random(f"{family} {number}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if family == "flags":
            return fault_of(lambda: flags(rng), usage=True)
        if family == "code":
            return fault_of(lambda: code(folder, number))
        files, read = FAMILIES[family](folder)
        mutate_file(rng.choice(files), rng)
        fault = fault_of(read)
        if fault:
            shutil.copytree(folder, keep / f"{family}-{number}", dirs_exist_ok=True)
        return fault


def main(family: str, first: int, last: int, journal: Path) -> None:
    """Run the cases from `first` to before `last`; a line of the journal for each, before and after."""
    with journal.open("a") as lines:
        for number in range(first, last):
            print(json.dumps({"begun": number}), file=lines, flush=True)
            fault = run_case(family, number, journal.parent)
            print(json.dumps({"ended": number, "fault": fault}), file=lines, flush=True)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]))
