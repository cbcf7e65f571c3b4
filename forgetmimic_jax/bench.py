"""Measure the speed of training on this machine: `forgetmimic bench`. Ratios within one run, nothing absolute."""

from __future__ import annotations

import dataclasses
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.basics.files import write_json
from forgetmimic_jax.basics.provenance import cores, made_here
from forgetmimic_jax.settings.config import EngineName, Preset
from forgetmimic_jax.settings.options import at_least, comma_separated, on_engine, parse, replace_given

ROUNDS = 2  # processes of each side in a comparison with another commit


@dataclass
class Options:
    """Time the environment against raw MuJoCo stepping of the same states, and the parts of a PPO iteration."""

    robot: str = "g1"
    """Robot under robots/."""
    preset: Preset = "cpu"
    """Settings."""
    physics: EngineName | None = None
    """Physics engine; auto is native on a CPU and mjx on a GPU or TPU."""
    library: Path | None = None
    """Folder of clips; data/ROBOT by default."""
    repeats: int = 7
    """Times each measurement is taken; the median counts, rounds of all measurements alternate."""
    dry: bool = False
    """Simulate nothing; print the memory that an iteration needs, as XLA computes it. The preset paper takes the engine
    of a GPU then, unless --physics names another."""
    devices: str | None = None
    """Numbers of devices to compare, such as 1,2,4: how fast an iteration is on each (docs/cluster.md)."""
    against: str | None = None
    """Commit to compare with. Both are measured in turns on the default settings."""
    output: Path | None = None
    """JSON file for the figures; only printed by default."""


def main(options: Options) -> None:
    """Measure and print a table."""
    started = time.perf_counter()
    from forgetmimic_jax.settings.config import preset
    from forgetmimic_jax.tracking.setup import make_setup
    from forgetmimic_jax.training.folder import check_writable

    at_least(1, "--repeats", options.repeats)
    if options.output:
        check_writable(options.output.parent)
        if options.output.is_dir():
            raise InputError(f"{options.output}: a folder; --output is a file")
    if options.dry and options.devices:
        raise InputError("--dry: does not go with --devices")
    counts = [] if options.devices is None else device_counts(options.devices)
    figures: dict[str, Any]
    if options.against:
        figures = compared(options.against, options)
        show(figures["over"], f"this code over {options.against}")
    elif len(counts) > 1:
        figures = {"growth": growth(counts, options)}
        show_growth(figures["growth"], f"{options.robot}, preset {options.preset}: one training on several devices")
    else:
        from forgetmimic_jax.training import speed
        from forgetmimic_jax.training.devices import join

        config = replace_given(preset(options.preset), robot=options.robot, library=options.library)
        physics = options.physics
        if options.dry and options.preset == "paper" and physics is None:
            physics = "mjx"
            print("--physics: mjx, the engine of this preset on a GPU, also where there is none")
        config = dataclasses.replace(on_engine(config, physics), devices=counts[0] if counts else 1)
        join(config)
        setup = make_setup(config)
        if options.dry:
            figures = speed.memory(setup)
        elif counts:
            figures = speed.growth(setup, repeats=options.repeats)
        else:
            figures = speed.speed(setup, repeats=options.repeats, started=started)
        show(figures, f"{options.robot}, preset {options.preset}, {figures['engine']} engine")
    if options.output:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        document = {**figures, "made": dataclasses.asdict(made_here())}
        write_json(options.output, document)
        print(f"figures  {options.output}")


def show(figures: Mapping[str, Any], title: str) -> None:
    """Print the figures as a table."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    table.add_column("figure")
    table.add_column("value", justify="right")
    for name, value in figures.items():
        table.add_row(name.replace("_", " "), f"{value:,.2f}" if isinstance(value, float) else str(value))
    Console().print(table)


def device_counts(text: str) -> list[int]:
    """'4,1,2' → [1, 2, 4].

    Raises:
        InputError: not numbers from 1 on.
    """
    counts = comma_separated(text)
    if not counts or not all(count.isdigit() and int(count) for count in counts):
        raise InputError(f"--devices: found {text}; accepted: numbers from 1 on, such as 1,2,4")
    return sorted({int(count) for count in counts})


def growth(counts: Sequence[int], options: Options) -> list[dict[str, Any]]:
    """A row for each number of devices, in a process of its own; computed where there are fewer devices.

    On a CPU every device has the same share of the cores, so that fewer devices have fewer cores. What is computed is
    the first row's time over the number of devices, and the averaging of the last measured row.

    Raises:
        InputError: the first number cannot be measured.
    """
    checkout, here = Path(__file__).resolve().parents[1], cores()
    each = max(1, here // max([count for count in counts if count <= here], default=1))
    rows: list[dict[str, Any]] = []
    for count in counts:
        try:
            with tempfile.TemporaryDirectory() as folder:
                more = ["--devices", str(count), "--preset", options.preset]
                more += ["--physics", options.physics] if options.physics else []
                more += ["--library", str(options.library.resolve())] if options.library else []
                use = min(here, count * each)
                figures = _figures_of(checkout, Path(folder) / "figures.json", options, more, use)
            rows.append({**figures, "measured": True})
        except InputError as error:
            if not rows or "--devices" not in str(error):
                raise
            rows.append(_computed(rows[0], [row for row in rows if row["measured"]][-1], count))
    for row in rows:
        row["over_first"] = rows[0]["iteration_seconds"] / row["iteration_seconds"]
    return rows


def _computed(first: Mapping[str, Any], last: Mapping[str, Any], devices: int) -> dict[str, Any]:
    alone = (first["iteration_seconds"] - first["averaging_seconds"]) * first["devices"] / devices
    times = {"iteration_seconds": alone + last["averaging_seconds"], "averaging_seconds": last["averaging_seconds"]}
    return {**first, **times, "devices": devices, "cores": first["cores"] * devices // first["devices"],
            "measured": False}  # fmt: skip


def show_growth(rows: Sequence[Mapping[str, Any]], title: str) -> None:
    """Print the rows of `growth` as a table."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, title_justify="left")
    for column in ("devices", "cores", "steps/s", "over the first", "s an iteration", "of it averaging", ""):
        table.add_column(column, justify="right")
    for row in rows:
        seconds, averaging = row["iteration_seconds"], row["averaging_seconds"]
        numbers = (f"{row['control_steps'] / seconds:,.0f}", f"{row['over_first']:.2f}", f"{seconds:.3f}")
        how = "measured" if row["measured"] else "computed"
        table.add_row(str(row["devices"]), str(row["cores"]), *numbers, f"{averaging:.4f}", how)
    Console().print(table)


def compared(commit: str, options: Options) -> dict[str, Any]:
    """The figures of this code and of another commit, each process in turn, and this code's over the other's.

    Raises:
        InputError: flags that the other commit may not know, no git checkout, or an unknown commit.
    """
    for name in ("preset", "physics", "library", "dry", "devices"):
        if getattr(options, name) != getattr(Options(), name):
            raise InputError(f"--{name}: does not go with --against, which measures the default settings")
    checkout = Path(__file__).resolve().parents[1]
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / "other"
        _git(checkout, ["worktree", "add", "--detach", str(other), commit], commit)
        try:
            sides: dict[str, list[dict[str, Any]]] = {"this": [], "other": []}
            for _ in range(ROUNDS):
                for name, root in (("this", checkout), ("other", other)):
                    sides[name].append(_figures_of(root, Path(folder) / "figures.json", options))
        finally:
            _git(checkout, ["worktree", "remove", "--force", str(other)], commit)
    this, that = _medians(sides["this"]), _medians(sides["other"])
    over = {name: value / that[name] for name, value in this.items() if that.get(name)}
    return {"this": this, "other": that, "over": over}


def _figures_of(
    root: Path, output: Path, options: Options, more: Sequence[str] = (), use: int | None = None
) -> dict[str, Any]:
    """The figures that the code in folder `root` measures in a process of its own, on `use` cores if that is given."""
    command = [sys.executable, "-m", "forgetmimic_jax.bench", "--output", str(output)]
    command += ["--robot", options.robot, "--repeats", str(options.repeats), *more]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    if use is not None:
        environment["PYTHON_CPU_COUNT"] = str(use)

    def keep_to_cores() -> None:
        if use is not None and hasattr(os, "sched_setaffinity"):  # what XLA's threads follow
            os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:use])

    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, preexec_fn=keep_to_cores)
    if done.returncode:
        last = (done.stderr or done.stdout).strip().splitlines()[-1:]
        raise InputError(f"{root}: its bench ended with exit code {done.returncode}: {' '.join(last)}")
    figures: dict[str, Any] = json.loads(output.read_text())
    return {name: value for name, value in figures.items() if name != "made"}


def _medians(runs: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """The median over the runs of every figure that is a number."""
    numbers = [name for name, value in runs[0].items() if isinstance(value, float)]
    return {name: statistics.median(run[name] for run in runs) for name in numbers}


def _git(checkout: Path, arguments: Sequence[str], commit: str) -> None:
    done = subprocess.run(["git", "-C", str(checkout), *arguments], capture_output=True, text=True)
    if done.returncode:
        why = done.stderr.strip().splitlines()[-1:]
        raise InputError(f"--against: found {commit}; accepted: a commit of the checkout ({' '.join(why)})")


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "bench")))
