"""Make a robot of a vendor's MJCF: `forgetmimic robot check FILE.xml`, then `robot add`."""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from forgetmimic_jax.basics.console import closing, command_line, warn
from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.basics.files import write_atomically
from forgetmimic_jax.settings.options import parse

if TYPE_CHECKING:
    from forgetmimic_jax.robot.proposal import Proposal


@dataclass
class Check:
    """Say what an MJCF lacks, each with its mend, and propose the YAML of its roles.

    The YAML and a picture of the roles are written to runs/robots/NAME. Where nothing is missing, the robot holds its
    default pose for 1 s in simulation. A YAML that you completed is checked in the same way."""

    file: tyro.conf.Positional[Path]
    """The MJCF, as its vendor publishes it; or the YAML of its roles."""
    name: str | None = None
    """Name of the robot; the file's by default."""
    force: bool = False
    """Replace the YAML in runs/robots/NAME."""


@dataclass
class Add:
    """Add a robot to robots/, so that every command knows it by its name."""

    file: tyro.conf.Positional[Path]
    """The YAML of its roles, as `robot check` proposed it and you completed it."""
    force: bool = False
    """Replace a robot of the same name."""


Command = Annotated[Check, tyro.conf.subcommand("check")] | Annotated[Add, tyro.conf.subcommand("add")]


@dataclass
class Options:
    """Make a robot of a vendor's MJCF. `robot check --help` lists the flags of a command."""

    command: tyro.conf.OmitSubcommandPrefixes[Command]
    """What to do."""


def main(options: Options) -> None:
    """Run one of the commands."""
    match options.command:
        case Check():
            check(options.command)
        case Add():
            add(options.command)


def check(options: Check) -> None:
    """Propose the roles of an MJCF and say what is missing; or check a YAML of roles."""
    if options.file.suffix == ".yaml":
        _check_home(options.file)
        print(_try(options.file))
        closing({"roles": options.file}, command_line("robot", f"add {options.file}"))
    else:
        check_mjcf(options)


def check_mjcf(options: Check) -> None:
    """Propose the roles of an MJCF and say what is missing."""
    from forgetmimic_jax.robot.picture import draw_roles
    from forgetmimic_jax.robot.proposal import propose
    from forgetmimic_jax.robot.vendor import Unreadable, compiled, read_mjcf

    name = options.name or re.sub(r"\W+", "_", options.file.stem).strip("_").lower()
    _check_name(name)
    if not options.file.is_file():
        raise InputError(f"{options.file}: not found")
    folder = Path("runs") / "robots" / name
    file = folder / f"{name}.yaml"
    if file.exists() and not options.force:
        raise InputError(f"{file}: is there already, perhaps with your changes; --force replaces it")
    try:
        proposal = propose(options.file)
        model = compiled(read_mjcf(options.file)[0])[0]
    except Unreadable as error:
        raise InputError(f"{options.file}: {error}") from None
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(file, yaml_of(proposal, options.file.resolve()).encode())
    draw_roles(model, proposal.roles, folder / f"{name}.png")
    print("\n".join(f"mended: {note}" for note in proposal.notes))
    missing = proposal.missing
    if not missing:
        try:
            print(_try(file))
        except InputError as error:
            missing = [line.removeprefix(f"{file.resolve()}: ") for line in str(error).splitlines()]
            write_atomically(file, yaml_of(replace(proposal, missing=missing), options.file.resolve()).encode())
    print("\n".join(f"missing: {line}" for line in missing))
    for line in proposal.doubts:
        warn(line)
    following = f"check {file}" if missing else f"add {file}"
    closing({"roles": file, "picture": folder / f"{name}.png"}, command_line("robot", following))
    if missing:
        raise InputError(f"{options.file}: {len(missing)} thing(s) are missing; complete {file}, then check it")


def add(options: Add) -> None:
    """Check a robot's YAML and copy it to robots/."""
    from forgetmimic_jax.robot.model import ROBOTS_DIR
    from forgetmimic_jax.robot.roles import read_roles

    name = options.file.stem
    _check_home(options.file)
    (roles, _), folder = read_roles(options.file), ROBOTS_DIR / name
    if folder.exists() and not options.force:
        raise InputError(f"{folder}: a robot of this name is there; give the YAML another name, or --force")
    print(_try(options.file))
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(options.file, folder / f"{name}.yaml")
    mjcf = options.file.parent / roles.model
    if not Path(roles.model).is_absolute():
        shutil.copyfile(mjcf, folder / roles.model)
    closing({"robot": folder}, command_line("motions", "import MOTION.csv --fps 30", robot=name))


def yaml_of(proposal: Proposal, mjcf: Path) -> str:
    """The YAML, with what is missing and what was mended as comments at its top."""
    import yaml

    head = [f"# Roles proposed for {mjcf.name}. Check them against the picture beside this file.", "# Missing:"]
    head += [f"# - {line}" for line in proposal.missing] or ["# - nothing"]
    head += ["# Doubtful:", *(f"# - {line}" for line in proposal.doubts)] if proposal.doubts else []
    head += ["# Mended when the MJCF is read:", *(f"# - {line}" for line in proposal.notes)]
    head += ["# No MJCF says a motor's speed (rad/s); armatures follow from torques. Put in the maker's figures."]
    roles = {**proposal.roles, "model": str(mjcf)}
    return "\n".join(head) + "\n" + yaml.safe_dump(roles, sort_keys=False, default_flow_style=None, width=118)


def _try(file: Path) -> str:
    """Load the robot and let it hold its default pose; in words."""
    from forgetmimic_jax.robot.holding import hold
    from forgetmimic_jax.robot.model import load_robot

    robot = load_robot(file.stem, robots_dir=file.resolve().parent.parent)
    held = hold(robot)
    verdict = "holds its default pose for 1 s" if held.stands else "warning: does not hold its default pose for 1 s"
    return f"{robot.name}: {robot.num_joints} joints, {float(robot.arrays.mass):.1f} kg; {verdict}: {held}"


def _check_home(file: Path) -> None:
    """A YAML lies in a folder of its name."""
    _check_name(file.stem)
    if not file.is_file():
        raise InputError(f"{file}: not found")
    if file.resolve().parent.name != file.stem:
        raise InputError(f"{file}: put it into a folder of its name: {file.stem}/{file.stem}.yaml")


def _check_name(name: str) -> None:
    if not re.fullmatch(r"[a-z0-9][a-z0-9_-]*", name):
        raise InputError(f"name: found '{name}'; small letters, digits, - and _ are accepted, a letter or digit first")


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "robot")))
