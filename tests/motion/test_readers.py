"""Readers against sample files with known facts, and one clear line for everything that is no motion."""

import numpy as np
import pytest
from damaged import ARCHIVES, ARRAYS
from motion_files import write_pickle
from orders import isaac_order

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.contact import floor_points, floor_positions
from forgetmimic_jax.motion.kinematics import configuration
from forgetmimic_jax.motion.readers import read_motion
from forgetmimic_jax.motion.recording import Reading

YAW_90 = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]  # xyzw


def standing_rows(robot, frames=40):
    """CSV rows [frame, 36]: the default pose on the floor, facing y."""
    default = np.asarray(robot.arrays.default_joint_pos)
    row = np.concatenate([[0.1, 0.2, robot.default_height], YAW_90, default])
    return np.tile(row, (frames, 1))


def write_csv(path, rows, header=""):
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.9g")
    return path


def npz_fields(robot, frames=40):
    rows = standing_rows(robot, frames)
    return {
        "fps": np.array([60.0]),
        "joint_pos": rows[:, 7:],
        "body_pos_w": rows[:, None, :3],
        "body_quat_w": np.roll(rows[:, None, 3:7], 1, axis=-1),
        "joint_names": np.array(robot.joint_names),
        "body_names": np.array(["pelvis"]),
    }


def gmr_fields(robot, frames=40):
    rows = standing_rows(robot, frames)
    return {"fps": 30, "root_pos": rows[:, :3], "root_rot": rows[:, 3:7], "dof_pos": rows[:, 7:]}


def read(robot, path, **options):
    return read_motion(robot, path, Reading(**options)).clip


def message(robot, path, **options):
    """The error's text: one line that names the file."""
    with pytest.raises(InputError) as caught:
        read(robot, path, **options)
    text = str(caught.value)
    assert "\n" not in text
    assert str(path) in text
    return text


def test_csv_columns_land_where_the_format_says(robot, tmp_path):
    rows = standing_rows(robot)
    rows[:, 7 + robot.joint_names.index("left_elbow_joint")] = 0.75
    clip = read(robot, write_csv(tmp_path / "a.csv", rows), fps=30.0)
    assert (clip.name, clip.fps, clip.num_frames) == ("a", 30.0, 40)
    np.testing.assert_allclose(clip.root_pos[0], [0.1, 0.2, robot.default_height])
    np.testing.assert_allclose(clip.root_quat[0], [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    assert clip.joint_pos[3, clip.joint_names.index("left_elbow_joint")] == 0.75


def test_csv_with_a_header_line(robot, tmp_path):
    path = write_csv(tmp_path / "a.csv", standing_rows(robot), header=",".join(f"c{i}" for i in range(36)))
    assert read(robot, path, fps=30.0).num_frames == 40


def test_the_sample_csv(robot, samples):
    """M_ShortMove12: 467 rows at 60 Hz, first row read by eye; the soles stay within 5 cm of the floor."""
    clip = read(robot, samples / "M_ShortMove12.csv", fps=60.0)
    assert clip.num_frames == 467
    np.testing.assert_allclose(clip.root_pos[0], [-0.012863, -0.074445, 0.816294])
    np.testing.assert_allclose(np.abs(clip.root_quat[0]), [0.712386, 0.051651, 0.012808, 0.699767], atol=1e-5)
    points = floor_points(robot)
    lowest = floor_positions(robot, points, configuration(clip, robot)[::20])[..., 2].min(axis=1)
    assert np.abs(lowest).max() < 0.05


def test_the_sample_npz(robot, samples):
    """30 bodies and the joint velocities are in the file: they show the order of the joints and the rate."""
    path = samples / "B_HandsUp_mjlab.npz"
    found = read_motion(robot, path)
    clip = found.clip
    assert (clip.fps, clip.num_frames) == (60.0, 441)
    np.testing.assert_allclose(clip.root_quat[0], [0.723328, -0.06149, -0.001253, -0.687761], atol=1e-5)
    assert "forward kinematics: 30 bodies within 0.0 cm of the file's" in found.notes
    assert "rate: joint_vel fits 60.0 frames per s" in found.notes
    assert "joint_vel fits 60 frames per s" in message(robot, path, fps=30.0)
    assert "forward kinematics" in message(robot, path, quaternion="xyzw")
    assert "forward kinematics" in message(robot, path, joint_order="isaac")


def test_an_npz_without_names_in_another_order_is_refused(robot, samples, tmp_path):
    content = dict(np.load(samples / "B_HandsUp_mjlab.npz"))
    np.savez(tmp_path / "shuffled.npz", **{**content, "joint_pos": content["joint_pos"][:, ::-1]})
    assert "forward kinematics" in message(robot, tmp_path / "shuffled.npz")


def test_isaac_lab_s_order_is_shown_by_the_bodies(robot, samples, tmp_path):
    """Joints and bodies level by level: refused with the flag, and read with it as the same clip."""
    content = dict(np.load(samples / "B_HandsUp_mjlab.npz"))
    joints = [robot.joint_names.index(joint) for joint in isaac_order(robot)]
    # A G1's bodies in that order: each joint's body, in the order of the joints, behind the root.
    bodies = [0] + [int(robot.model.jnt_bodyid[1 + joint]) - 1 for joint in joints]
    for field in ("joint_pos", "joint_vel"):
        content[field] = content[field][:, joints]
    for field in ("body_pos_w", "body_quat_w"):
        content[field] = content[field][:, bodies]
    np.savez(tmp_path / "isaac.npz", **content)
    assert message(robot, tmp_path / "isaac.npz").endswith("--joint-order isaac")
    found = read(robot, tmp_path / "isaac.npz", joint_order="isaac")
    np.testing.assert_allclose(found.joint_pos, read(robot, samples / "B_HandsUp_mjlab.npz").joint_pos)


def test_the_sample_pickle(robot, samples):
    read_file = read_motion(robot, samples / "yanjie_walk_001_gmr.pkl")
    clip = read_file.clip
    assert "forward kinematics: 30 bodies within 0.0 cm of the file's" in read_file.notes
    assert clip.num_frames == 416
    assert clip.fps == pytest.approx(29.876, abs=1e-3)
    np.testing.assert_allclose(np.abs(clip.root_quat[0]), [0.367963, 0.038254, 0.010478, 0.928994], atol=1e-5)
    assert clip.joint_pos[0, 0] == pytest.approx(-0.12484045)


def test_an_npz_s_joints_are_matched_by_name(robot, tmp_path):
    fields = npz_fields(robot)
    fields["joint_pos"][:, 3] = 0.25
    reverse = {**fields, "joint_names": fields["joint_names"][::-1], "joint_pos": fields["joint_pos"][:, ::-1]}
    np.savez(tmp_path / "reverse.npz", **reverse)
    clip = read(robot, tmp_path / "reverse.npz")
    assert clip.joint_names == robot.joint_names
    np.testing.assert_allclose(clip.joint_pos, fields["joint_pos"])


def test_a_csv_that_is_no_motion(robot, tmp_path):
    rows = standing_rows(robot)
    good = write_csv(tmp_path / "good.csv", rows)
    assert "--fps" in message(robot, good)
    for fps in (0.0, -30.0, float("nan")):
        assert "fps" in message(robot, good, fps=fps)
    assert "35 columns" in message(robot, write_csv(tmp_path / "narrow.csv", rows[:, :-1]), fps=30.0)
    (tmp_path / "words.csv").write_text("a,b\n" + good.read_text())
    assert "2 names for 36 columns" in message(robot, tmp_path / "words.csv", fps=30.0)
    (tmp_path / "words.csv").write_text(good.read_text() + "the,end\n")
    assert "line 41, column 1: found 'the'" in message(robot, tmp_path / "words.csv", fps=30.0)
    lines = good.read_text().splitlines()
    blank = ",".join(["", *lines[0].split(",")[1:]])
    (tmp_path / "blank.csv").write_text("\n".join([blank, *lines[1:]]))
    assert "line 1, column 1: found nothing" in message(robot, tmp_path / "blank.csv", fps=30.0)
    (tmp_path / "ragged.csv").write_text("\n".join([*lines, "1,2,3"]))
    assert "line 41: found 3 columns; 36 are needed" in message(robot, tmp_path / "ragged.csv", fps=30.0)

    for column, value, expected in ((0, np.nan, "root_pos"), (12, np.inf, "joint_pos"), (4, np.nan, "root_quat")):
        bad = rows.copy()
        bad[2, column] = value
        text = message(robot, write_csv(tmp_path / "bad.csv", bad), fps=30.0)
        assert expected in text
        assert "frame 2" in text
    bad = rows.copy()
    bad[3, 3:7] = 0.0
    assert "norm 0 in frame 3" in message(robot, write_csv(tmp_path / "zero.csv", bad), fps=30.0)
    bad = rows.copy()
    bad[:, 7:] = np.degrees(bad[:, 7:])
    assert "degrees" in message(robot, write_csv(tmp_path / "degrees.csv", bad), fps=30.0)


def test_seconds_that_the_file_does_not_have(robot, tmp_path):
    """40 frames at 30 Hz: 0 to 1.3 s."""
    path = write_csv(tmp_path / "a.csv", standing_rows(robot))
    clip = read(robot, path, fps=30.0, start=0.2, end=0.9)
    assert clip.num_frames == 22  # frames 6 to 27
    for start, end in ((-1.0, 1.0), (0.5, 0.5), (0.0, 9.0), (9.0, None), (np.nan, None), (0.0, np.inf), (0.0, np.nan)):
        assert "--start" in message(robot, path, fps=30.0, start=start, end=end)
    assert "0.13 s; at least 0.5 s" in message(robot, path, fps=30.0, start=1.2)


def test_a_quaternion_in_the_wrong_order_is_noticed(robot, tmp_path):
    rows = standing_rows(robot)
    rows[:, 3:7] = np.roll(rows[:, 3:7], 1, axis=-1)
    path = write_csv(tmp_path / "wxyz.csv", rows)
    assert "--quaternion" in message(robot, path, fps=30.0)
    clip = read(robot, path, fps=30.0, quaternion="wxyz")
    np.testing.assert_allclose(clip.root_quat[0], [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])


@pytest.mark.parametrize("file", ["M_ShortMove12.csv", "M_ShortMove14.csv", "J_ShortDance14_Disco.csv"])
def test_real_recordings_read_in_the_wrong_order_are_noticed(robot, samples, file):
    assert "--quaternion" in message(robot, samples / file, fps=60.0, quaternion="wxyz")


def test_an_npz_that_is_no_motion(robot, tmp_path):
    path, fields = tmp_path / "a.npz", npz_fields(robot)

    def with_changes(**changes):
        np.savez(path, **{field: value for field, value in {**fields, **changes}.items() if value is not None})
        return path

    assert read(robot, with_changes()).num_frames == 40
    assert "--fps" in message(robot, with_changes(fps=None))
    assert "missing joint_pos" in message(robot, with_changes(joint_pos=None))
    assert "joint_names" in message(robot, with_changes(joint_names=None))
    other = np.array(["knee", *robot.joint_names[1:]])
    assert "unknown: knee" in message(robot, with_changes(joint_names=other))
    assert "body_names" in message(robot, with_changes(body_names=np.array(["torso"])))
    assert "joint_pos" in message(robot, with_changes(joint_pos=fields["joint_pos"][:, :-1]))
    assert "body_quat_w" in message(robot, with_changes(body_quat_w=fields["body_quat_w"][:, 0]))
    assert "body_pos_w" in message(robot, with_changes(body_pos_w=fields["body_pos_w"][:3]))
    assert "fps" in message(robot, with_changes(fps=np.array([])))
    assert "fps" in message(robot, with_changes(fps=np.array("fast")))
    assert "joint_pos" in message(robot, with_changes(joint_pos=np.array("here")))
    assert "numbers are needed" in message(robot, with_changes(joint_pos=np.array([{}], dtype=object)))
    doubled = {"joint_names": np.array([*robot.joint_names, robot.joint_names[0]])}
    assert "joint_names" in message(robot, with_changes(**doubled, joint_pos=np.zeros((40, 30))))
    path.write_bytes(b"not a zip")
    assert "NPZ" in message(robot, path)


@pytest.mark.parametrize("damage", ARCHIVES + ARRAYS)
def test_an_npz_that_is_damaged(robot, tmp_path, damage):
    path = tmp_path / "a.npz"
    np.savez(path, **npz_fields(robot))
    path.write_bytes(damage(path))
    assert f"{path}: not a readable NPZ (" in message(robot, path)


def test_names_that_are_no_characters(robot, tmp_path):
    names = np.array(robot.joint_names)
    names.view(np.uint32)[3] = 0x7FFFFFFF
    np.savez(tmp_path / "a.npz", **{**npz_fields(robot), "joint_names": names})
    assert "not a readable NPZ" in message(robot, tmp_path / "a.npz")


def test_numbers_that_cannot_be_cast_are_refused_without_a_warning(robot, tmp_path, recwarn):
    fields = npz_fields(robot)
    angles = fields["joint_pos"].astype(np.float32)
    angles.view(np.uint32)[0, 0] = 0x7F800001  # a signalling NaN
    np.savez(tmp_path / "a.npz", **{**fields, "joint_pos": angles})
    assert "NaN" in message(robot, tmp_path / "a.npz")
    assert not recwarn.list


def test_a_pickle_that_is_no_motion(robot, tmp_path):
    path, fields = tmp_path / "a.pkl", gmr_fields(robot)
    assert read(robot, write_pickle(path, fields)).fps == 30.0
    assert "--fps" in message(robot, write_pickle(path, {k: v for k, v in fields.items() if k != "fps"}))
    assert "28 joints" in message(robot, write_pickle(path, {**fields, "dof_pos": fields["dof_pos"][:, :-1]}))
    assert "root_rot" in message(robot, write_pickle(path, {**fields, "root_rot": fields["root_rot"][:, :3]}))
    assert "root_pos" in message(robot, write_pickle(path, {**fields, "root_pos": "here"}))
    assert "list" in message(robot, write_pickle(path, [1, 2]))
    path.write_bytes(b"\x80\x04garbage")
    assert "pickle" in message(robot, path)


class Malicious:
    def __init__(self, target, *arguments):
        self.call = (target, arguments)

    def __reduce__(self):
        return self.call


def test_a_pickle_that_would_run_code_is_refused_and_does_not_run(robot, tmp_path):
    import os

    witness = tmp_path / "witness"
    for target, argument in ((os.system, f"touch {witness}"), (eval, f"open({str(witness)!r}, 'w')")):
        path = write_pickle(tmp_path / "bad.pkl", {**gmr_fields(robot), "extra": Malicious(target, argument)})
        assert "refused" in message(robot, path)
        names = np.array([Malicious(target, argument)], dtype=object)
        np.savez(tmp_path / "bad.npz", **{**npz_fields(robot), "joint_names": names})
        assert "refused" in message(robot, tmp_path / "bad.npz")
        assert not witness.exists()


def test_unknown_suffix_and_missing_file(robot, tmp_path):
    (tmp_path / "a.bvh").write_text("")
    assert ".csv, .txt, .npz, .pkl" in message(robot, tmp_path / "a.bvh")
    assert "not found" in message(robot, tmp_path / "none.csv", fps=30.0)
