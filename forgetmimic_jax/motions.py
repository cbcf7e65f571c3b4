"""Make, check and look at libraries of clips: `forgetmimic motions import FILE --name NAME`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from forgetmimic_jax.basics.console import closing, command_line
from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.settings.options import comma_separated, parse

if TYPE_CHECKING:
    from forgetmimic_jax.motion.clip import Clip
    from forgetmimic_jax.motion.quality import Quality
    from forgetmimic_jax.robot.model import Robot

FPS = 50.0  # of every library: the control rate


@dataclass
class Import:
    """Add a motion file to a library: a LAFAN1-style CSV, an mjlab / BeyondMimic NPZ or a GMR pickle.

    The clip is resampled to 50 Hz, kept inside the joints' limits and set on the floor."""

    file: tyro.conf.Positional[Path]
    """The .csv, .npz or .pkl. CSV: root position m, quaternion xyzw, joints rad in the robot's order."""
    name: str | None = None
    """Name of the clip; the file's by default."""
    fps: float | None = None
    """Frames per second of the file; a CSV needs it (LAFAN1 retargets: 30), others say it themselves."""
    start: float = 0.0
    """First second of the file to take."""
    end: float | None = None
    """Last second of the file to take; all by default."""
    library: Path | None = None
    """Folder of the library, made where missing; runs/library-ROBOT by default."""
    quaternion_order: Literal["auto", "xyzw", "wxyz"] = "auto"
    """Order of the root's quaternion; auto is the format's own (CSV and pickle xyzw, NPZ wxyz)."""
    assume_robot_order: bool = False
    """Take an NPZ without joint_names and body_names to be in the robot's order, root first."""
    keep_height: bool = False
    """Leave the heights as they are; otherwise the soles are set on the floor."""
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
    """Folder for the library; one without other files, or a library to be replaced with --force."""
    clips: str | None = None
    """Clips to make, comma-separated; by default those that are shipped for the robot, all for another one."""
    force: bool = False
    """Replace the library in the output folder."""


@dataclass
class Check:
    """Measure every clip against the bar: floor contact, joint limits, smoothness, seams, flight, and what it asks for
    that is not there: acceleration that no contact gives in the worst 0.2 s (*missing*), torque in the worst 0.1 s
    (*torque*, of the motor's limit). Exit code 2 if one fails."""

    library: Path | None = None
    """Folder of clips; data/ROBOT by default."""
    draw: Path | None = None
    """PNG to write a strip of frames a clip to."""


@dataclass
class Show:
    """One clip: its facts, and a PNG with a strip of its frames."""

    clip: tyro.conf.Positional[str]
    """Name of the clip."""
    library: Path | None = None
    """Folder of clips; data/ROBOT by default."""
    output: Path | None = None
    """The PNG; runs/CLIP.png by default."""


@dataclass
class List:
    """The clips of a library, one a line."""

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
    """Make, check and look at libraries of motion clips. `motions import --help` and so on tell a command's flags."""

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
    """Read, fit and add one motion."""
    from forgetmimic_jax.motion import fit, library, readers
    from forgetmimic_jax.motion.quality import measure

    folder = options.library or Path("runs") / f"library-{robot.name}"
    read = readers.read_motion(
        robot,
        options.file,
        name=options.name,
        fps=options.fps,
        quaternion_order=options.quaternion_order,
        assume_robot_order=options.assume_robot_order,
    )
    clip = fit.fit(robot, read, FPS, options.start, options.end)
    raised = 0.0
    if not options.keep_height:
        clip, raised = fit.on_floor(robot, clip)
    facts = {
        "source": options.file.name,
        "source_sha256": library.file_hash(options.file),
        "licence": options.licence,
        "source_fps": read.fps,
        "start": options.start,
        "end": options.end,
        "raised": round(raised, 5),
        "cyclic": False,
    }
    file = library.add_clip(folder, robot, clip, facts, overwrite=options.force)
    _print_table([measure(robot, clip)], {})
    closing(
        {"clip": file, "library": folder},
        command_line("train", robot=robot.name, library=folder),
    )


def retarget(robot: Robot, options: Retarget) -> None:
    """Make the shipped library again."""
    from forgetmimic_jax.motion.library import DATA_DIR, MANIFEST, read_manifest
    from forgetmimic_jax.retarget import recipe

    if options.output.is_dir() and any(options.output.iterdir()):
        if not (options.output / MANIFEST).exists():
            raise InputError(f"{options.output}: has files but no {MANIFEST}; give an empty or a new folder")
        if not options.force:
            raise InputError(f"{options.output}: already holds a library; give another --output, or --force")
    shipped = DATA_DIR / robot.name
    if options.clips is None:
        names = tuple(read_manifest(shipped)["clips"] if shipped.is_dir() else recipe.CLIPS)
    else:
        names = comma_separated(options.clips)
    recipe.retarget_library(robot, options.source, options.output, names, report=lambda name: print(name, flush=True))
    closing(
        {"library": options.output},
        command_line("motions", "check", robot=robot.name, library=options.output),
    )


def check(robot: Robot, options: Check) -> None:
    """Print every clip's measures and what fails."""
    from forgetmimic_jax.motion.draw import draw
    from forgetmimic_jax.motion.quality import measure

    folder, clips, entries = _open(robot, options.library)
    if options.draw:
        draw(robot, clips, [entries[clip.name].get("cycle_frames") or clip.num_frames for clip in clips], options.draw)
    measures = [measure(robot, clip, entries[clip.name].get("cycle_frames")) for clip in clips]
    _print_table(measures, entries)
    failed = [quality.name for quality in measures if quality.failures()]
    closing(
        {"library": folder, **({"drawing": options.draw} if options.draw else {})},
        command_line("train", robot=robot.name, library=folder),
    )
    if failed:
        raise InputError(f"{folder}: {len(failed)} of {len(clips)} clips miss the bar: {', '.join(failed)}")


def show(robot: Robot, options: Show) -> None:
    """Print a clip's facts and draw it."""
    from forgetmimic_jax.motion.draw import draw
    from forgetmimic_jax.motion.quality import measure

    folder, clips, entries = _open(robot, options.library, [options.clip])
    output = options.output or Path("runs") / f"{options.clip}.png"
    output.parent.mkdir(parents=True, exist_ok=True)
    cycle = entries[options.clip].get("cycle_frames")
    draw(robot, clips, [cycle or clips[0].num_frames], output)
    for field, value in entries[options.clip].items():
        if value not in (None, {}, ""):
            print(f"{field:<20} {value}")
    print()
    _print_table([measure(robot, clips[0], cycle)], entries)
    shipped_with_policy = (folder / "base").is_dir()
    closing(
        {"drawing": output, "clip": folder / f"{options.clip}.npz"},
        command_line("unlearn", robot=robot.name, targets=options.clip)
        if shipped_with_policy
        else command_line("train", robot=robot.name, library=folder),
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


COLUMNS = {  # of the table: title, unit, and how a Quality's field is printed
    "seconds": ("length", "s", "{:.2f}", 1.0),
    "sole_lowest": ("sole min", "cm", "{:.1f}", 100.0),
    "stance_height": ("stance", "cm", "{:.1f}", 100.0),
    "skate": ("skate", "m/s", "{:.2f}", 1.0),
    "other_lowest": ("body min", "cm", "{:.1f}", 100.0),
    "joint_speed": ("speed", "%", "{:.0f}", 100.0),
    "limit_excess": ("limits", "rad", "{:.2f}", 1.0),
    "joint_acceleration": ("accel.", "rad/s2", "{:.0f}", 1.0),
    "jitter": ("jitter", "%", "{:.2f}", 100.0),
    "seam": ("seam", "x", "{:.2f}", 1.0),
    "flight_acceleration": ("flight", "m/s2", "{:.1f}", 1.0),
    "missing_acceleration": ("missing", "m/s2", "{:.1f}", 1.0),
    "motor_load": ("torque", "%", "{:.0f}", 100.0),
}


def _print_table(measures: Sequence[Quality], entries: Mapping[str, Any]) -> None:
    """One line a clip, then what misses the bar."""
    width = max(len(quality.name) for quality in measures)
    human = any("direction_error_deg" in entries.get(quality.name, {}) for quality in measures)
    cells = [[title for title, *_ in COLUMNS.values()], [unit for _, unit, *_ in COLUMNS.values()]]
    for quality in measures:
        values = {field: getattr(quality, field) for field in COLUMNS}
        cells.append(
            ["-" if values[f] is None else form.format(values[f] * scale) for f, (*_, form, scale) in COLUMNS.items()]
        )
    for name, row in zip(["clip", "", *(quality.name for quality in measures)], cells, strict=True):
        extra = {"clip": "human", "": "deg"}.get(name, entries.get(name, {}).get("direction_error_deg", "-"))
        print(f"{name:<{width}}" + "".join(f"{cell:>9}" for cell in row) + (f"{extra:>7}" if human else ""))
    for quality in measures:
        for failure in quality.failures():
            print(f"{quality.name}: {failure}")


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "motions")))
