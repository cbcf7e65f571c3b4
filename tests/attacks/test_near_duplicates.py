"""Each near-duplicate of a clip, by numbers worked out by hand."""

import dataclasses

import numpy as np
import pytest

from forgetmimic_jax.attacks import near_duplicates
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.fit import lowest_points
from forgetmimic_jax.motion.mirror import mirrored

FPS = 50.0
HALF_TURN = np.sqrt(0.5)  # of the quaternion of 90 degrees


def straight(robot, frames: int, *, joint: np.ndarray | float = 0.0, name: str = "straight") -> Clip:
    """A clip that heads along x at 0.5 m/s, 0.8 m high, with every joint at `joint` [frame] rad."""
    time = np.arange(frames) / FPS
    return Clip(
        name=name,
        fps=FPS,
        joint_names=robot.joint_names,
        root_pos=np.stack([0.5 * time, 0.0 * time, 0.0 * time + 0.8], axis=-1),
        root_quat=np.tile([1.0, 0.0, 0.0, 0.0], (frames, 1)),
        joint_pos=np.tile(np.broadcast_to(joint, (frames,))[:, None], (1, robot.num_joints)),
    )


@pytest.mark.parametrize(("factor", "frames", "joint"), [(2.0, 5, 0.2), (0.5, 17, 0.05), (1.25, 7, 0.125)])
def test_another_speed_has_other_frames_of_the_same_motion(robot, factor, frames, joint):
    clip = straight(robot, 9, joint=0.1 * np.arange(9))
    found = near_duplicates.at_speed(clip, factor)
    assert (found.fps, found.num_frames) == (FPS, frames)
    np.testing.assert_allclose(found.joint_pos[:, 0], joint * np.arange(frames), atol=1e-12)
    np.testing.assert_allclose(found.root_pos[:, 0], factor * 0.01 * np.arange(frames), atol=1e-12)
    assert found.name == f"straight_speed_{factor:g}"


def test_amplitude_is_about_the_mean_pose_and_stays_in_the_limits(robot):
    joint = robot.joint_names.index("left_elbow_joint")
    clip = straight(robot, 3, joint=np.array([0.0, 0.2, 0.4]))
    found = near_duplicates.with_amplitude(robot, clip, 1.2)
    np.testing.assert_allclose(found.joint_pos[:, joint], [-0.04, 0.2, 0.44], atol=1e-12)
    np.testing.assert_array_equal(found.root_pos, clip.root_pos)
    far = near_duplicates.with_amplitude(robot, clip, 100.0)
    np.testing.assert_array_equal(far.joint_pos[0], np.clip(-19.8, robot.joint_lower, robot.joint_upper))
    np.testing.assert_array_equal(far.joint_pos[2], np.clip(20.2, robot.joint_lower, robot.joint_upper))


def test_a_turn_is_about_the_vertical(robot):
    found = near_duplicates.turned(straight(robot, 3), np.pi / 2)
    np.testing.assert_allclose(found.root_pos, [[0, 0, 0.8], [0, 0.01, 0.8], [0, 0.02, 0.8]], atol=1e-12)
    np.testing.assert_allclose(found.root_quat, [[HALF_TURN, 0, 0, HALF_TURN]] * 3, atol=1e-12)


def test_noise_has_its_size_and_is_slow(robot):
    clip = dataclasses.replace(straight(robot, 500), joint_pos=np.zeros((500, robot.num_joints)) + 0.3)
    free = (robot.joint_lower < 0.0) & (robot.joint_upper > 0.6)
    noise = near_duplicates.with_noise(robot, clip, 0.05, 2.0, seed=3).joint_pos[:, free] - 0.3
    assert free.sum() >= 10
    np.testing.assert_allclose(np.sqrt((noise**2).mean(axis=0)), 0.05, atol=1e-12)
    power = (np.abs(np.fft.rfft(noise, axis=0)) ** 2).sum(axis=1)
    frequency = np.fft.rfftfreq(500, 1.0 / FPS)
    # A Gaussian filter of 2 Hz leaves exp(-6² / 2²) = 0.0001 of the power at 6 Hz.
    assert power[frequency > 6.0].sum() < 1e-2 * power.sum()
    assert power[frequency < 2.0].sum() > 0.5 * power.sum()
    assert not np.allclose(noise, near_duplicates.with_noise(robot, clip, 0.05, 2.0, seed=4).joint_pos[:, free] - 0.3)


def test_a_part_has_the_frames_between(robot):
    found = near_duplicates.part(straight(robot, 9, joint=np.arange(9.0)), 4, 9, "second_half")
    np.testing.assert_array_equal(found.joint_pos[:, 0], [4, 5, 6, 7, 8])
    np.testing.assert_allclose(found.root_pos[:, 0], 0.01 * np.arange(4, 9))
    assert found.name == "straight_second_half"


def test_a_blend_is_three_quarters_of_the_clip_and_one_of_the_other(robot):
    clip = straight(robot, 5, joint=0.4)
    other = near_duplicates.turned(straight(robot, 3, joint=0.8, name="other"), np.pi / 2)
    pitched = np.array([HALF_TURN, 0.0, HALF_TURN, 0.0])  # 90 degrees about y, then about z
    other = dataclasses.replace(
        other,
        root_pos=2.0 * other.root_pos + [7.0, 5.0, -0.6],
        root_quat=np.stack([other.root_quat[0], other.root_quat[0], [0.5, -0.5, 0.5, 0.5]]),
    )
    found = near_duplicates.blended(clip, other, 0.75)
    np.testing.assert_allclose(found.joint_pos, np.full((3, robot.num_joints), 0.5))
    # The other moves along y at 1 m/s, so along x at 1 m/s once it has the clip's heading; its height is 1.0 m.
    np.testing.assert_allclose(found.root_pos[:, 0], [0.0, 0.0125, 0.025], atol=1e-12)
    np.testing.assert_allclose(found.root_pos[:, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose(found.root_pos[:, 2], 0.75 * 0.8 + 0.25 * 1.0)
    np.testing.assert_allclose(found.root_quat[0], [1, 0, 0, 0], atol=1e-12)
    quarter = np.array([np.cos(np.pi / 16), 0.0, np.sin(np.pi / 16), 0.0])  # a quarter of the pitch
    np.testing.assert_allclose(found.root_quat[2], quarter * np.sign(pitched[0]), atol=1e-12)


def test_joints_are_blended_by_name(robot):
    clip, other = straight(robot, 2, joint=0.0), straight(robot, 2, joint=0.0, name="other")
    ramp = np.tile(np.arange(robot.num_joints) / 100.0, (2, 1))
    other = dataclasses.replace(other, joint_names=robot.joint_names[::-1], joint_pos=ramp[:, ::-1])
    np.testing.assert_allclose(near_duplicates.blended(clip, other, 0.75).joint_pos, 0.25 * ramp)


def test_a_clip_is_placed_by_position_and_heading_alone(robot):
    clip = near_duplicates.turned(straight(robot, 2), -np.pi / 2)
    tilted = np.array([0.5, 0.5, 0.5, 0.5])  # 90 degrees about x, then 90 degrees about z
    found = near_duplicates.placed(clip, np.array([3.0, 4.0, 9.0]), tilted)
    np.testing.assert_allclose(found.root_pos, [[3.0, 4.0, 0.8], [3.0, 4.01, 0.8]], atol=1e-12)
    np.testing.assert_allclose(found.root_quat[0], [HALF_TURN, 0, 0, HALF_TURN], atol=1e-12)


def test_feet_stay_as_far_from_the_ground(robot):
    crouch = np.tile(np.asarray(robot.arrays.default_joint_pos), (6, 1))
    crouch *= np.linspace(0.5, 1.5, 6)[:, None]
    clip = dataclasses.replace(straight(robot, 6), joint_pos=crouch)
    variant = near_duplicates.with_amplitude(robot, clip, 2.0)

    def second_lowest(of: Clip) -> float:  # of six frames: a fifth of the way is the second
        heights = lowest_points(robot, of, soles=True)
        return float(np.sort(heights)[1])

    assert abs(second_lowest(variant) - second_lowest(clip)) > 0.005
    found = near_duplicates.as_high(robot, variant, clip)
    assert second_lowest(found) == pytest.approx(second_lowest(clip), abs=1e-9)
    np.testing.assert_array_equal(found.joint_pos, variant.joint_pos)


def test_every_family_is_there_with_names_of_their_own(robot):
    clip, other = straight(robot, 40, joint=0.1 * np.sin(np.arange(40))), straight(robot, 60, name="other")
    families = near_duplicates.near_duplicates(robot, clip, other)
    assert {family: len(clips) for family, clips in families.items()} == {
        "speed": 4, "mirrored": 1, "amplitude": 2, "turned": 1, "noise": 1, "half": 2, "blended": 1
    }  # fmt: skip
    names = [clip.name for clips in families.values() for clip in clips]
    assert len(set(names)) == 12
    assert all(name.startswith("straight_") for name in names)
    np.testing.assert_array_equal(families["mirrored"][0].joint_pos, mirrored(robot, clip).joint_pos)
    lengths = {clip.name: clip.num_frames for clips in families.values() for clip in clips}
    assert lengths["straight_speed_0.75"] == 53  # 39 steps take 52
    assert lengths["straight_speed_1.25"] == 32
    assert (lengths["straight_first_half"], lengths["straight_second_half"]) == (20, 20)
