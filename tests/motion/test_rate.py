"""What a file says of its rate, and of its frames' seconds, against the rate that it is read at."""

import numpy as np
import pytest
from motion_cases import refusal, waving
from motion_files import ROOT, clean_rows, write_pickle

from forgetmimic_jax.motion.readers import read_motion
from forgetmimic_jax.motion.recording import Reading


@pytest.fixture
def clip(robot):
    """40 frames at 50 Hz of a robot that walks."""
    return waving(robot, "wave", 40)


def with_columns(path, robot, clip, columns):
    """A CSV with a header, and further columns [frame] by name before the others."""
    rows = np.concatenate([np.stack(list(columns.values()), axis=-1), clean_rows(clip)], axis=1)
    header = ",".join([*columns, *ROOT, *robot.joint_names])
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.9f")
    return path


def npz(path, robot, clip, **fields):
    """An NPZ with names, velocities and the root's body."""
    content = {
        "fps": 50,
        "joint_names": np.array(robot.joint_names),
        "joint_pos": clip.joint_pos,
        "joint_vel": np.gradient(clip.joint_pos, 1 / 50, axis=0),
        "body_pos_w": clip.root_pos[:, None],
        "body_quat_w": clip.root_quat[:, None],
    }
    np.savez(path, **content | fields)
    return path


@pytest.mark.parametrize("name", ["time", "t", "timestamp", "Time (s)"])
def test_a_clock_against_the_flag(robot, clip, tmp_path, name):
    path = with_columns(tmp_path / "a.csv", robot, clip, {name: np.arange(40) / 50})
    text = refusal(robot, path, fps=25.0)
    assert f"column {name.lower()}: --fps is 25, but the file says 50; accepted: 50, or no --fps" in text
    assert read_motion(robot, path, Reading(fps=50.0)).clip.fps == 50.0


@pytest.mark.parametrize("step", [1.0, 20.0, 16.7])
def test_a_counter_or_a_clock_in_ms_gives_no_rate(robot, clip, tmp_path, step):
    path = with_columns(tmp_path / "a.csv", robot, clip, {"time": step * np.arange(40)})
    assert "the file does not say its rate" in refusal(robot, path)
    assert read_motion(robot, path, Reading(fps=50.0)).clip.fps == 50.0


def test_a_clock_of_few_decimals_gives_the_rate(robot, clip, tmp_path):
    """60 Hz in hundredths of a second: steps of 0.01 and 0.02."""
    path = with_columns(tmp_path / "a.csv", robot, clip, {"time": np.round(np.arange(40) / 60, 2)})
    found = read_motion(robot, path, Reading())
    assert found.clip.fps == pytest.approx(60.0, rel=0.02)
    assert not any("leaps" in note for note in found.notes)


@pytest.mark.parametrize(
    ("options", "said"),
    [({}, "leaps by 3.02 s, not 0.020 s, to frame 30 (0.60 s)"), ({"end": 0.58}, None), ({"start": 0.1}, "frame 30 (")],
)
def test_a_gap_in_the_clock_is_said_with_frame_and_second(robot, clip, tmp_path, options, said):
    clock = np.arange(40) / 50 + np.where(np.arange(40) < 30, 0.0, 3.0)
    found = read_motion(robot, with_columns(tmp_path / "a.csv", robot, clip, {"time": clock}), Reading(**options))
    assert found.clip.fps == 50.0
    leaps = [note for note in found.notes if "clock leaps" in note]
    assert leaps == [] if said is None else said in leaps[0]


@pytest.mark.parametrize("suffix", ["_vel", "_velocity"])
def test_velocity_columns_tell_the_rate(robot, clip, tmp_path, suffix):
    """Of the legs' joints alone: what has no velocity is not compared."""
    velocities = np.gradient(clip.joint_pos, 1 / 50, axis=0)
    columns = {f"{joint}{suffix}": velocities[:, place] for place, joint in enumerate(robot.joint_names[:12])}
    path = with_columns(tmp_path / "a.csv", robot, clip, columns)
    assert "rate: joint_vel fits 50.0 frames per s" in read_motion(robot, path, Reading(fps=50.0)).notes
    assert "read at 25, but joint_vel fits 50 frames per s; give --fps 50" in refusal(robot, path, fps=25.0)


@pytest.mark.parametrize("kind", ["pickle", "qpos", "zero_vel"])
def test_the_file_s_own_rate_against_the_flag_where_velocities_tell_nothing(robot, clip, tmp_path, kind):
    if kind == "pickle":
        root = {"root_pos": clip.root_pos, "root_rot": clean_rows(clip)[:, 3:7]}
        path = write_pickle(tmp_path / "a.pkl", {"fps": 50, **root, "dof_pos": clip.joint_pos})
    elif kind == "qpos":
        path = tmp_path / "a.npz"
        np.savez(path, fps=50, qpos=np.concatenate([clip.root_pos, clip.root_quat, clip.joint_pos], axis=1))
    else:
        path = npz(tmp_path / "a.npz", robot, clip, joint_vel=np.zeros_like(clip.joint_pos))
        notes = read_motion(robot, path, Reading()).notes
        assert "rate: unchecked (joint_vel is zero or NaN in every frame)" in notes
    assert "fps: --fps is 25, but the file says 50; accepted: 50, or no --fps" in refusal(robot, path, fps=25.0)
    assert read_motion(robot, path, Reading(fps=50.0)).clip.fps == 50.0


def test_velocities_outrank_the_file_s_own_rate(robot, clip, tmp_path):
    path = npz(tmp_path / "a.npz", robot, clip, fps=25)
    assert refusal(robot, path).endswith("read at 25, but joint_vel fits 50 frames per s; give --fps 50")
    assert read_motion(robot, path, Reading(fps=50.0)).clip.fps == 50.0


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_velocity_that_is_not_finite_does_not_end_the_comparison(robot, clip, tmp_path, value):
    velocities = np.gradient(clip.joint_pos, 1 / 50, axis=0)
    velocities[3, 3] = value
    path = npz(tmp_path / "a.npz", robot, clip, fps=25, joint_vel=velocities)
    assert "joint_vel fits 50 frames per s" in refusal(robot, path)
    assert "rate: joint_vel fits 50.0 frames per s" in read_motion(robot, path, Reading(fps=50.0)).notes
