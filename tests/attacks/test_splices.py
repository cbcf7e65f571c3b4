"""Splices by numbers worked out by hand."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from forgetmimic_jax.attacks import splices
from forgetmimic_jax.motion.clip import Clip


def moving(frames: int, joint: np.ndarray, *, name: str = "host", step: float = 0.01, height: float = 0.8) -> Clip:
    """A robot of two joints, both at `joint` [frame] rad, that moves along x by `step` m a frame."""
    return Clip(
        name=name,
        fps=50.0,
        joint_names=("a", "b"),
        root_pos=np.stack([step * np.arange(frames), np.zeros(frames), np.full(frames, height)], axis=-1),
        root_quat=np.tile([1.0, 0.0, 0.0, 0.0], (frames, 1)),
        joint_pos=np.stack([joint, joint], axis=-1).astype(float),
    )


def test_the_other_clip_starts_where_the_first_ended_and_the_difference_fades():
    one = moving(2, np.array([0.0, 1.0]), height=0.7)
    other = moving(5, np.full(5, 3.0), name="other", height=0.9)
    turn = Rotation.from_euler("z", 90, degrees=True)
    other = dataclasses.replace(
        other,
        root_pos=turn.apply(other.root_pos) + np.array([4.0, 2.0, 0.0]),
        root_quat=np.tile(turn.as_quat(scalar_first=True), (5, 1)),
    )
    found = splices.joined(one, other, 4)
    # The weight 1 - t²(3 - 2t) at t = 0, 1/4, 1/2, 3/4, 1 is 1, 27/32, 1/2, 5/32, 0; the difference is -2 rad, -0.2 m.
    weight = np.array([1.0, 27 / 32, 0.5, 5 / 32, 0.0])
    np.testing.assert_allclose(found.joint_pos[:, 0], [0.0, 1.0, *(3.0 - 2.0 * weight)])
    np.testing.assert_allclose(found.root_pos[:, 2], [0.7, 0.7, *(0.9 - 0.2 * weight)])
    np.testing.assert_allclose(found.root_pos[:, 0], [0.0, 0.01, 0.01, 0.02, 0.03, 0.04, 0.05], atol=1e-12)
    np.testing.assert_allclose(found.root_pos[:, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose(np.abs(found.root_quat), [[1, 0, 0, 0]] * 7, atol=1e-12)


def test_a_tilt_fades_and_the_heading_does_not_come_back():
    one = moving(2, np.zeros(2))
    pitched = Rotation.from_euler("y", 40, degrees=True)
    one = dataclasses.replace(one, root_quat=np.tile(pitched.as_quat(scalar_first=True), (2, 1)))
    found = splices.joined(one, moving(3, np.zeros(3)), 2)
    angles = Rotation.from_quat(found.root_quat, scalar_first=True).as_euler("zyx", degrees=True)
    np.testing.assert_allclose(angles, [[0, 40, 0], [0, 40, 0], [0, 40, 0], [0, 20, 0], [0, 0, 0]], atol=1e-9)


def test_the_other_clips_joints_are_matched_by_name():
    one, other = moving(1, np.zeros(1)), moving(3, np.zeros(3))
    other = dataclasses.replace(other, joint_names=("b", "a"), joint_pos=np.tile([5.0, 6.0], (3, 1)))
    np.testing.assert_allclose(splices.joined(one, other, 1).joint_pos, [[0, 0], [0, 0], [6, 5], [6, 5]])


def test_the_middle_second_is_around_the_middle():
    assert splices.middle(moving(151, np.arange(151)), 1.0).joint_pos[[0, -1], 0].tolist() == [50, 99]
    assert splices.middle(moving(30, np.arange(30)), 1.0).num_frames == 30


def test_the_cut_is_where_the_poses_fit():
    host = moving(100, np.arange(100.0))
    inserted = moving(50, np.linspace(61.0, 62.0, 50), name="guest")
    assert splices.best_cut(host, inserted) == 62  # frame 61 before the seam, frame 62 after it
    early = moving(50, np.linspace(3.0, 4.0, 50), name="guest")
    assert splices.best_cut(host, early) == 25  # a quarter of the host comes first


def test_a_splice_says_which_frames_are_the_guests():
    host = moving(200, np.arange(200.0))
    guest = moving(150, np.full(150, 99.5), name="guest")
    found = splices.splice(host, guest)
    # 50 frames of the host, 50 of the guest, of which 10 fade in, and 50 of the host.
    assert (found.clip.num_frames, found.first, found.end) == (150, 60, 100)
    assert found.clip.name == "guest_in_host"
    np.testing.assert_array_equal(found.clip.joint_pos[found.first : found.end], 99.5)
    np.testing.assert_array_equal(found.clip.joint_pos[:50, 0], np.arange(50, 100))
    np.testing.assert_array_equal(found.clip.joint_pos[110:, 0], np.arange(110, 150))
    assert np.diff(found.clip.root_pos[:, 0]).max() == pytest.approx(0.01)
