"""Watch policies live in a web page: `forgetmimic play --robot g1`."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.settings.options import parse
from forgetmimic_jax.viewing.options import Shown


@dataclass(kw_only=True)
class Options(Shown):
    """Serve a web page with the policy, and its base beside it, tracking the clip that you choose.

    The page is for browsers on this machine, unless --host says otherwise. Each browser has a simulation of its own. No
    termination ends an episode: a robot that forgot the motion runs on, and the page says how long it stands and how
    hard it falls. Else the protocol is the evaluation's, on MuJoCo's C engine.
    """

    host: str = "127.0.0.1"
    """Address to serve at: 127.0.0.1 for browsers on this machine only, 0.0.0.0 for those of other machines too."""
    port: int = 8080
    """Port of the page; the next free one if it is taken."""


def main(options: Options) -> None:
    """Serve the page until Ctrl-C."""
    from forgetmimic_jax.basics.console import say
    from forgetmimic_jax.evaluation.side_by_side import SideBySide
    from forgetmimic_jax.viewing.playback import Playback
    from forgetmimic_jax.viewing.server import Server, check_host

    if not 1024 <= options.port <= 65535:
        raise InputError(f"--port: found {options.port}; accepted: 1024 to 65535")
    check_host(options.host)
    compared = options.load()
    stage = SideBySide(compared.setup, compared.policies)
    first = stage.library.names.index(compared.targets[0]) if compared.targets else 0
    playback = Playback(stage, first, seed=options.seed)
    playback.advance()  # compiles
    server = Server(stage, compared.targets, first=first, seed=options.seed, host=options.host, port=options.port)
    say(f"Open {server.address} in a browser; Ctrl-C ends it.")
    with contextlib.closing(server), contextlib.suppress(KeyboardInterrupt):
        server.wait()


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "play")))
