import io
import shutil
from pathlib import Path

import av
import pytest
from miniature import finished
from PIL import Image

from forgetmimic_jax import video
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.training.comparison import load_comparison
from forgetmimic_jax.viewing import film, offscreen


@pytest.fixture
def options(base_run):
    """Options that film the base in the working folder."""

    def options(**given) -> video.Options:
        return video.Options(**{"checkpoint": base_run.checkpoint(4), "output": Path("films")} | given)

    return options


def test_base_and_unlearned_policy_are_filmed_side_by_side(unlearned_run, tmp_path, monkeypatch):
    try:
        offscreen.check_rendering()
    except InputError as error:
        pytest.skip(str(error))
    monkeypatch.setattr(film, "PANE", (160, 160))
    output = tmp_path / "new" / "films"
    options = video.Options(
        checkpoint=unlearned_run.checkpoint(2), clips="turn, nod", seconds=0.12, stills=3, output=output
    )
    printed = finished(video.main, options).printed.splitlines()
    names = ["contact_sheet.png", "nod.gif", "nod.mp4", "turn.gif", "turn.mp4"]
    assert sorted(path.name for path in output.iterdir()) == names
    with av.open(io.BytesIO((output / "turn.mp4").read_bytes())) as container:
        pictures = list(container.decode(video=0))
    assert [(picture.width, picture.height) for picture in pictures] == [(2 * 160, 160 + film.HEADER)] * 4
    assert Image.open(output / "nod.gif").n_frames == 2
    width, height, gap = 160, (160 + film.HEADER) // 2, film.GAP
    assert Image.open(output / "contact_sheet.png").size == (3 * width + 2 * gap, 2 * height + gap)
    assert "base: tracking" in "".join(printed)
    assert [line.split()[:2] for line in printed if line.split()[:1] in (["turn"], ["nod"])] == [
        ["turn", "target"],
        ["nod", "kept"],
    ]
    assert printed[-1] == f"Next: make play ROBOT=g1 CHECKPOINT={unlearned_run.checkpoint(2)}"


def test_more_policies_are_beside_named_by_their_method_or_else_by_their_run(unlearned_run, base_run, tmp_path):
    path = unlearned_run.checkpoint(2)
    older = shutil.copytree(base_run.folder, tmp_path / "older") / "checkpoints" / path.with_name("00000004").name
    other = shutil.copytree(unlearned_run.folder, tmp_path / "other") / "checkpoints" / path.name

    def names(*beside: Path) -> list[str]:
        return list(load_comparison(path, robot="g1", beside=beside).policies)

    assert names() == ["base", "unlearned"]
    assert names(older) == ["base", "arft", "older"]
    assert names(other) == ["base", unlearned_run.folder.name, "other"]
    with pytest.raises(InputError, match="another policy is called 'base'; name checkpoints of different runs"):
        names(base_run.checkpoint(4))
    with pytest.raises(InputError, match="another policy is called 'unlearned'"):
        names(path)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"robot": "gg1", "checkpoint": None}, "robot 'gg1': no robots/gg1/gg1.yaml; did you mean 'g1'?"),
        ({"checkpoint": Path("nowhere")}, "nowhere: no such checkpoint folder"),
        ({"clips": "trun"}, "--clips: no clip 'trun' in the library; did you mean 'turn'?"),
        ({"clips": " ,"}, "--clips: no clip named; leave the flag out for all of them"),
        ({"seconds": 0.0}, "--seconds: found 0; accepted: above 0"),
        ({"stills": 0}, "--stills: found 0; accepted: 1 or more"),
        ({"seed": -1}, "--seed: found -1; accepted: 0 or more"),
        ({"library": Path("nowhere")}, "nowhere/manifest.json: not found; a library is a folder with manifest.json"),
        ({"output": Path(__file__)}, f"{__file__}: {__file__} is a file; choose another --output"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(refused, options, given, message):
    assert refused(video.main, options(**given)) == message


def test_where_nothing_can_be_drawn_it_is_refused_before_anything_is_written(refused, options, monkeypatch):
    def nothing():
        raise InputError("rendering: nothing can be drawn here")

    monkeypatch.setattr(offscreen, "_backend", nothing)
    assert refused(video.main, options()) == "rendering: nothing can be drawn here"
