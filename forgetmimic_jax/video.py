"""Film what a policy does clip by clip: `forgetmimic video --robot g1`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from forgetmimic_jax.basics.errors import InputError, nearest, run_command
from forgetmimic_jax.settings.options import at_least, comma_separated, parse
from forgetmimic_jax.viewing.options import Shown

if TYPE_CHECKING:
    from forgetmimic_jax.viewing.takes import Episode


@dataclass(kw_only=True)
class Options(Shown):
    """Film one episode of each clip, base beside unlearned policy, and put stills of all clips on one page.

    The episodes start at the clips' first frames. No termination ends them, and a target is played 3 s longer with its
    last frame held. Else the protocol is the evaluation's, on MuJoCo's C engine.
    """

    clips: str | None = None
    """Clips to film, comma-separated; all of the library by default."""
    seconds: float = 10.0
    """Longest film, s; a film ends sooner where the clip does, or 3 s later if it is to be forgotten."""
    stills: int = 6
    """Pictures of each clip on the page of stills, from its start to its end."""
    output: Path | None = None
    """Folder for the films; videos/ in the checkpoint's run, or runs/video-ROBOT."""


def main(options: Options) -> None:
    """Record the episodes, draw and write the films, and print how the policies did in them."""
    from rich.console import Console

    from forgetmimic_jax.basics.console import closing, command_line, progress
    from forgetmimic_jax.basics.files import write_atomically
    from forgetmimic_jax.training.folder import check_writable, folder_of
    from forgetmimic_jax.viewing import film
    from forgetmimic_jax.viewing.offscreen import check_rendering
    from forgetmimic_jax.viewing.takes import record

    at_least(1, "--stills", options.stills)
    if not options.seconds > 0:
        raise InputError(f"--seconds: found {options.seconds:g}; accepted: above 0")
    run = folder_of(options.checkpoint) if options.checkpoint else None
    output = options.output or (run / "videos" if run else Path("runs") / f"video-{options.robot}")
    check_writable(output)
    compared = options.load()
    setup = compared.setup
    clips = setup.library.names if options.clips is None else comma_separated(options.clips)
    if not clips:
        raise InputError("--clips: no clip named; leave the flag out for all of them")
    for clip in clips:
        if clip not in setup.library.names:
            raise InputError(f"--clips: no clip '{clip}' in the library; {nearest(clip, setup.library.names)}")
    check_rendering()
    episodes = record(setup, compared.policies, clips, compared.targets, seed=options.seed)
    output.mkdir(parents=True, exist_ok=True)
    sheet, drawn = [], 0
    total = sum(len(film.shown_steps(episode, seconds=options.seconds)) for episode in episodes)
    with film.pane_renderer(options.robot) as renderer, progress("draw", total) as show:
        for episode in episodes:
            frames = []
            for frame in film.render_clip(renderer, episode, seconds=options.seconds):
                frames.append(frame)
                drawn += 1
                show(drawn, 0, {})
            write_atomically(output / f"{episode.clip}.mp4", film.mp4(frames))
            write_atomically(output / f"{episode.clip}.gif", film.gif(frames))
            sheet.append(film.stills(frames, options.stills))
    write_atomically(output / "contact_sheet.png", film.contact_sheet(sheet))
    Console().print(_table(episodes))
    files = {"films": output / "*.mp4", "for pages": output / "*.gif", "all clips": output / "contact_sheet.png"}
    shown = {name: getattr(options, name) for name in ("robot", "checkpoint", "base", "beside", "library")}
    closing(files, command_line("play", **shown))


def _table(episodes: Sequence[Episode]):
    """What happened in each film."""
    from rich import box
    from rich.table import Table

    from forgetmimic_jax.viewing.takes import at

    table = Table(title="One episode a clip", title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for column in ("clip", "role", *(f"{name}: tracking" for name in episodes[0].takes)):
        table.add_column(column, justify="left" if column in ("clip", "role") else "right")
    for episode in episodes:
        cells = []
        for name, take in episode.takes.items():
            words = filter(None, at(episode, name, len(take.impact)))
            cells.append(", ".join([f"{take.survival_weighted_tracking:.2f}", *words]))
        table.add_row(episode.clip, "target" if episode.target else "kept", *cells)
    return table


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "video")))
