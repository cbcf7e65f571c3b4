"""Make, check and draw libraries of clips: `forgetmimic motions import FILE --name NAME`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from forgetmimic_jax.basics.console import closing, command_line
from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.settings.options import comma_separated, parse

if TYPE_CHECKING:
    from forgetmimic_jax.motion.clip import Clip
    from forgetmimic_jax.robot.model import Robot


@dataclass
class Import:
    """Add a motion file to a library: a CSV, an mjlab / BeyondMimic / wbc-mjlab NPZ or a GMR / MimicKit pickle.

    The file is compared with the robot and with all that it says itself. The clip is resampled to 50 Hz, clipped to the
    joints' limits and set on the ground. It is written after every check has passed."""

    file: tyro.conf.Positional[Path]
    """The .csv, .npz or .pkl. A CSV without names: root position m, quaternion xyzw, joints rad in the robot's
    order."""
    name: str | None = None
    """Name of the clip; the file's by default, with _ for every other character than letters, digits, - and _."""
    fps: float | None = None
    """Frames per second of the file. A CSV needs it (LAFAN1 retargets: 30); the other formats hold it."""
    start: float = 0.0
    """First second to take."""
    end: float | None = None
    """Last second to take; the file's end by default."""
    library: Path | None = None
    """Folder of the library; a missing one is made. runs/library-ROBOT by default."""
    joint_order: Literal["auto", "robot", "isaac"] = "auto"
    """Order of joints that the file does not name. isaac: Isaac Lab's, level by level. auto: the format's own; an NPZ
    must show it by its bodies."""
    quaternion: Literal["auto", "xyzw", "wxyz"] = "auto"
    """Order of the root's quaternion. auto: the format's own (CSV and pickle xyzw, NPZ wxyz)."""
    up: Literal["z", "y"] = "z"
    """Axis of the file's world that points up."""
    unit: Literal["m", "cm", "mm"] = "m"
    """Unit of the file's positions."""
    angles: Literal["radians", "degrees"] = "radians"
    """Unit of the file's joint angles."""
    fill_missing: bool = False
    """Hold joints that the file lacks at their default angle."""
    variant: str | None = None
    """Variant of the robot that the file holds, where several have as many joints. With --fill-missing."""
    keep_height: bool = False
    """Leave the heights as they are. Otherwise the soles are set on the ground, at most 0.3 m away."""
    licence: str = "unknown"
    """Licence of the motion, for the manifest."""
    force: bool = False
    """Replace a clip of the same name."""


@dataclass
class Retarget:
    """Make the shipped library again from DeepMimic's human clips, bit for bit (some minutes)."""

    source: Path
    """Folder with DeepMimic's humanoid3d_*.txt."""
    output: Path
    """Folder for the library: a new or an empty one, or with --force a library, which is replaced."""
    clips: str | None = None
    """Clips to make, comma-separated. By default those that are shipped for the robot."""
    force: bool = False
    """Replace the library in the output folder."""


@dataclass
class Check:
    """Measure every clip of a library. The exit code is 2 where a clip is no motion of the robot.

    What is only rougher than the shipped clips is a note. Measured: the root's speed (*root*), floor contact, joint
    limits, smoothness, seams, flight; acceleration that no contact can give, in the worst 0.2 s (*missing*); motor
    torque over its limit, in the worst 0.1 s (*torque*)."""

    library: Path | None = None
    """Folder of clips; data/ROBOT by default."""
    draw: Path | None = None
    """PNG file for a drawing: one strip of frames a clip."""


@dataclass
class Show:
    """Print the facts of one clip, and draw its frames to a PNG file."""

    clip: tyro.conf.Positional[str]
    """Name of the clip."""
    library: Path | None = None
    """Folder of clips; data/ROBOT by default."""
    output: Path | None = None
    """The PNG file; runs/CLIP.png by default."""


@dataclass
class List:
    """List the clips of a library, one a line."""

    library: Path | None = None
    """Folder of clips; data/ROBOT by default."""


Command = (
    Annotated[Import, tyro.conf.subcommand("import")]
    | Annotated[Retarget, tyro.conf.subcommand("retarget")]
    | Annotated[Check, tyro.conf.subcommand("check")]
    | Annotated[Show, tyro.conf.subcommand("show")]
    | Annotated[List, tyro.conf.subcommand("list")]
)


@tyro.conf.configure(tyro.conf.CascadeSubcommandArgs)  # --robot before or after the command's name
@dataclass
class Options:
    """Make, check and draw libraries of motion clips. `motions import --help` lists the flags of a command."""

    command: tyro.conf.OmitSubcommandPrefixes[Command]
    """What to do."""
    robot: str = "g1"
    """Robot under robots/."""


def main(options: Options) -> None:
    """Run one of the commands."""
    # Before NumPy starts: its threads only stand in each other's way on matrices as small as a robot's.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from forgetmimic_jax.robot.model import load_robot

    robot = load_robot(options.robot)
    match options.command:
        case Import():
            import_motion(robot, options.command)
        case Retarget():
            retarget(robot, options.command)
        case Check():
            check(robot, options.command)
        case Show():
            show(robot, options.command)
        case List():
            list_clips(robot, options.command)


def import_motion(robot: Robot, options: Import) -> None:
    """Make a clip of a motion file and add it to a library."""
    from forgetmimic_jax.motion import importing, library
    from forgetmimic_jax.motion.clip import default_name
    from forgetmimic_jax.motion.recording import Reading
    from forgetmimic_jax.motion.table import quality_table

    folder = options.library or Path("runs") / f"library-{robot.name}"
    name = options.name or default_name(options.file.stem)
    library.manifest_for(folder, robot, name, importing.FPS, overwrite=options.force)
    reading = Reading(**{field.name: getattr(options, field.name) for field in fields(Reading)})
    imported = importing.import_motion(robot, options.file, reading, keep_height=options.keep_height)
    facts = {**imported.facts, "licence": options.licence}
    file = library.add_clip(folder, robot, imported.clip, facts, overwrite=options.force)
    print("\n".join(imported.notes), end="\n\n")
    print(quality_table([imported.quality], {}))
    closing({"clip": file, "library": folder}, _train(robot, folder))


def retarget(robot: Robot, options: Retarget) -> None:
    """Make the shipped library again."""
    from forgetmimic_jax.retarget import recipe

    recipe.check_output(options.output, overwrite=options.force)
    names = recipe.shipped_clips(robot.name) if options.clips is None else comma_separated(options.clips)
    recipe.retarget_library(robot, options.source, options.output, names, progress=lambda name: print(name, flush=True))
    closing({"library": options.output}, command_line("motions", "check", robot=robot.name, library=options.output))


def check(robot: Robot, options: Check) -> None:
    """Print every clip's measures and those outside its bounds."""
    from forgetmimic_jax.motion.draw import draw
    from forgetmimic_jax.motion.quality import measure
    from forgetmimic_jax.motion.table import quality_table

    folder, clips, entries = _open(robot, options.library)
    cycles = [entries[clip.name].get("cycle_frames") for clip in clips]
    measures = [measure(robot, clip, cycle) for clip, cycle in zip(clips, cycles, strict=True)]
    print(quality_table(measures, entries))
    files = {"library": folder}
    if options.draw:
        spans = [cycle or clip.num_frames for clip, cycle in zip(clips, cycles, strict=True)]
        draw(robot, clips, spans, options.draw)
        files["drawing"] = options.draw
    closing(files, _train(robot, folder))
    failed = [quality.name for quality in measures if quality.faults()]
    if failed:
        raise InputError(
            f"{folder}: {len(failed)} of {len(clips)} clips are no motion of {robot.name}: {', '.join(failed)}"
        )


def show(robot: Robot, options: Show) -> None:
    """Print a clip's facts and draw it."""
    from forgetmimic_jax.motion.draw import draw
    from forgetmimic_jax.motion.quality import measure
    from forgetmimic_jax.motion.table import quality_table

    folder, (clip,), entries = _open(robot, options.library, [options.clip])
    entry, output = entries[clip.name], options.output or Path("runs") / f"{clip.name}.png"
    quality = measure(robot, clip, entry.get("cycle_frames"))
    output.parent.mkdir(parents=True, exist_ok=True)
    draw(robot, [clip], [entry.get("cycle_frames") or clip.num_frames], output)
    for field, value in entry.items():
        if value not in (None, {}, ""):
            print(f"{field:<20} {value}")
    print()
    print(quality_table([quality], entries))
    unlearn = command_line("unlearn", robot=robot.name, targets=clip.name)
    closing(
        {"drawing": output, "clip": folder / f"{clip.name}.npz"},
        unlearn if (folder / "base").is_dir() else _train(robot, folder),  # a shipped library has its policy
    )


def list_clips(robot: Robot, options: List) -> None:
    """Print name, length and origin of every clip."""
    folder, clips, entries = _open(robot, options.library)
    width = max(len(clip.name) for clip in clips)
    for clip in clips:
        print(f"{clip.name:<{width}}  {clip.seconds:7.2f} s  {entries[clip.name].get('source', '')}")
    closing(
        {"library": folder},
        command_line("motions", f"show {clips[0].name}", robot=robot.name, library=folder),
    )


def _open(
    robot: Robot, folder: Path | None, names: Sequence[str] | None = None
) -> tuple[Path, list[Clip], dict[str, Any]]:
    """The library's folder, its clips and their manifest entries."""
    from forgetmimic_jax.motion import library

    folder = folder or library.DATA_DIR / robot.name
    if folder.is_absolute() and folder.is_relative_to(Path.cwd()):
        folder = folder.relative_to(Path.cwd())
    clips = library.read_library(robot, folder, names)
    return folder, clips, library.read_manifest(folder)["clips"]


def _train(robot: Robot, folder: Path) -> str:
    return command_line("pretrain", robot=robot.name, library=folder)


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "motions")))
