"""The page in a headless browser, and without one what its controls do."""

import contextlib
import io
import shutil
import socket
import sys
import threading
from collections.abc import Iterator

import msgspec
import numpy as np
import pytest
import viser
from PIL import Image
from waiting import until
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.evaluation.side_by_side import SideBySide
from forgetmimic_jax.viewing import server as serving
from forgetmimic_jax.viewing.offscreen import drawing_model
from forgetmimic_jax.viewing.page import Page
from forgetmimic_jax.viewing.playback import Playback
from forgetmimic_jax.viewing.server import Server, check_host
from forgetmimic_jax.viewing.shapes import shapes

SIZE = {"width": 640, "height": 420}
SCENE = {"x": 0, "y": 0, "width": 308, "height": 420}  # what the panel of controls leaves
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-background-networking"]
PATIENCE = 240_000  # ms: a browser that draws in software on a busy machine is slow


@pytest.fixture(scope="module")
def stage(tiny_setup, policy) -> SideBySide:
    return SideBySide(tiny_setup, {"base": policy, "unlearned": None})


@pytest.fixture(scope="module")
def drawn(robot):
    return shapes(drawing_model(robot.name, 16, 16))


@pytest.fixture
def page(stage, drawn):
    everybody = viser.ViserServer(host="127.0.0.1", port=18080, verbose=False)
    yield Page(everybody, Playback(stage), drawn, ["turn"])
    everybody.stop()


@pytest.fixture
def server(stage):
    with contextlib.closing(Server(stage, ["turn"], port=18090)) as server:
        yield server


@pytest.fixture(scope="module")
def browser():
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        pytest.skip("no Chromium on this machine")
    playwright = pytest.importorskip("playwright.sync_api", reason="the package playwright is not installed")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=FLAGS)
        yield browser
        browser.close()


def picture(view) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(view.screenshot(clip=SCENE, timeout=PATIENCE))).convert("RGB"), int)


def test_the_page_opens_a_clip_is_chosen_and_both_robots_move(server, browser, tmp_path):
    # A browser that draws in software has little time for anything else.
    server._server.scene.configure_default_lights(cast_shadow=False)
    with browser.new_page(viewport=SIZE, device_scale_factor=0.5) as view:
        view.set_default_timeout(PATIENCE)
        elsewhere = []
        view.on("request", lambda request: elsewhere.append(request.url))
        view.goto(server.address)
        view.get_by_text("Tracking reward", exact=True).wait_for()
        # Events rather than clicks, which wait for the page to hold still: on a busy machine that takes minutes.
        view.get_by_role("button", name="Pause", exact=True).dispatch_event("click")
        view.get_by_role("combobox").first.dispatch_event("click")
        view.get_by_role("option", name="turn (to be forgotten)").dispatch_event("click")
        view.get_by_text("0.00 of 3.80 s").wait_for()
        view.wait_for_timeout(2000)  # the scene fades in
        before = picture(view)
        for step in range(1, 11):
            view.get_by_role("button", name="Step", exact=True).dispatch_event("click")
            view.get_by_text(f"{0.02 * step:.2f} of 3.80 s").wait_for()  # the browser merges events in quick succession
        view.wait_for_timeout(1000)
        after = picture(view)
        view.screenshot(path=tmp_path / "page.png", timeout=PATIENCE)
    for half in np.split(np.abs(after - before).sum(-1) > 60, 2, axis=1):
        assert half.sum() > 15, "a robot moved"
    assert [url for url in elsewhere if not url.startswith((server.address, "data:", "blob:"))] == []


def test_the_controls_do_what_they_say(page, library):
    playback = page._playback
    page._single_step()
    assert (playback.step, page._playing) == (1, False)
    velocity = np.asarray(playback._state.physics.qvel)[:, :2]
    page._push(2.0)
    gained = np.asarray(playback._state.physics.qvel)[:, :2] - velocity
    np.testing.assert_allclose(np.linalg.norm(gained, axis=1), 2.0, rtol=1e-5)
    np.testing.assert_allclose(gained[0], gained[1], atol=1e-6)
    assert list(page._menu) == ["sway", "turn (to be forgotten)"]
    page._ask(lambda: playback.begin(1))(None)
    assert playback.clip == 0, "what a visitor asks for waits for the thread that simulates"
    assert page._obey()
    assert (playback.clip, playback.step) == (1, 0)
    assert not page._obey()


def test_it_repeats_only_if_set_to(page):
    playback = page._playback
    playback.step = playback.last_step
    page._repeat.value = False
    page._advance()
    assert playback.step == playback.last_step
    page._repeat.value = True
    page._advance()
    assert playback.step == 0


def test_a_forgotten_motion_shows_in_words_and_a_fall_as_a_red_frame(page):
    playback = page._playback
    playback.begin(1)
    playback.step, playback.tracking = 2, [np.array([0.8, 0.8]), np.array([0.6, 0.0])]
    playback.height *= 3
    playback.ended = [None, 1]
    page._show(plots=True)
    assert [lane._alarm.visible for lane in page._lanes] == [False, False]
    assert [lane._label.text for lane in page._lanes] == [
        "base",
        "unlearned: forgets the motion at 0.02 s, stands 0.04 s",
    ]
    playback.fell, playback.impact = [None, 2], np.array([0.0, 3.21])
    page._show(plots=True)
    assert [lane._alarm.visible for lane in page._lanes] == [False, True]
    fate = "forgets the motion at 0.02 s, falls at 0.04 s, impact 3.2 times its weight"
    assert [lane._label.text for lane in page._lanes] == ["base", f"unlearned: {fate}"]
    assert page._status.content.splitlines()[1:] == [
        "- base: **0.70**, stands 0.04 s",
        f"- unlearned: **0.40**, {fate}",
    ]


def test_a_robot_stays_in_the_middle_of_its_floor_facing_the_viewer(page):
    from scipy.spatial.transform import Rotation

    lane, qpos = page._lanes[0], page._playback.qpos[0].copy()
    qpos[:2] = [3.0, -7.0]
    quarter = np.pi / 2.0
    lane.show(qpos, page._poses(qpos), None, qpos, quarter)
    turn = Rotation.from_quat(lane._world.wxyz, scalar_first=True)
    np.testing.assert_allclose(turn.apply([3.0, -7.0, 0.0]) + lane._world.position, 0.0, atol=1e-6)
    np.testing.assert_allclose(turn.apply([0.0, 1.0, 0.0]), [1.0, 0.0, 0.0], atol=1e-6)  # heading along y
    assert not lane._ghost._root.visible


CAMERA = {
    **{"type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "fov": 1.0, "near": 0.1, "far": 9.0},
    **{"position": (1.0, 0.0, 0.0), "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0)},
    **{"image_height": 1, "image_width": 1},
}


@contextlib.contextmanager
def browsing(server: Server) -> Iterator[ClientConnection]:
    """What a browser sends when it opens the page."""
    address, protocol = server.address.replace("http", "ws"), Subprotocol(f"viser-v{viser.__version__}")
    with connect(address, subprotocols=[protocol], max_size=None) as connection:
        connection.send(msgspec.msgpack.encode(CAMERA))
        threading.Thread(target=read, args=(connection,), daemon=True).start()
        yield connection


def read(connection: ClientConnection) -> None:
    """Read what the page sends; a browser that does not is soon taken for gone."""
    with contextlib.suppress(ConnectionClosed):
        while True:
            connection.recv()


def test_each_browser_has_a_simulation_and_one_that_vanishes_ends_its_own(server, monkeypatch):
    playbacks = {}

    class Noted(Page):
        def __init__(self, client, playback, *others):
            super().__init__(client, playback, *others)
            playbacks[threading.current_thread()] = playback

    monkeypatch.setattr(serving, "Page", Noted)

    with browsing(server) as first, browsing(server):
        until(lambda: len(playbacks) == 2)
        one, other = playbacks.values()
        one.begin(1)
        until(lambda: one.step > 3 and other.step > 3)
        assert (one.clip, other.clip) == (1, 0)
        first.socket.shutdown(socket.SHUT_RDWR)  # no goodbye
        until(lambda: sum(thread.is_alive() for thread in playbacks) == 1)
        assert len(server._visits) == 1
        (left,) = (playback for thread, playback in playbacks.items() if thread.is_alive())
        step = left.step
        until(lambda: left.step != step)
    until(lambda: not server._visits)


@pytest.mark.skipif(sys.platform != "linux", reason="the address 127.0.0.2 is Linux's")
def test_it_is_served_to_this_machine_alone_unless_a_host_is_given(server, stage):
    assert server.address == "http://127.0.0.1:18090"
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", 18090), timeout=60.0)
    with contextlib.closing(Server(stage, [], host="0.0.0.0", port=18095)) as public:
        socket.create_connection(("127.0.0.2", 18095), timeout=60.0).close()
        assert public.address == f"http://{socket.gethostname()}:18095"


@pytest.mark.parametrize("host", ["192.0.2.1", "no.such.host.invalid", ""])
def test_a_host_that_is_not_this_machine_is_refused(host):
    with pytest.raises(InputError, match=f"--host: found {host}; accepted: an address of this machine"):
        check_host(host)
