"""The file's bodies against the robot's: other units, and numbers that are not finite."""

import numpy as np
import pytest
from motion_cases import body_positions, refusal, waving

from forgetmimic_jax.motion.readers import read_motion
from forgetmimic_jax.motion.recording import Reading


@pytest.fixture
def clip(robot):
    """40 frames at 50 Hz of a robot that walks."""
    return waving(robot, "wave", 40)


@pytest.fixture
def fields(robot, clip):
    """An NPZ's fields, with every body of the robot and no names."""
    bodies = body_positions(robot, clip)
    quat = np.tile(clip.root_quat[:, None], (1, bodies.shape[1], 1))
    return {"fps": 50, "joint_pos": clip.joint_pos, "body_pos_w": bodies, "body_quat_w": quat}


@pytest.mark.parametrize(
    ("field", "change", "flags", "options"),
    [
        ("body_pos_w", lambda pos: 1000 * pos, "--unit mm", {"unit": "mm"}),
        ("joint_pos", np.degrees, "--angles degrees", {"angles": "degrees"}),
        ("body_quat_w", lambda quat: np.roll(quat, -1, axis=-1), "--quaternion xyzw", {"quaternion": "xyzw"}),
    ],
)
def test_another_reading_that_fits_the_bodies_is_named(robot, clip, fields, tmp_path, field, change, flags, options):
    np.savez(tmp_path / "a.npz", **fields | {field: change(fields[field])})
    text = refusal(robot, tmp_path / "a.npz")
    assert "forward kinematics" in text
    assert text.endswith(f"another reading fits: {flags}")
    found = read_motion(robot, tmp_path / "a.npz", Reading(**options)).clip
    np.testing.assert_allclose(found.joint_pos, clip.joint_pos, atol=1e-6)


def test_a_frame_of_a_body_that_is_not_finite_does_not_end_the_comparison(robot, clip, fields, tmp_path):
    """The body that is named first."""
    names = [robot.model.body(body).name for body in range(robot.model.nbody - 1, 0, -1)]
    reverse = {field: fields[field][:, ::-1].copy() for field in ("body_pos_w", "body_quat_w")}
    fields |= {"body_names": np.array(names), "joint_names": np.array(robot.joint_names), **reverse}
    fields["body_pos_w"][0, 0] = np.nan
    np.savez(tmp_path / "a.npz", **fields)
    notes = read_motion(robot, tmp_path / "a.npz", Reading()).notes
    assert any("forward kinematics: 30 bodies within 0.0 cm" in note for note in notes)
    np.savez(tmp_path / "a.npz", **fields | {"joint_pos": clip.joint_pos[:, ::-1]})
    assert "forward kinematics" in refusal(robot, tmp_path / "a.npz")


def test_bodies_of_which_none_is_finite_compare_nothing(robot, fields, tmp_path):
    fields["body_pos_w"][:, 1:] = np.nan
    np.savez(tmp_path / "a.npz", **fields)
    assert "there are no bodies to compare with" in refusal(robot, tmp_path / "a.npz")
