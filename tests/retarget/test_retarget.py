"""DeepMimic's clips: read to known numbers, retargeted to what the shipped ones are."""

import json
import subprocess
import sys

import numpy as np
import pytest

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion import library
from forgetmimic_jax.motion.clip import read_clip
from forgetmimic_jax.retarget import recipe
from forgetmimic_jax.retarget.deepmimic import forward_kinematics, read_deepmimic


def frame(duration=0.1, height=0.9):
    """44 numbers: standing upright, arms down."""
    unit = [1.0, 0.0, 0.0, 0.0]
    limbs = [*unit, 0.0, *unit, *unit, 0.0]
    return [duration, 0.0, height, 0.0, *unit, *unit, *unit, *limbs, *limbs]


def write(path, frames, loop="none"):
    path.write_text(json.dumps({"Loop": loop, "Frames": frames}))
    return path


def test_a_standing_human(tmp_path):
    """Hip to sole is 0.421546 + 0.40987 + 0.05 m; the left arm hangs 0.18311 m to the left."""
    pose = forward_kinematics(read_deepmimic(write(tmp_path / "humanoid3d_stand.txt", [frame()] * 3)))
    np.testing.assert_allclose(pose.points["left_sole"][..., 2], 0.9 - 0.881416, atol=1e-9)
    np.testing.assert_allclose(pose.points["left_wrist"][0, :2], [-0.02405, 0.18311], atol=1e-9)
    np.testing.assert_allclose(pose.points["right_hip"][0], [0.0, -0.084887, 0.9], atol=1e-9)


def test_knees_flex_backwards_and_elbows_forwards(tmp_path):
    bent = frame()
    bent[20], bent[29] = -np.pi / 2, np.pi / 2  # right knee, right elbow
    points = forward_kinematics(read_deepmimic(write(tmp_path / "a.txt", [bent] * 2))).points
    np.testing.assert_allclose(points["right_ankle"][0] - points["right_knee"][0], [-0.40987, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(points["right_wrist"][0] - points["right_elbow"][0], [0.258947, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    ("name", "frames", "seconds", "cyclic"),
    [("walk", 39, 1.267, True), ("punch", 65, 2.133, False), ("spin", 107, 4.417, True)],
)
def test_real_clips_have_their_known_length(deepmimic, name, frames, seconds, cyclic):
    motion = read_deepmimic(recipe.source_file(deepmimic, name))
    assert (len(motion.times), motion.cyclic) == (frames, cyclic)
    assert motion.times[-1] == pytest.approx(seconds, abs=1e-3)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{", "JSON"),
        ("[]", "Frames"),
        ('{"Loop": "twice", "Frames": []}', "Loop"),
        ('{"Loop": "none", "Frames": [[1, 2]]}', "frame 0 holds 2 numbers"),
        ('{"Loop": "none", "Frames": []}', "at least 2"),
        (json.dumps({"Loop": "none", "Frames": [frame(), frame(height=float("nan"))]}), "frame 1"),
    ],
)
def test_files_that_are_no_clip(tmp_path, text, expected):
    path = tmp_path / "a.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=expected) as caught:
        read_deepmimic(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_source_is_refused_before_anything_is_written(robot, tmp_path):
    with pytest.raises(InputError, match=r"humanoid3d_walk\.txt"):
        recipe.retarget_library(robot, tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_unknown_clip_is_refused(robot, tmp_path):
    with pytest.raises(InputError, match="did you mean 'backflip'"):
        recipe.retarget_library(robot, tmp_path, tmp_path / "out", ["backfip"])


@pytest.mark.parametrize(("robot_name", "names"), [("g1", "run"), ("h2", "kick")])
def test_shipped_clips_are_made_again(deepmimic, tmp_path, robot_name, names):
    """A cyclic and a single one, by the command: what made the files is in the repository.

    To the bit on the same kind of processor; on another the fit ends beside it, and a run drifts by centimetres.
    """
    output = tmp_path / "again"
    command = [sys.executable, "-m", "forgetmimic_jax.motions", "--robot", robot_name, "retarget", "--clips", names]
    done = subprocess.run(
        [*command, "--source", deepmimic, "--output", output], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    shipped = library.DATA_DIR / robot_name
    again, entries = library.read_manifest(output)["clips"], library.read_manifest(shipped)["clips"]
    for name in names.split(","):
        found, made = (read_clip(folder / f"{name}.npz") for folder in (output, shipped))
        assert found.joint_pos.shape == made.joint_pos.shape
        assert np.abs(found.joint_pos - made.joint_pos).mean() < 0.02
        assert np.abs(found.root_pos - made.root_pos).mean() < 0.1
        changing = {"sha256", "direction_error_deg"}
        assert {k: v for k, v in again[name].items() if k not in changing} == {
            k: v for k, v in entries[name].items() if k not in changing
        }
        assert again[name]["direction_error_deg"] == pytest.approx(entries[name]["direction_error_deg"], abs=0.3)
