"""The measures on motions with known faults, and the bar on the shipped library."""

import dataclasses

import numpy as np
import pytest

from forgetmimic_jax.motion import library, quality
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.contact import floor_points, floor_positions
from forgetmimic_jax.motion.fit import on_floor
from forgetmimic_jax.motion.kinematics import angular_velocity, configuration, rotation
from forgetmimic_jax.robot.model import load_robot, relative_height


@pytest.fixture(scope="module")
def standing(robot) -> Clip:
    """2 s of the default pose, its feet flat on the floor."""
    frames = 100
    default = np.asarray(robot.arrays.default_joint_pos, np.float64)
    clip = Clip(
        "standing",
        50.0,
        robot.joint_names,
        np.tile([0.0, 0.0, robot.default_height], (frames, 1)),
        np.tile([1.0, 0.0, 0.0, 0.0], (frames, 1)),
        np.tile(default, (frames, 1)),
    )
    return on_floor(robot, clip)[0]


def moved(clip, offsets):
    """The clip with its root moved by [frame, 3] m."""
    return dataclasses.replace(clip, root_pos=clip.root_pos + offsets)


def test_standing_still_passes(robot, standing):
    found = quality.measure(robot, standing)
    assert found.failures() == []
    assert found.sole_lowest == pytest.approx(0.0, abs=1e-6)
    assert (found.skate, found.joint_speed, found.jitter) == (0.0, 0.0, 0.0)
    assert found.flight_acceleration is None
    assert found.seam is None


def test_sinking_and_hovering(robot, standing):
    """3 cm under: -3 cm. 3 cm over: 3 cm from the floor in stance."""
    sunk = quality.measure(robot, moved(standing, [0.0, 0.0, -0.03]))
    assert sunk.sole_lowest == pytest.approx(-0.03, abs=1e-6)
    assert any("sole 3.0 cm under" in failure for failure in sunk.failures())
    hovering = quality.measure(robot, moved(standing, [0.0, 0.0, 0.03]))
    assert hovering.stance_height == pytest.approx(0.03, abs=1e-3)
    assert any("3.0 cm from the floor in stance" in failure for failure in hovering.failures())


def test_sliding_feet(robot, standing):
    """The whole robot glides at 0.25 m/s."""
    glide = np.arange(100)[:, None] * np.array([0.25 / 50.0, 0.0, 0.0])
    found = quality.measure(robot, moved(standing, glide))
    assert found.skate == pytest.approx(0.25)
    assert any("0.25 m/s" in failure for failure in found.failures())


def test_flight_falls_with_gravity(robot, standing):
    """A hop of 0.4 s: 9.81 m/s² is read back from it. The same hop in slow motion falls at 2 m/s² and fails."""
    time = (np.arange(100) - 50) / 50.0

    def hop(gravity, seconds):
        height = np.maximum(0.5 * gravity * ((seconds / 2) ** 2 - time**2), 0.0)
        return quality.measure(robot, moved(standing, height[:, None] * [0.0, 0.0, 1.0]))

    assert hop(9.81, 0.4).flight_acceleration == pytest.approx(-9.81, abs=0.01)
    slow = hop(2.0, 0.88)
    assert slow.flight_acceleration == pytest.approx(-2.0, abs=0.01)
    assert any("-2.0 m/s^2" in failure for failure in slow.failures())
    assert hop(9.81, 0.4).missing_acceleration == pytest.approx(0.0, abs=1e-6)
    assert slow.missing_acceleration == pytest.approx(9.81 - 2.0, abs=0.01)
    assert any("for 0.2 s it needs 7.8 m/s^2" in failure for failure in slow.failures())


def test_a_push_the_floor_cannot_give(robot, standing):
    """Sliding sideways at 9.81 m/s² needs as much friction as weight; 0.7 of it is there (and the robot would tip)."""
    time = np.arange(100) / 50.0
    shove = quality.measure(robot, moved(standing, 0.5 * 9.81 * time[:, None] ** 2 * [0.0, 1.0, 0.0]))
    assert shove.missing_acceleration > 0.3 * 9.81
    assert quality.measure(robot, dataclasses.replace(standing, **_first(standing, 8))).missing_acceleration is None


def test_a_motor_beyond_its_limit(robot, standing):
    """Both arms flung up and down at 3 Hz through 2 rad: more than a shoulder gives; at 0.3 Hz it is little."""

    def flung(hertz):
        joints = standing.joint_pos.copy()
        shoulders = ["shoulder_pitch" in name for name in robot.joint_names]
        joints[:, shoulders] += np.sin(2 * np.pi * hertz * np.arange(100) / 50.0)[:, None]
        return quality.measure(robot, dataclasses.replace(standing, joint_pos=joints))

    assert flung(0.3).motor_load < 0.5
    assert flung(3.0).motor_load > quality.MAX_LOAD
    assert any("times a motor's torque limit" in failure for failure in flung(3.0).failures())
    assert quality.measure(robot, dataclasses.replace(standing, **_first(standing, 6))).motor_load is None


def _first(clip, frames):
    return {name: getattr(clip, name)[:frames] for name in ("root_pos", "root_quat", "joint_pos")}


def test_joint_limits_and_speed(robot, standing):
    joints = standing.joint_pos.copy()
    joints[50:, 3] = robot.joint_upper[3] + 0.1
    found = quality.measure(robot, dataclasses.replace(standing, joint_pos=joints))
    assert found.limit_excess == pytest.approx(0.1)
    jump = (robot.joint_upper[3] + 0.1 - standing.joint_pos[0, 3]) * 50.0
    assert found.joint_speed == pytest.approx(jump / robot.joint_velocity_limit[3])
    assert len(found.failures()) >= 2


def test_a_measure_says_where_it_is_worst(robot, standing):
    """A knee that jumps at frame 50, a robot that sinks at frame 70: 1.00 s and 1.40 s."""
    joints = standing.joint_pos.copy()
    joints[50:, 3] += 0.6
    height = np.zeros((100, 3))
    height[70, 2] = -0.04
    found = quality.measure(robot, dataclasses.replace(moved(standing, height), joint_pos=joints))
    assert any("left_knee_joint at 0.98 s, frame 49" in failure for failure in found.failures())
    assert any("under the floor (at 1.40 s, frame 70)" in failure for failure in found.failures())


def test_only_what_is_no_motion_is_a_fault(robot, standing):
    """3 cm under the floor is rough, 20 cm is a fault; so is a jump of 1 m, which needs more than 10 g."""
    assert quality.measure(robot, moved(standing, [0.0, 0.0, -0.03])).faults() == []
    (deep,) = quality.measure(robot, moved(standing, [0.0, 0.0, -0.2])).faults()
    assert "20.0 cm under the floor" in deep
    jump = np.where(np.arange(100)[:, None] < 50, 0.0, [1.0, 0.0, 0.0])
    assert any("that no contact gives" in fault for fault in quality.measure(robot, moved(standing, jump)).faults())


def test_the_root_s_speed_is_that_of_its_fastest_second(robot, standing):
    """One second at 1.5 m/s and one at rest: 1.5 m/s, however long it rests."""
    path = np.minimum(np.arange(100), 50)[:, None] * np.array([1.5 / 50.0, 0.0, 0.0])
    assert quality.measure(robot, moved(standing, path)).root_speed == pytest.approx(1.5)


@pytest.mark.parametrize(("hertz", "passes"), [(2.0, True), (20.0, False)])
def test_jitter_is_motion_faster_than_12_hz(robot, standing, hertz, passes):
    joints = standing.joint_pos.copy()
    joints[:, 16] += 0.01 * np.sin(2 * np.pi * hertz * np.arange(100) / 50.0)
    found = quality.measure(robot, dataclasses.replace(standing, joint_pos=joints))
    assert (found.jitter < quality.MAX_JITTER) is passes
    assert any("jitter" in failure for failure in found.failures()) is not passes


def test_seam_ratio_of_a_smooth_cycle_and_of_a_broken_one():
    """cos repeats smoothly every 25 frames; a ramp that starts over jumps by its whole height at each seam."""
    time = np.arange(100)
    smooth = np.diff(np.cos(2 * np.pi * time / 25))[:, None]
    assert quality.seam_ratio(smooth, 25) == pytest.approx(1.0, abs=0.03)
    broken = np.diff((time % 25) / 25 + 0.01 * np.cos(2 * np.pi * time / 25))[:, None]
    assert quality.seam_ratio(broken, 25) > 10


@pytest.fixture(scope="module", params=["g1", "h2"])
def shipped(request):
    """A robot whose library is shipped."""
    return load_robot(request.param)


def test_every_shipped_clip_passes(shipped):
    robot, folder = shipped, library.DATA_DIR / shipped.name
    entries = library.read_manifest(folder)["clips"]
    clips = library.read_library(robot, folder)
    assert [clip.name for clip in clips] == list(entries)
    assert len(clips) == {"g1": 12, "h2": 8}[robot.name]
    for clip in clips:
        cycle = entries[clip.name]["cycle_frames"]
        assert quality.measure(robot, clip, cycle).failures() == [], clip.name
        assert entries[clip.name]["licence"]
        if cycle is not None:
            assert clip.num_frames == 500


def lowest(robot, clip):
    points = floor_points(robot)
    return points, floor_positions(robot, points, configuration(clip, robot))


def test_shipped_motions_are_what_their_names_say(shipped):
    """Walking and running go forwards; the cartwheel stands on its hands; the punch's fist and the kick's foot reach
    out and up."""
    robot, folder = shipped, library.DATA_DIR / shipped.name
    clips = {clip.name: clip for clip in library.read_library(robot, folder)}
    speed = {name: clips[name].root_pos[-1, 0] / clips[name].seconds for name in ("walk", "run")}
    size = relative_height(robot.model)
    assert 0.5 < speed["walk"] / size < 1.0
    assert 2.0 < speed["run"] / size < 4.0

    points, pos = lowest(robot, clips["cartwheel"])
    hands = np.isin(points.body, robot.pairs.hands)
    feet = pos[:, points.is_sole, 2].min(axis=1)
    upside_down = np.argmax(feet)
    assert feet[upside_down] > 0.5
    assert pos[upside_down - 25 : upside_down + 25][:, hands, 2].min() < 0.03

    _, pos = lowest(robot, clips["kick"])
    assert pos[:, points.body == robot.pairs.feet[1], 2].min(axis=1).max() > 0.6
    points, pos = lowest(robot, clips["punch"])
    fists = np.isin(points.body, robot.pairs.hands)
    reach = np.linalg.norm(pos[:, fists, :2] - clips["punch"].root_pos[:, None, :2], axis=-1).max()
    assert reach > 0.35


def test_the_g1_goes_over_backwards_and_gets_up_from_its_back(robot):
    folder = library.DATA_DIR / robot.name
    clips = {clip.name: clip for clip in library.read_library(robot, folder)}
    entries = library.read_manifest(folder)["clips"]
    backflip = clips["backflip"]
    cycle = entries["backflip"]["cycle_frames"]
    spin = rotation(backflip.root_quat).inv().apply(angular_velocity(backflip.root_quat, 50.0))[:cycle, 1]
    assert spin.sum() / 50.0 == pytest.approx(-2 * np.pi, abs=0.3)  # backwards about y, the left

    getup = clips["getup_faceup"]
    up = rotation(getup.root_quat).apply([0.0, 0.0, 1.0])
    front = rotation(getup.root_quat).apply([1.0, 0.0, 0.0])
    assert front[0, 2] > 0.8
    assert up[-1, 2] > 0.8
    points, pos = lowest(robot, getup)
    torso = np.isin(points.body, [robot.anchor_body_id, robot.key_body_ids[robot.root]])
    assert pos[0, torso, 2].min() < 0.03
