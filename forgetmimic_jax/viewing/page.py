"""A web page to play with policies: robots side by side on moving floors, their reference, controls and live plots."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence

import mujoco
import numpy as np
import numpy.typing as npt
import viser
from scipy.spatial.transform import Rotation

from forgetmimic_jax.robot.model import relative_height
from forgetmimic_jax.viewing.playback import Playback
from forgetmimic_jax.viewing.shapes import UNIT_MESHES, Shapes
from forgetmimic_jax.viewing.takes import facing, in_words

PICTURES_PER_SECOND, PLOTS_PER_SECOND = 25.0, 5.0
LANE = (2.6, 2.0)  # length and width of a robot's piece of floor, m; the robot stays in its middle
LANE_GAP, LINE_SPACING = 0.2, 0.5  # m
LABEL_HEIGHT = 1.62  # m above the floor, over the head of the G1
GHOST_OPACITY, GHOST_SHARE, GHOST_TINT = 0.3, 0.5, np.array([64, 166, 115])
GHOST_REACH = 1.2  # m from the robot, beyond which the reference is hidden: it would stand on another's floor
FLOOR, LINE, RED = (205, 211, 219), (168, 177, 189), (214, 30, 40)
CURVES = ("#1f77b4", "#ff7f0e", "#9467bd", "#8c564b", "#17becf")  # a policy each
REFERENCE_CURVE = "#2ca02c"


class Page:
    """What one browser shows, and what its visitor does. Simulation and drawing happen on the caller's thread."""

    def __init__(
        self,
        client: viser.ClientHandle | viser.ViserServer,
        playback: Playback,
        drawn: Mapping[str, Shapes],
        targets: Sequence[str],
    ):
        """Fill the page.

        Args:
            client: the browser; a server stands for all of its browsers.
            playback: what the page shows.
            drawn: the robot's shapes to be seen.
            targets: clips to forget.
        """
        self._client, self._playback, self._policies = client, playback, playback.policies
        self._model, self._data = playback.robot.model, mujoco.MjData(playback.robot.model)
        self._todo: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()  # what the page's visitor wants done
        self._random = np.random.default_rng()
        self._playing, self._due = True, time.monotonic()
        clips = playback.clips
        self._targets = {clips.index(target) for target in targets}
        self._menu = {f"{clip} (to be forgotten)" if clip in targets else clip: i for i, clip in enumerate(clips)}
        self._build_scene(drawn)
        self._build_controls()
        self._show(plots=True)

    def run(self, gone: threading.Event, turn: threading.Lock) -> None:
        """Play in real time until the browser is gone; it simulates while it has `turn`."""
        shown = plotted = 0.0
        while not gone.is_set():
            with turn:
                changed = self._obey()
            now = time.monotonic()
            if self._playing and now >= self._due:
                with turn:
                    self._advance()
                self._due += self._playback.control_step / self._speed.value
                self._due = max(self._due, now - 0.1)  # too slow a machine plays slowly, and does not catch up in leaps
                changed = True
            if changed and (not self._playing or now - shown >= 1.0 / PICTURES_PER_SECOND):
                plots = now - plotted >= 1.0 / PLOTS_PER_SECOND or not self._playing
                self._show(plots)
                shown, plotted = now, now if plots else plotted
            time.sleep(max(0.0, min(self._due - time.monotonic(), 0.02)) if self._playing else 0.02)

    def _advance(self) -> None:
        if not self._playback.done:
            self._playback.advance()
        elif self._repeat.value:
            self._playback.begin(self._playback.clip)

    def _obey(self) -> bool:
        """Do what the visitor wanted since the last time; whether there was anything."""
        busy = not self._todo.empty()
        while not self._todo.empty():
            self._todo.get()()
        return busy

    # The scene

    def _build_scene(self, robot: Mapping[str, Shapes]) -> None:
        scene = self._client.scene
        size = relative_height(self._model)
        middle, apart, height = (len(self._policies) - 1) / 2.0, LANE[1] + LANE_GAP, LABEL_HEIGHT * size
        self._lanes = [_Lane(scene, name, robot, (i - middle) * apart, height) for i, name in enumerate(self._policies)]

    def _show(self, plots: bool) -> None:
        playback = self._playback
        heading = facing(playback.start)
        reference = self._poses(playback.reference)
        with self._client.atomic():
            for policy, (lane, qpos) in enumerate(zip(self._lanes, playback.qpos, strict=True)):
                shown = reference if self._ghost.value else None
                lane.show(qpos, self._poses(qpos), shown, playback.reference, heading)
                lane.tell(*self._in_words(policy), fell=playback.fell[policy] is not None)
            if plots:
                self._show_plots()
        self._client.flush()

    def _in_words(self, policy: int) -> tuple[str, str]:
        playback = self._playback
        ended, fell = playback.ended[policy], playback.fell[policy]
        return in_words(
            self._policies[policy],
            target=playback.clip in self._targets,
            ended=None if ended is None else ended * playback.control_step,
            fell=None if fell is None else fell * playback.control_step,
            now=playback.step * playback.control_step,
            impact=float(playback.impact[policy]),
        )

    def _poses(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Every body's position [body, 3] and orientation [body, 4]."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        return self._data.xpos.copy(), self._data.xquat.copy()

    # The controls and plots

    def _build_controls(self) -> None:
        gui, playback = self._client.gui, self._playback
        names = list(self._menu)
        menu = gui.add_dropdown("Clip", names, initial_value=names[playback.clip])
        keys = gui.add_button_group("Time", ("Play", "Pause", "Step", "Restart"), hint="a step is one control step")
        self._speed = gui.add_slider("Speed", 0.1, 2.0, 0.1, 1.0, hint="1 is real time")
        strength = gui.add_slider("Push (m/s)", 0.2, 3.0, 0.2, 1.0, hint="what a push adds to the pelvis's velocity")
        shove = gui.add_button("Push", hint="the same for every robot, in a random direction")
        self._ghost = gui.add_checkbox("Show the reference", True)
        self._repeat = gui.add_checkbox("Repeat", True)
        self._status = gui.add_markdown("")
        empty = np.zeros(1)
        curves = [
            viser.uplot.Series(label=name, stroke=colour, width=2)
            for name, colour in zip(self._policies, CURVES, strict=False)
        ]
        time_axis = viser.uplot.Series(label="s")
        self._tracking_plot = gui.add_uplot(
            (empty,) * (1 + len(curves)),
            (time_axis, *curves),
            title="Tracking reward",
            scales={"x": {"time": False}, "y": {"range": (0.0, 1.05)}},
            height=180,
        )
        self._height_plot = gui.add_uplot(
            (empty,) * (2 + len(curves)),
            (time_axis, *curves, viser.uplot.Series(label="reference", stroke=REFERENCE_CURVE, width=1)),
            title="Height of the pelvis (m)",
            scales={"x": {"time": False}, "y": {"range": (0.0, 1.2)}},
            height=180,
        )

        menu.on_update(self._ask(lambda: playback.begin(self._menu[menu.value])))
        actions: dict[str, Callable[[], None]] = {
            "Play": lambda: self._set_playing(True),
            "Pause": lambda: self._set_playing(False),
            "Step": self._single_step,
            "Restart": lambda: playback.begin(playback.clip),
        }
        keys.on_click(lambda event: self._todo.put(actions[event.target.value]))
        shove.on_click(self._ask(lambda: self._push(strength.value)))
        self._ghost.on_update(self._ask(lambda: None))

    def _ask(self, action: Callable[[], None]) -> Callable[[object], None]:
        """A handler that leaves `action` to the thread that simulates."""
        return lambda _event: self._todo.put(action)

    def _set_playing(self, playing: bool) -> None:
        self._playing, self._due = playing, time.monotonic()

    def _single_step(self) -> None:
        self._set_playing(False)
        self._playback.advance()

    def _push(self, speed: float) -> None:
        angle = self._random.uniform(0.0, 2.0 * np.pi)
        self._playback.push(speed * np.array([np.cos(angle), np.sin(angle), 0.0]))

    def _show_plots(self) -> None:
        playback = self._playback
        now = playback.step * playback.control_step
        whole = playback.last_step * playback.control_step
        lines = [
            f"{now:.2f} of {whole:.2f} s. Mean tracking reward, 0 once a bound is broken, and what the robot does:"
        ]
        tracking = np.array(playback.tracking).reshape(-1, len(self._policies))
        for policy, name in enumerate(self._policies):
            mean = f"{tracking[: playback.horizon, policy].mean():.2f}" if playback.step else "–"
            lines.append(f"- {name}: " + ", ".join(filter(None, [f"**{mean}**", *self._in_words(policy)])))
        self._status.content = "\n".join(lines)
        times = np.arange(playback.step + 1) * playback.control_step
        if playback.step:
            self._tracking_plot.data = _columns(times[1:], tracking)
        self._height_plot.data = _columns(times, np.array(playback.height))


class _Lane:
    """One policy's piece of floor with its robot in the middle, whose ways the lines on the floor show."""

    def __init__(self, scene: viser.SceneApi, name: str, robot: Mapping[str, Shapes], y: float, height: float):
        root = f"/{name}"
        length, width = LANE
        scene.add_frame(root, show_axes=False, position=(0.0, y, 0.0))
        scene.add_grid(
            f"{root}/floor",
            length,
            width,
            cell_thickness=0.0,
            section_thickness=0.0,
            plane_color=FLOOR,
            plane_opacity=1.0,
            shadow_opacity=0.35,
        )
        self._across = scene.add_line_segments(f"{root}/across", _lines(length, width), LINE, thickness=0.008)
        along = _lines(width, length)[..., [1, 0, 2]]
        self._along = scene.add_line_segments(f"{root}/along", along, LINE, thickness=0.008)
        corners = np.array([[x, y, 0.01] for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1))]) * [length / 2, width / 2, 1]
        border = np.stack([corners, np.roll(corners, 1, axis=0)], axis=1)
        self._alarm = scene.add_line_segments(f"{root}/alarm", border, RED, thickness=0.05, visible=False)
        self._label = scene.add_label(
            f"{root}/label", name, position=(0.0, 0.0, height), anchor="bottom-center", font_screen_scale=1.4
        )
        self._name = name
        self._world = scene.add_frame(f"{root}/world", show_axes=False)
        self._robot = _Figure(scene, f"{root}/world/robot", robot)
        self._ghost = _Figure(scene, f"{root}/world/reference", robot, ghost=True)

    def show(
        self,
        qpos: np.ndarray,
        poses: tuple[np.ndarray, np.ndarray],
        ghost: tuple[np.ndarray, np.ndarray] | None,
        reference: np.ndarray,
        heading: float,
    ) -> None:
        """Move everything.

        Args:
            qpos: [nq] of the robot.
            poses: its bodies' positions and orientations.
            ghost: those of the reference; None: not to be seen.
            reference: [nq] of the reference.
            heading: yaw that is turned towards the viewer, rad.
        """
        turn = Rotation.from_euler("z", -heading)
        centre = turn.apply([*qpos[:2], 0.0])
        self._world.wxyz = turn.as_quat(scalar_first=True)
        self._world.position = -centre
        self._across.position = (-centre[0] % LINE_SPACING, 0.0, 0.0)
        self._along.position = (0.0, -centre[1] % LINE_SPACING, 0.0)
        self._robot.show(poses)
        near = ghost is not None and bool(np.linalg.norm(reference[:2] - qpos[:2]) < GHOST_REACH)
        self._ghost.visible(near)
        if near and ghost is not None:
            self._ghost.show(ghost)

    def tell(self, follows: str, stands: str, *, fell: bool) -> None:
        """Write what has become of the episode over the robot, once there is something to say; a fall is framed red."""
        self._alarm.visible = fell
        said = ", ".join(filter(None, [follows, stands])) if follows or fell else ""
        self._label.text = f"{self._name}: {said}" if said else self._name


class _Figure:
    """A robot's shapes, all of a kind moved at once."""

    def __init__(self, scene: viser.SceneApi, root: str, robot: Mapping[str, Shapes], *, ghost: bool = False):
        self._root = scene.add_frame(root, show_axes=False)
        self._kinds = []
        for kind, found in robot.items():
            colours = GHOST_SHARE * found.colour + (1.0 - GHOST_SHARE) * GHOST_TINT if ghost else found.colour
            meshes = scene.add_batched_meshes_simple(
                f"{root}/{kind}",
                np.asarray(UNIT_MESHES[kind].vertices),
                UNIT_MESHES[kind].faces,
                found.rotation.as_quat(scalar_first=True),
                found.position,
                batched_scales=found.half_size,
                batched_colors=np.asarray(colours, np.uint8),
                lod="off",
                opacity=GHOST_OPACITY if ghost else None,
                cast_shadow=not ghost,
                receive_shadow=not ghost,
            )
            self._kinds.append((found, meshes))

    def show(self, poses: tuple[np.ndarray, np.ndarray]) -> None:
        """Move everything to where the bodies' positions [body, 3] and orientations [body, 4] have it."""
        for found, meshes in self._kinds:
            positions, orientations = found.placed(*poses)
            meshes.batched_positions = positions.astype(np.float32)
            meshes.batched_wxyzs = orientations.astype(np.float32)

    def visible(self, visible: bool) -> None:
        """Show or hide the whole figure."""
        self._root.visible = visible


def _columns(times: np.ndarray, curves: np.ndarray) -> tuple[npt.NDArray[np.float64], ...]:
    """Times [step] and curves [step, curve] as a plot takes them."""
    return tuple(np.asarray(column, np.float64) for column in (times, *curves.T))


def _lines(length: float, width: float) -> np.ndarray:
    """Lines [line, 2, 3] over a floor's width, LINE_SPACING apart; moved on by less than that they stay on it."""
    x = np.arange(-length / 2.0, length / 2.0 - LINE_SPACING / 2.0, LINE_SPACING)
    return np.stack(
        [np.stack([x, np.full_like(x, y), np.full_like(x, 0.001)], axis=-1) for y in (-width / 2, width / 2)], 1
    )
