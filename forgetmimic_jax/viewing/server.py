"""The viewer as a server: a simulation of its own for each browser, in a thread that ends when the browser is gone."""

from __future__ import annotations

import contextlib
import io
import socket
import threading
import time
import warnings
from collections.abc import Sequence

import numpy as np
import viser

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.evaluation.side_by_side import SideBySide
from forgetmimic_jax.robot.model import relative_height
from forgetmimic_jax.viewing.offscreen import drawing_model
from forgetmimic_jax.viewing.page import Page
from forgetmimic_jax.viewing.playback import Playback
from forgetmimic_jax.viewing.shapes import shapes

LOCALHOST, EVERYWHERE = "127.0.0.1", ("0.0.0.0", "::")


class Server:
    """Serves a page about the policies of a stage to every browser that connects."""

    def __init__(
        self,
        stage: SideBySide,
        targets: Sequence[str],
        *,
        first: int = 0,
        seed: int = 0,
        host: str = LOCALHOST,
        port: int = 8080,
    ):
        """Serve at once.

        Args:
            stage: of the policies.
            targets: clips to forget.
            first: the clip that a page begins with.
            seed: of the reset noise.
            host: address of this machine to be reached at, see `check_host`; LOCALHOST: only from this machine.
            port: of the page; the next free one if it is taken.
        """
        self._stage, self._targets, self._first, self._seed = stage, targets, first, seed
        self._shapes = shapes(drawing_model(stage.env.robot.name, 16, 16))
        self._turn = threading.Lock()  # to simulate: a stage serves one thread at a time
        self._visits: dict[int, tuple[threading.Thread, threading.Event]] = {}
        with contextlib.redirect_stdout(io.StringIO()):  # viser's own announcement
            self._server = viser.ViserServer(host=host, port=port, label="ForgetMimic", verbose=False)
        name = socket.gethostname() if host in EVERYWHERE else host
        self.address = f"http://{f'[{name}]' if ':' in name else name}:{self._server.get_port()}"
        size = relative_height(stage.env.robot.model)
        camera = self._server.initial_camera
        camera.position, camera.look_at = size * np.array([3.4, -0.9, 1.5]), size * np.array([0.0, 0.0, 0.62])
        self._server.scene.set_background_image(np.full((1, 1, 3), 244, np.uint8))
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._server.gui.main_panel.dock_right()
        # A page may still move something in the moment in which its browser leaves.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        self._server.on_client_connect(self._welcome)
        self._server.on_client_disconnect(self._part)

    def wait(self) -> None:
        """Serve until this thread is interrupted."""
        while True:
            time.sleep(1.0)

    def close(self) -> None:
        """Stop serving, and wait for the simulations to end."""
        visits = list(self._visits.values())
        for _, gone in visits:
            gone.set()
        for thread, _ in visits:
            thread.join()
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    # Both in the server's event loop, so a browser never leaves before it has come.

    async def _welcome(self, client: viser.ClientHandle) -> None:
        gone = threading.Event()
        thread = threading.Thread(target=self._play, args=(client, gone), daemon=True)
        self._visits[client.client_id] = thread, gone
        thread.start()

    async def _part(self, client: viser.ClientHandle) -> None:
        _, gone = self._visits.pop(client.client_id)
        gone.set()

    def _play(self, client: viser.ClientHandle, gone: threading.Event) -> None:
        with self._turn:
            playback = Playback(self._stage, self._first, seed=self._seed)
        Page(client, playback, self._shapes, self._targets).run(gone, self._turn)


def check_host(host: str) -> None:
    """InputError unless a name or address is this machine's; viser would wait forever for another one."""
    try:
        family, *_, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family) as trial:
            trial.bind(address)
    except (OSError, UnicodeError) as error:
        accepted = "accepted: an address of this machine, such as 127.0.0.1, or 0.0.0.0 for all of them"
        raise InputError(f"--host: found {host}; {accepted} ({error})") from None
