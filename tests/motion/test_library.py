"""Clip files, manifests and the padded arrays."""

import dataclasses
import errno
import json
import re
import zipfile

import jax
import numpy as np
import pytest
from damaged import ARCHIVES, ARRAYS
from motion_cases import waving

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion import library
from forgetmimic_jax.motion.clip import Clip, read_clip, write_clip
from forgetmimic_jax.motion.fit import check_touches, fit, lowest_points, on_floor


@pytest.fixture
def clip(robot) -> Clip:
    return waving(robot, "sway", 40)


@pytest.fixture
def folder(robot, clip, tmp_path):
    """A library with the clips `sway`, 40 frames, and `turn`, 25."""
    path = tmp_path / "library"
    library.add_clip(path, robot, clip, {"source": "invented"})
    library.add_clip(path, robot, waving(robot, "turn", 25, yaw_rate=1.0), {"source": "invented"})
    return path


def test_a_clip_s_file_is_the_same_bytes_every_time(clip, tmp_path):
    write_clip(clip, tmp_path / "a.npz")
    write_clip(clip, tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "b.npz"]  # no temporary file is left


def test_a_clip_survives_its_file_to_1e_5(clip, tmp_path):
    write_clip(clip, tmp_path / "sway.npz")
    found = read_clip(tmp_path / "sway.npz")
    assert (found.name, found.fps, found.joint_names) == (clip.name, clip.fps, clip.joint_names)
    for field in ("root_pos", "root_quat", "joint_pos"):
        np.testing.assert_allclose(getattr(found, field), getattr(clip, field), atol=1.1e-5)


def test_clips_stand_one_after_the_other(robot, folder):
    loaded = library.load_library(robot, folder)
    assert loaded.names == ("sway", "turn")
    assert (loaded.start.tolist(), loaded.length.tolist()) == ([0, 40], [40, 25])
    assert loaded.frames.joint_pos.shape == (65, robot.num_joints)
    assert loaded.frames.bodies.pos.shape == (65, len(robot.key_bodies), 3)
    for values, turn in zip(jax.tree.leaves(loaded.frames), jax.tree.leaves(loaded.clip(1)), strict=True):
        np.testing.assert_array_equal(turn, values[40:])


def test_past_a_clip_s_end_follows_its_last_frame_and_not_the_next_clip(robot, folder):
    loaded = library.load_library(robot, folder)
    clips, frames = np.array([0, 0, 0, 1, 1, 1]), np.array([3, 39, 41, 0, 24, 30])
    shown = loaded.at(clips, frames)
    for values, found in zip(jax.tree.leaves(loaded.frames), jax.tree.leaves(shown), strict=True):
        np.testing.assert_array_equal(found, values[np.array([3, 39, 39, 40, 64, 64])])


def test_no_velocity_is_taken_across_clips(robot, folder):
    """Alone or beside another clip, a clip's arrays are the same."""
    alone = library.load_library(robot, folder, ["turn"])
    beside = library.load_library(robot, folder)
    np.testing.assert_array_equal(alone.clip(0).bodies.lin_vel, beside.clip(1).bodies.lin_vel)


def test_clips_are_loaded_in_the_given_order(robot, folder):
    assert library.load_library(robot, folder, ["turn", "sway"]).names == ("turn", "sway")


def test_a_changed_file_is_noticed(robot, clip, folder):
    write_clip(dataclasses.replace(clip, root_pos=clip.root_pos + 0.01), folder / "sway.npz")
    with pytest.raises(InputError, match="sha256"):
        library.load_library(robot, folder)


def test_a_missing_file_is_noticed(robot, folder):
    (folder / "turn.npz").unlink()
    with pytest.raises(InputError, match=r"turn\.npz: not found, though the manifest lists it"):
        library.load_library(robot, folder)


def test_the_library_s_hash_depends_on_content_alone(robot, clip, folder):
    before = library.library_hash(folder)
    manifest = library.read_manifest(folder)
    manifest["clips"]["sway"]["source"] = "elsewhere"
    library.write_manifest(folder, manifest)
    assert library.library_hash(folder) == before
    library.add_clip(folder, robot, dataclasses.replace(clip, name="more"), {})
    assert library.library_hash(folder) != before


def test_errors_of_a_library(robot, clip, folder, tmp_path):
    with pytest.raises(InputError, match="did you mean 'sway'"):
        library.load_library(robot, folder, ["swai"])
    with pytest.raises(InputError, match="not found"):
        library.load_library(robot, tmp_path / "none")
    with pytest.raises(InputError, match=r"already has a clip 'sway'.*--force"):
        library.add_clip(folder, robot, clip, {})
    library.add_clip(folder, robot, clip, {}, overwrite=True)
    for name in ("", "../sway", "a b", ".hidden", "a/b"):
        with pytest.raises(InputError, match="name"):
            library.add_clip(folder, robot, dataclasses.replace(clip, name=name), {})
    with pytest.raises(InputError, match="fps"):
        library.add_clip(folder, robot, dataclasses.replace(clip, name="x", fps=30.0), {})
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(InputError, match=r"manifest\.json"):
        library.add_clip(tmp_path / "mine", robot, clip, {})
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["letter.txt"]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"robot": "h2"}, "robot"),
        ({"schema": 99}, "schema"),
        ({"clips": {}}, "empty"),
    ],
)
def test_errors_of_a_manifest(robot, folder, change, expected):
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps({**manifest, **change}))
    with pytest.raises(InputError, match=expected):
        library.load_library(robot, folder)


def test_a_broken_manifest_is_one_line(robot, folder):
    (folder / "manifest.json").write_text("{")
    with pytest.raises(InputError, match="not JSON"):
        library.load_library(robot, folder)


def test_a_clip_with_other_joints_is_refused(robot, clip, folder):
    other = dataclasses.replace(clip, joint_names=("knee", *clip.joint_names[1:]))
    with pytest.raises(InputError, match="unknown: knee"):
        library.add_clip(folder, robot, other, {}, overwrite=True)


def test_fit_resamples_and_keeps_the_limits(robot, clip):
    joints = clip.joint_pos.copy()
    joints[:, 3] = robot.joint_upper[3] + 0.3
    found = fit(robot, dataclasses.replace(clip, fps=25.0, joint_pos=joints), 50.0)
    assert (found.fps, found.num_frames) == (50.0, 79)  # 0 to 39 / 25 s, both included
    np.testing.assert_allclose(found.root_pos[2], clip.root_pos[1])
    assert (found.joint_pos[:, 3] == robot.joint_upper[3]).all()


def test_on_floor_lowers_a_robot_that_hovers(robot, clip):
    """The default pose stands at its default height; 7 cm higher, it is set back by 7 cm."""
    still = dataclasses.replace(
        clip,
        root_pos=np.tile([0.0, 0.0, robot.default_height], (40, 1)),
        root_quat=np.tile([1.0, 0.0, 0.0, 0.0], (40, 1)),
        joint_pos=np.tile(np.asarray(robot.arrays.default_joint_pos, np.float64), (40, 1)),
    )
    standing, _ = on_floor(robot, still)
    hovering, raised = on_floor(
        robot, dataclasses.replace(standing, root_pos=standing.root_pos + np.array([0.0, 0.0, 0.07]))
    )
    assert raised == pytest.approx(-0.07, abs=1e-9)
    np.testing.assert_allclose(hovering.root_pos, standing.root_pos)
    assert standing.root_pos[0, 2] == pytest.approx(robot.default_height, abs=0.02)


def test_one_frame_never_moves_a_clip(robot, clip):
    """A frame 10 cm lower than the others, and one 20 cm higher: the shift stays 0. What lies lower for 0.5 s moves it:
    the lowest may be 1.5 cm deep."""
    still = dataclasses.replace(
        clip,
        root_pos=np.tile([0.0, 0.0, robot.default_height], (100, 1)),
        root_quat=np.tile([1.0, 0.0, 0.0, 0.0], (100, 1)),
        joint_pos=np.tile(np.asarray(robot.arrays.default_joint_pos, np.float64), (100, 1)),
    )
    standing, _ = on_floor(robot, still)
    for frames, change, expected in (
        (1, -0.1, 0.0),
        (1, 0.2, 0.0),
        (3, -0.1, 0.0),
        (12, -0.1, 0.085),
        (100, -0.1, 0.1),
    ):
        root_pos = standing.root_pos.copy()
        root_pos[40 : 40 + frames if frames < 100 else None, 2] += change
        root_pos[:40, 2] += change if frames == 100 else 0.0
        assert on_floor(robot, dataclasses.replace(standing, root_pos=root_pos))[1] == pytest.approx(expected, abs=1e-9)


def test_a_clip_far_from_the_ground_is_refused(robot, clip):
    standing, _ = on_floor(robot, clip)
    for height in (-0.35, 0.35):
        with pytest.raises(InputError, match=f"{height:.2f} m from the ground; at most 0.3 m"):
            on_floor(robot, dataclasses.replace(standing, root_pos=standing.root_pos + np.array([0.0, 0.0, height])))
    lowest = lowest_points(robot, standing)
    check_touches(standing, lowest)
    with pytest.raises(InputError, match="never touches the ground"):
        check_touches(standing, lowest + 0.08)


def test_a_clip_that_could_not_be_written_can_be_added_again(robot, clip, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr(library, "file_hash", full)  # after the clip's file, before its entry
        with pytest.raises(OSError, match="space"):
            library.add_clip(tmp_path / "new", robot, clip, {})
    library.add_clip(tmp_path / "new", robot, clip, {})
    assert library.load_library(robot, tmp_path / "new").names == (clip.name,)


@pytest.mark.parametrize(
    ("field", "value", "found"),
    [
        ("fps", np.array([50.0, 60.0]), "fps: found float64 of shape [2]; numbers in 0 dimensions are needed"),
        ("root_pos", np.array("far"), "root_pos: found str96 of shape []; numbers in 2 dimensions are needed"),
        ("joint_names", np.zeros(29), "joint_names: found float64 of shape [29]; text in 1 dimensions are needed"),
    ],
)
def test_a_field_of_another_kind_is_named(robot, folder, field, value, found):
    with np.load(folder / "sway.npz") as archive:
        content = dict(archive)
    np.savez(folder / "sway.npz", **content | {field: value})
    with pytest.raises(InputError, match=re.escape(found)):
        read_clip(folder / "sway.npz")


def test_a_member_that_is_no_array_is_named(folder):
    with zipfile.ZipFile(folder / "sway.npz") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(folder / "sway.npz", "w") as archive:
        for name, content in members.items():
            archive.writestr(name, b"not an array" if name == "joint_pos.npy" else content)
    with pytest.raises(InputError, match=r"sway\.npz: joint_pos: found bytes96 of shape \[\]"):
        read_clip(folder / "sway.npz")


@pytest.mark.parametrize("damage", ARCHIVES + ARRAYS)
def test_a_clip_that_is_damaged_is_one_line(folder, damage):
    (folder / "sway.npz").write_bytes(damage(folder / "sway.npz"))
    with pytest.raises(InputError, match=rf"^{folder / 'sway.npz'}: not a readable clip NPZ \([^\n]*\)$"):
        read_clip(folder / "sway.npz")


@pytest.mark.parametrize(
    ("field", "code", "expected"),
    [
        ("joint_names", 0x7FFFFFFF, "not a readable clip NPZ"),
        ("root_quat", 0x7F800001, "root_quat: NaN or infinity"),  # a signalling NaN
        ("root_quat", 0x7F000000, "root_quat: norm 1.7e"),
    ],
)
def test_values_that_cannot_be_are_refused_without_a_warning(folder, recwarn, field, code, expected):
    with np.load(folder / "sway.npz") as archive:
        content = dict(archive)
    content[field].view(np.uint32).reshape(-1)[0] = code
    np.savez(folder / "sway.npz", **content)
    with pytest.raises(InputError, match=expected):
        read_clip(folder / "sway.npz")
    assert not recwarn.list
