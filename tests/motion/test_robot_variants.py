"""Robots with fewer joints: which of the variants a file without names holds, and what the YAML says of them."""

import dataclasses
import shutil

import numpy as np
import pytest
import yaml
from motion_cases import body_positions, refusal, waving
from motion_files import LESS, ROOT, clean_rows, write_pickle

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.readers import read_motion
from forgetmimic_jax.motion.recording import Reading
from forgetmimic_jax.robot.model import ROBOTS_DIR, load_robot

WRISTS = [f"{side}_wrist_{axis}" for side in ("left", "right") for axis in ("roll", "pitch", "yaw")]
LACKING = {"no_wrists": WRISTS, "unitree_23dof": LESS}


@pytest.fixture
def clip(robot):
    """40 frames at 50 Hz of a robot that walks."""
    return waving(robot, "wave", 40)


def without(robot, clip, variant):
    """The columns that a variant has, and its joints [frame, joint]."""
    kept = [
        place for place, joint in enumerate(robot.joint_names) if joint.removesuffix("_joint") not in LACKING[variant]
    ]
    return kept, clip.joint_pos[:, kept]


def pickled(robot, clip, variant, path):
    """A clip as ASAP, HumanoidVerse and PBHC write them."""
    root = {"root_trans_offset": clip.root_pos, "root_rot": clean_rows(clip)[:, 3:7]}
    return write_pickle(path, {"wave": {**root, "dof": without(robot, clip, variant)[1], "fps": 50}})


def assert_joints(robot, clip, variant, found):
    """The variant's joints are the clip's, the others at their default angle."""
    kept, joints = without(robot, clip, variant)
    expected = np.tile(np.asarray(robot.arrays.default_joint_pos), (clip.num_frames, 1))
    expected[:, kept] = joints
    np.testing.assert_allclose(found.clip.joint_pos, expected, atol=1e-6)


@pytest.mark.parametrize("variant", LACKING)
def test_where_nothing_decides_the_variant_the_user_must(robot, clip, tmp_path, variant):
    """A quiet clip has the joints of both variants in their ranges."""
    path = pickled(robot, clip, variant, tmp_path / "a.pkl")
    assert all(name in refusal(robot, path) for name in LACKING)
    text = refusal(robot, path, fill_missing=True)
    assert all(f"--variant {name} (without " in text for name in LACKING)
    assert_joints(robot, clip, variant, read_motion(robot, path, Reading(fill_missing=True, variant=variant)))


@pytest.mark.parametrize(
    ("variant", "joint", "angle", "other"),
    [
        ("no_wrists", "left_shoulder_yaw_joint", 2.5, "unitree_23dof by 0.5"),  # read as the wrist's roll
        ("unitree_23dof", "left_shoulder_pitch_joint", -1.0, "no_wrists by 0.48"),  # read as the waist's roll
    ],
)
def test_joints_beyond_their_ranges_tell_the_variant(robot, clip, tmp_path, variant, joint, angle, other):
    clip.joint_pos[:, robot.joint_names.index(joint)] = angle
    found = read_motion(robot, pickled(robot, clip, variant, tmp_path / "a.pkl"), Reading(fill_missing=True))
    assert any(f"read as the variant {variant}, because" in note and other in note for note in found.notes)
    assert_joints(robot, clip, variant, found)


@pytest.mark.parametrize("variant", LACKING)
def test_bodies_tell_the_variant(robot, clip, tmp_path, variant):
    """Positions of bodies in the root's frame, as GMR writes them."""
    kept, joints = without(robot, clip, variant)
    filled = np.tile(np.asarray(robot.arrays.default_joint_pos), (clip.num_frames, 1))
    filled[:, kept] = joints
    upright = {"root_pos": np.zeros((40, 3)), "root_quat": np.tile([1.0, 0.0, 0.0, 0.0], (40, 1))}
    bodies = body_positions(robot, dataclasses.replace(clip, joint_pos=filled, **upright))
    names = [robot.model.body(body).name for body in range(1, robot.model.nbody)]
    content = {"fps": 50, "root_pos": clip.root_pos, "root_rot": clean_rows(clip)[:, 3:7], "dof_pos": joints}
    path = write_pickle(tmp_path / "a.pkl", {**content, "link_body_list": names, "local_body_pos": bodies})
    found = read_motion(robot, path, Reading(fill_missing=True))
    assert f"joints: read as the variant {variant}, because the file's bodies fit no other" in found.notes
    assert_joints(robot, clip, variant, found)


def test_names_tell_the_variant(robot, clip, tmp_path):
    kept, joints = without(robot, clip, "no_wrists")
    header = ",".join([*ROOT, *(robot.joint_names[place] for place in kept)])
    rows = np.concatenate([clean_rows(clip)[:, :7], joints], axis=1)
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=header, comments="", fmt="%.9f")
    assert_joints(
        robot, clip, "no_wrists", read_motion(robot, tmp_path / "a.csv", Reading(fps=50.0, fill_missing=True))
    )
    text = refusal(robot, tmp_path / "a.csv", fps=50.0, fill_missing=True, variant="no_wrists")
    assert "--variant: found 'no_wrists', but the file names its joints" in text


def test_a_variant_that_the_file_cannot_hold(robot, clip, tmp_path):
    path = pickled(robot, clip, "no_wrists", tmp_path / "a.pkl")
    assert "--variant: found 'x'; accepted: no_wrists, unitree_23dof" in refusal(robot, path, variant="x")
    np.savetxt(tmp_path / "a.csv", clean_rows(clip), delimiter=",")
    text = refusal(robot, tmp_path / "a.csv", fps=50.0, variant="no_wrists")
    assert "but the file has 29 joints; accepted: no --variant" in text


def test_a_variant_of_the_yaml_names_joints_that_there_are(tmp_path):
    folder = shutil.copytree(ROBOTS_DIR / "g1", tmp_path / "g1")
    roles = yaml.safe_load((folder / "g1.yaml").read_text())
    roles["variants"] = {"armless": [".*_arm"]}
    (folder / "g1.yaml").write_text(yaml.safe_dump(roles))
    with pytest.raises(InputError, match=r"variants: armless: no joint matches '\.\*_arm'"):
        load_robot("g1", robots_dir=tmp_path)
