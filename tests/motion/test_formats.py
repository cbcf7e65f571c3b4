"""Other projects' files by their own fields: columns by name, archives, pickles; and what is not to be read."""

import dataclasses

import numpy as np
import pytest
from motion_cases import refusal, waving
from motion_files import LESS, ROOT, clean_rows, write_pickle
from scipy.spatial.transform import Rotation

from forgetmimic_jax.motion.clip import write_clip
from forgetmimic_jax.motion.readers import read_motion
from forgetmimic_jax.motion.recording import Reading
from forgetmimic_jax.motion.text_table import read_table


@pytest.fixture
def clip(robot):
    """40 frames at 50 Hz of a robot that walks and turns."""
    return waving(robot, "wave", 40, yaw_rate=1.0)


def table(path, rows, header):
    np.savetxt(path, rows, delimiter=",", header=",".join(header), comments="", fmt="%.9f")
    return path


def assert_read(robot, path, clip, **options):
    found = read_motion(robot, path, Reading(**options))
    assert found.clip.fps == pytest.approx(clip.fps)
    np.testing.assert_allclose(found.clip.root_pos, clip.root_pos, atol=1e-7)
    np.testing.assert_allclose(found.clip.joint_pos, clip.joint_pos, atol=1e-7)
    np.testing.assert_allclose(np.abs(np.sum(found.clip.root_quat * clip.root_quat, axis=-1)), 1.0, atol=1e-9)
    return found.notes


def test_columns_by_name_in_any_order_with_a_clock(robot, clip, tmp_path):
    """A clock in s gives the rate; joints are named without `_joint`; what is no joint is left out and named."""
    clock = np.arange(40) / 50.0
    rows = np.concatenate([clean_rows(clip)[:, ::-1], clock[:, None], np.ones((40, 1))], axis=1)
    names = [*ROOT, *(joint.removesuffix("_joint") for joint in robot.joint_names)]
    notes = assert_read(robot, table(tmp_path / "a.csv", rows, [*names[::-1], "Time", "battery"]), clip)
    assert "columns that are no joint of the robot's are left out: battery" in notes


@pytest.mark.parametrize(
    "root",
    [
        ["root_x", "root_y", "root_z", "root_qx", "root_qy", "root_qz", "root_qw"],
        ["pos_x", "pos_y", "pos_z", "quat_x", "quat_y", "quat_z", "quat_w"],
        ["root_translateX", "root_translateY", "root_translateZ", "rot_x", "rot_y", "rot_z", "rot_w"],
        ["pelvis_pos.x", "pelvis_pos.y", "pelvis_pos.z", *(f"pelvis_quat.{axis}" for axis in "xyzw")],
    ],
)
def test_names_that_a_root_has(robot, clip, tmp_path, root):
    rows = np.concatenate([clean_rows(clip)[:, :7], clip.joint_pos], axis=1)
    assert_read(robot, table(tmp_path / "a.csv", rows, [*root, *robot.joint_names]), clip, fps=50.0)


def test_a_header_that_lacks_something(robot, clip, tmp_path):
    rows, names = clean_rows(clip), [*ROOT, *robot.joint_names]
    text = refusal(robot, table(tmp_path / "a.csv", rows[:, 1:], names[1:]), fps=50.0)
    assert "the root's columns are not found among y, z, qx" in text
    text = refusal(robot, table(tmp_path / "a.csv", rows[:, :-1], names[:-1]), fps=50.0)
    assert "missing: right_wrist_yaw_joint; unknown: none" in text
    assert "--fill-missing" in text
    text = refusal(robot, table(tmp_path / "a.csv", rows, [*names[:-1], "x"]), fps=50.0)
    assert "two columns are called x" in text
    text = refusal(robot, table(tmp_path / "a.csv", rows, [*names[:-1], "right_wrist_pitch_pos"]), fps=50.0)
    assert "twice: right_wrist_pitch_joint" in text
    (tmp_path / "a.csv").write_text(",".join(names) + "\n")
    assert "a header and no row of numbers" in refusal(robot, tmp_path / "a.csv", fps=50.0)
    euler = ["x", "y", "z", "root_rotateX", "root_rotateY", "root_rotateZ", *robot.joint_names]
    assert "Euler angles" in refusal(robot, table(tmp_path / "a.csv", rows[:, 1:], euler), fps=50.0)
    kept = [name for name in names if name.removesuffix("_joint") not in LESS]
    fewer = table(tmp_path / "a.csv", rows[:, [names.index(name) for name in kept]], kept)
    filled = read_motion(robot, fewer, Reading(fps=50.0, fill_missing=True)).clip
    waist = robot.joint_names.index("waist_roll_joint")
    np.testing.assert_allclose(filled.joint_pos[:, waist], 0.0)
    np.testing.assert_allclose(filled.joint_pos[:, 0], clip.joint_pos[:, 0], atol=1e-7)


@pytest.mark.parametrize("other", ["torso_joint", "left_ankle", "left_wrist_ptich", "j28"])
def test_another_robot_s_joint_is_refused_also_where_missing_joints_are_filled(robot, clip, tmp_path, other):
    names = [*ROOT, *robot.joint_names[:-1], other]
    path = table(tmp_path / "a.csv", clean_rows(clip), names)
    assert f"unknown: {other}" in refusal(robot, path, fps=50.0, fill_missing=True)


@pytest.mark.parametrize("other", ["battery", "left_knee_joint_torque", "left_hand_thumb_0_joint"])
def test_columns_that_are_no_joint_of_the_body_are_left_out_where_missing_joints_are_filled(
    robot, clip, tmp_path, other
):
    path = table(tmp_path / "a.csv", clean_rows(clip), [*ROOT, *robot.joint_names[:-1], other])
    notes = read_motion(robot, path, Reading(fps=50.0, fill_missing=True)).notes
    assert f"columns that are no joint of the robot's are left out: {other}" in notes


def test_names_that_are_bytes(robot, clip, tmp_path):
    names = np.array([joint.encode() for joint in robot.joint_names[::-1]])
    fields = {"fps": 50, "root_pos": clip.root_pos, "root_quat": clip.root_quat, "joint_names": names}
    np.savez(tmp_path / "a.npz", **fields, joint_pos=clip.joint_pos[:, ::-1])
    assert_read(robot, tmp_path / "a.npz", clip)


def test_a_counter_or_a_clock_without_a_name(robot, clip, tmp_path):
    rows = clean_rows(clip)
    for first, said in ((np.arange(40.0), "counter"), (np.arange(40) / 50.0, "clock")):
        np.savetxt(tmp_path / "a.csv", np.concatenate([first[:, None], rows], axis=1), delimiter=",", fmt="%.9f")
        notes = assert_read(robot, tmp_path / "a.csv", clip, fps=50.0 if said == "counter" else None)
        assert f"the first column is a {said}: left out" in notes
    np.savetxt(tmp_path / "a.csv", np.concatenate([rows[:, :1], rows], axis=1)[::-1], delimiter=",", fmt="%.9f")
    assert "found 37 columns; 36 are needed" in refusal(robot, tmp_path / "a.csv", fps=50.0)


@pytest.mark.parametrize(
    ("text", "names", "row"),
    [
        ('"1.5","-2.5"\n', None, [1.5, -2.5]),
        ('"a","b"\n"1.5","-2.5"\n', ("a", "b"), [1.5, -2.5]),
        ("1,2\n3,4\n", None, [1, 2]),
        ("# a,b\n1,2\n", ("a", "b"), [1, 2]),
        ('"a"; "b"\n1,5; -2,5e-1\n', ("a", "b"), [1.5, -0.25]),
        ("1,5 2,5\n", None, [1.5, 2.5]),
        ("1.5, 2.5\n", None, [1.5, 2.5]),
        ("  1.5   2.5  \n\n", None, [1.5, 2.5]),
        ("1.5|2.5\n", None, [1.5, 2.5]),
        ("a\tb\t\n1,5\t2\t\n", ("a", "b"), [1.5, 2]),
    ],
)
def test_tables_of_text(tmp_path, text, names, row):
    (tmp_path / "a.csv").write_text(text)
    found = read_table(tmp_path / "a.csv")
    assert found.names == names
    np.testing.assert_array_equal(found.values[0], row)


def test_holosoma_and_mujoco(robot, clip, tmp_path):
    """qpos; and joint_pos with the root's seven numbers before the joints."""
    qpos = np.concatenate([clip.root_pos, clip.root_quat, clip.joint_pos], axis=1)
    np.savez(tmp_path / "a.npz", qpos=qpos, fps=50, human_joints=np.zeros((40, 22, 3)))
    assert any("qpos" in note for note in assert_read(robot, tmp_path / "a.npz", clip))
    np.savez(
        tmp_path / "b.npz",
        fps=50,
        joint_pos=qpos,
        joint_vel=np.zeros((40, 35)),
        body_pos_w=clip.root_pos[:, None],
        body_quat_w=clip.root_quat[:, None],
        joint_names=np.array(robot.joint_names),
        body_names=np.array(["pelvis"]),
    )
    assert any("holosoma" in note for note in assert_read(robot, tmp_path / "b.npz", clip))


def test_a_library_s_own_clip(robot, clip, tmp_path):
    write_clip(clip, tmp_path / "wave.npz")
    found = read_motion(robot, tmp_path / "wave.npz").clip
    np.testing.assert_allclose(found.joint_pos, clip.joint_pos, atol=1e-5)
    np.testing.assert_allclose(found.root_quat, clip.root_quat, atol=1e-5)


def test_an_npz_without_names_and_with_nothing_to_compare(robot, clip, tmp_path):
    fields = {"fps": 50, "joint_pos": clip.joint_pos}
    np.savez(tmp_path / "a.npz", **fields, body_pos_w=clip.root_pos[:, None], body_quat_w=clip.root_quat[:, None])
    assert "--joint-order robot" in refusal(robot, tmp_path / "a.npz")
    notes = assert_read(robot, tmp_path / "a.npz", clip, joint_order="robot")
    assert any(note.startswith("joint order: unchecked, taken for g1's own") for note in notes)


def test_joint_velocities_that_belong_to_other_joints(robot, clip, tmp_path):
    fields = {"fps": 50, "joint_names": np.array(robot.joint_names), "joint_pos": clip.joint_pos}
    fields |= {"body_pos_w": clip.root_pos[:, None], "body_quat_w": clip.root_quat[:, None]}
    velocities = np.gradient(clip.joint_pos, 1 / 50, axis=0)
    np.savez(tmp_path / "a.npz", **fields, joint_vel=velocities)
    assert "rate: joint_vel fits 50.0 frames per s" in assert_read(robot, tmp_path / "a.npz", clip)
    assert "read at 25, but joint_vel fits 50 frames per s; give --fps 50" in refusal(
        robot, tmp_path / "a.npz", fps=25.0
    )
    np.savez(tmp_path / "a.npz", **fields, joint_vel=velocities[:, ::-1])
    assert "not the velocities of joint_pos" in refusal(robot, tmp_path / "a.npz")


def test_mimickit_and_its_relatives(robot, clip, tmp_path):
    vectors = Rotation.from_quat(clip.root_quat, scalar_first=True).as_rotvec()
    frames = np.concatenate([clip.root_pos, vectors, clip.joint_pos], axis=1)
    path = write_pickle(tmp_path / "a.pkl", {"loop_mode": 0, "fps": 50, "frames": frames.tolist()})
    assert "MimicKit's file" in assert_read(robot, path, clip)
    frames[7, 4] = np.nan
    assert "root_quat: NaN or infinity in frame 7 (0.14 s)" in refusal(
        robot, write_pickle(tmp_path / "a.pkl", {"fps": 50, "frames": frames})
    )
    one = {"root_trans_offset": clip.root_pos, "root_rot": clean_rows(clip)[:, 3:7], "dof": clip.joint_pos, "fps": 50}
    assert "the file's only clip: wave" in assert_read(robot, write_pickle(tmp_path / "b.pkl", {"wave": one}), clip)
    text = refusal(robot, write_pickle(tmp_path / "b.pkl", {"wave": one, "walk": one}))
    assert "found 2 clips (wave, walk …)" in text


def test_joblib_s_files_are_named(robot, tmp_path):
    """A pickle that names joblib's class for arrays, written by hand; and a compressed file."""
    (tmp_path / "a.pkl").write_bytes(b"cjoblib.numpy_pickle\nNumpyArrayWrapper\n.")
    assert "this is joblib's file" in refusal(robot, tmp_path / "a.pkl")
    (tmp_path / "b.pkl").write_bytes(b"\x78\x9c" + b"0" * 20)
    assert "joblib" in refusal(robot, tmp_path / "b.pkl")


def test_a_rate_in_the_file_s_name(robot, clip, tmp_path):
    for name, fps, fits in (
        ("walk_60hz", 60.0, True),
        ("walk_60hz", 30.0, False),
        ("walk 120 fps", 60.0, False),
        ("walk_2fpsx", 60.0, True),
        ("60hzx", 30.0, True),
        ("walk_fps60", 30.0, False),
        ("hz_60", 60.0, True),
        ("walk_29.97fps", 30.0, True),
    ):
        path = tmp_path / f"{name}.csv"
        np.savetxt(path, clean_rows(clip), delimiter=",", fmt="%.9f")
        if fits:
            assert_read(robot, path, dataclasses.replace(clip, fps=fps), fps=fps)
        else:
            assert "the file's name says" in refusal(robot, path, fps=fps)
