import io

import av
import numpy as np
import pytest
from PIL import Image

from forgetmimic_jax.viewing import film, offscreen
from forgetmimic_jax.viewing.takes import Episode, Take

RED = np.array(film.RED)


@pytest.fixture(scope="module")
def renderer(rendering):
    with film.pane_renderer("g1") as renderer:
        yield renderer


@pytest.fixture(scope="module")
def frames(renderer, episodes) -> list[np.ndarray]:
    """`turn` at 5 pictures a second: 41 steps at 50 Hz."""
    return list(film.render_clip(renderer, episodes[0], fps=5.0, seconds=0.8))


def standing(robot, *, ended: int | None = None, fell: int | None = None) -> Episode:
    """The default pose for a second, with the reference a metre to the left."""
    qpos = np.concatenate([[0, 0, robot.default_height, 1, 0, 0, 0], np.asarray(robot.arrays.default_joint_pos)])
    aside = qpos + np.eye(len(qpos))[1]
    take = Take(np.tile(qpos, (51, 1)), tracking_reward=np.full(50, 0.75), ended=ended, fell=fell, impact=np.zeros(50))
    return Episode(clip="stand", target=False, fps=50.0, reference=np.tile(aside, (51, 1)), takes={"base": take})


def test_a_frame_has_a_header_and_a_pane_a_policy(frames):
    assert len(frames) == 5
    width, height = film.PANE
    assert {frame.shape for frame in frames} == {(height + film.HEADER, 2 * width, 3)}
    # Both panes show the same start, but for the policy's name in the corner and the reward below.
    apart = []
    for frame in frames:
        left, right = np.split(frame[film.HEADER + 50 : -40].astype(int), 2, axis=1)
        apart.append(np.abs(left - right).mean())
    assert apart[0] < 1.0
    assert apart[-1] > 5.0 * apart[0]


def test_the_robot_is_shaped_and_stands_on_a_floor_with_a_shadow(renderer, robot):
    episode = standing(robot)
    qpos = episode.takes["base"].qpos[0]
    picture = renderer.picture(qpos, None, np.zeros(2), 215.0).astype(int)
    empty = renderer.picture(qpos + 50.0 * np.eye(len(qpos))[0], None, np.zeros(2), 215.0).astype(int)
    changed = np.abs(picture - empty).sum(-1) > 30
    rows, columns = np.nonzero(changed)
    assert 0.4 * film.PANE[1] < rows.max() - rows.min() < 0.95 * film.PANE[1]
    assert 0.2 * film.PANE[0] < columns.max() - columns.min() < 0.8 * film.PANE[0]
    brightness = picture[changed].mean(-1)
    assert (brightness > 200).mean() > 0.05, "the shell is light"
    assert (brightness < 60).mean() > 0.05, "the joints are dark"
    darker = empty.mean(-1) - picture.mean(-1)
    assert ((darker > 60) & (darker < 110)).sum() > 500, "a shadow on the floor"


def test_the_reference_is_a_translucent_ghost(renderer, robot):
    episode = standing(robot)
    qpos, aside = episode.takes["base"].qpos[0], episode.reference[0]
    with_ghost = renderer.picture(qpos, aside, np.zeros(2), 215.0).astype(int)
    alone = renderer.picture(qpos, None, np.zeros(2), 215.0).astype(int)
    greener = (with_ghost - alone)[..., 1] - (with_ghost - alone)[..., 0] > 10
    assert greener.sum() > 1000
    assert with_ghost[greener].mean() > 100, "the floor behind it shines through"


def test_the_ghost_casts_no_shadow_and_pales_as_it_gets_away(renderer, robot):
    qpos = standing(robot).takes["base"].qpos[0]
    alone = renderer.picture(qpos, None, np.zeros(2), 215.0).astype(int)

    def seen(apart: float) -> np.ndarray:
        reference = qpos + apart * np.eye(len(qpos))[1]
        return np.abs(renderer.picture(qpos, reference, np.zeros(2), 215.0).astype(int) - alone).sum(-1)

    near, far, gone = (seen(offscreen.GHOST_FADE * share) for share in (0.9, 1.8, 2.1))
    assert near.max() > 2 * far.max() > 0
    assert gone.max() == 0


def test_the_empty_floor_has_no_specks(renderer, robot):
    away = standing(robot).takes["base"].qpos[0] + 50.0 * np.eye(7 + robot.num_joints)[0]
    for azimuth in (100.0, 215.0, 300.0):
        floor = renderer.picture(away, None, np.zeros(2), azimuth)[150:]
        assert floor.min() > 150, "as light as its tiles"


def test_a_red_frame_marks_a_fall_and_stays(renderer, robot):
    frames = list(film.render_clip(renderer, standing(robot, ended=10, fell=20), fps=5.0))
    framed = [bool((frame[film.HEADER, 2:-2] == RED).all() and (frame[-1, 2:-2] == RED).all()) for frame in frames]
    assert framed == [False, False, True, True, True, True]  # at 0, 0.2, ... 1.0 s


def test_whether_the_robot_stands_is_said_in_green_or_red_once_it_left_the_motion(renderer, robot):
    def chips(**ends: int) -> list[tuple[bool, bool]]:
        below = [
            frame[film.HEADER + 40 : film.HEADER + 65]
            for frame in film.render_clip(renderer, standing(robot, **ends), fps=5.0)
        ]
        return [
            tuple(
                bool((np.abs(part.astype(int) - colour).sum(-1) < 60).sum() > 500) for colour in (film.GREEN, film.RED)
            )
            for part in below
        ]

    assert chips() == [(False, False)] * 6
    assert chips(ended=30) == [(False, False)] * 3 + [(True, False)] * 3
    assert chips(ended=10, fell=30) == [(False, False), *[(True, False)] * 2, *[(False, True)] * 3]


def test_a_film_is_h264_of_the_frames_size_rate_and_number(frames):
    with av.open(io.BytesIO(film.mp4(frames, fps=5.0))) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.average_rate == 5
        decoded = [picture.to_ndarray(format="rgb24") for picture in container.decode(stream)]
    assert len(decoded) == len(frames)
    for film_frame, frame in zip(decoded, frames, strict=True):
        assert np.abs(film_frame.astype(int) - frame).mean() < 6.0


def test_a_gif_is_thinned_and_shrunk_and_keeps_time(frames):
    image = Image.open(io.BytesIO(film.gif(frames, fps=5.0)))
    assert image.n_frames == 3
    assert image.size == (frames[0].shape[1] // 2, frames[0].shape[0] // 2)
    assert image.info["duration"] == 400  # ms
    assert np.abs(np.asarray(image.convert("RGB"), int) - Image.fromarray(frames[0]).reduce(2)).mean() < 12.0


def test_a_contact_sheet_has_a_row_a_clip(frames):
    row = film.stills(frames, 3)
    for still, index in zip(row, (0, 2, 4), strict=True):
        np.testing.assert_array_equal(still, np.asarray(Image.fromarray(frames[index]).reduce(2)))
    sheet = np.asarray(Image.open(io.BytesIO(film.contact_sheet([row, row[::-1]]))))
    height, width = frames[0].shape[0] // 2, frames[0].shape[1] // 2
    gap = film.GAP
    assert sheet.shape == (2 * height + gap, 3 * width + 2 * gap, 3)
    np.testing.assert_array_equal(sheet[height + gap :, :width], row[2])
    assert (sheet[:, width : width + gap] == 255).all()


def test_a_film_ends_with_its_episode_or_sooner(robot):
    steps = film.shown_steps
    assert list(steps(standing(robot), fps=10.0)) == list(range(0, 51, 5))
    assert steps(standing(robot), fps=50.0, seconds=0.5)[-1] == 25
    assert steps(standing(robot, ended=20, fell=30), fps=50.0)[-1] == 50, "a robot that fell is shown, too"


def test_a_robot_without_shapes_to_be_seen_is_drawn_by_those_it_collides_with(robot, monkeypatch):
    spec = robot.spec.copy()  # from which the shapes to be seen were left out
    monkeypatch.setattr(offscreen, "read_spec", lambda name: spec)
    model = offscreen.drawing_model("g1", 64, 64)
    assert model.ngeom == robot.model.ngeom
    assert sorted(set(model.geom_group)) == [0, offscreen.VISUAL_GROUP]


def test_where_nothing_can_be_drawn_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr(offscreen.platform, "system", lambda: "Linux")
    monkeypatch.setattr(offscreen, "chosen_library", lambda: "")
    monkeypatch.setattr(offscreen.sys, "executable", "/bin/false")
    offscreen._backend.cache_clear()
    try:
        with pytest.raises(offscreen.InputError) as error:
            offscreen.check_rendering()
    finally:
        offscreen._backend.cache_clear()
    message = str(error.value)
    assert message.startswith("rendering: egl and osmesa cannot draw here without a screen; install")
    assert "\n" not in message
