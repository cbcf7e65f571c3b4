"""Watch policies live in a web page: `forgetmimic play --robot g1`."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path

from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.settings.options import at_least, comma_separated, parse


@dataclass
class Options:
    """Serve a web page with the policy, and its base beside it, tracking the clip that you choose.

    The page is for browsers on this machine, unless --host says otherwise. Each browser has a simulation of its own. No
    termination ends an episode: a robot that forgot the motion runs on, and the page says how long it stands and how
    hard it falls. Else the protocol is the evaluation's, on MuJoCo's C engine.
    """

    robot: str = "g1"
    """Robot under robots/."""
    checkpoint: Path | None = None
    """Checkpoint, or the folder of a run, such as an unlearning run's; the shipped base data/ROBOT/base by default."""
    base: Path | None = None
    """For an unlearned checkpoint, the base beside it; the one it started from by default."""
    beside: str | None = None
    """More checkpoints to show beside these, comma-separated; each is named by its method."""
    seed: int = 0
    """Seed of the reset noise; the same for every policy."""
    library: Path | None = None
    """Folder of clips; the checkpoint's by default."""
    host: str = "127.0.0.1"
    """Address to serve at: 127.0.0.1 for browsers on this machine only, 0.0.0.0 for those of other machines too."""
    port: int = 8080
    """Port of the page; the next free one if it is taken."""


def main(options: Options) -> None:
    """Serve the page until Ctrl-C."""
    from rich.console import Console

    from forgetmimic_jax.evaluation.side_by_side import SideBySide
    from forgetmimic_jax.training.comparison import load_comparison
    from forgetmimic_jax.training.start import base_folder
    from forgetmimic_jax.viewing.playback import Playback
    from forgetmimic_jax.viewing.server import Server, check_host

    at_least(0, "--seed", options.seed)
    if not 1024 <= options.port <= 65535:
        raise InputError(f"--port: found {options.port}; accepted: 1024 to 65535")
    check_host(options.host)
    path = options.checkpoint or base_folder(options.robot)
    compared = load_comparison(
        path,
        robot=options.robot,
        base=options.base,
        beside=[Path(one) for one in comma_separated(options.beside or "")],
        library=options.library,
        physics="native",
    )
    robot, library = compared.setup.robot, compared.setup.library
    stage = SideBySide(compared.setup, compared.policies)
    first = library.names.index(compared.targets[0]) if compared.targets else 0
    playback = Playback(stage, robot, first, seed=options.seed)
    playback.advance()  # compiles
    server = Server(
        stage, robot, compared.targets, first=first, seed=options.seed, host=options.host, port=options.port
    )
    Console().print(f"Open {server.address} in a browser; Ctrl-C ends it.", highlight=False)
    with contextlib.closing(server), contextlib.suppress(KeyboardInterrupt):
        server.wait()


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "play")))
