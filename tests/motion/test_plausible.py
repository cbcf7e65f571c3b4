"""The doubt about right and wrong readings: the separation that the thresholds rest on, on every clip at hand."""

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion import library, plausible
from forgetmimic_jax.motion.converting import breadth_first, converted
from forgetmimic_jax.motion.kinematics import resample
from forgetmimic_jax.motion.plausible import check_plausible, doubt_of
from forgetmimic_jax.motion.readers import read_motion
from forgetmimic_jax.motion.recording import Reading, Recording
from forgetmimic_jax.robot.model import load_robot


@pytest.fixture(scope="module", params=["g1", "h2", "samples"])
def clips(request):
    """A robot, and real clips of it."""
    if request.param != "samples":
        robot = load_robot(request.param)
        return robot, library.read_library(robot)
    folder, robot = request.getfixturevalue("samples"), request.getfixturevalue("robot")
    files = sorted(path for path in folder.iterdir() if path.suffix in (".csv", ".npz", ".pkl"))
    return robot, [
        read_motion(robot, file, Reading(fps=60.0 if file.suffix == ".csv" else None)).clip for file in files
    ]


def recorded(clip, **changes):
    fields = {"joint_pos": clip.joint_pos, "root_pos": clip.root_pos, "root_quat": clip.root_quat}
    return Recording(**{**fields, **changes}, quaternion="wxyz", fps=clip.fps)


def wrong(robot, clip):
    """The clip's numbers under other conventions, with the flags that read them; none where no flag does."""
    down = Rotation.from_euler("x", -90, degrees=True)
    turned = (down * Rotation.from_quat(clip.root_quat, scalar_first=True)).as_quat(scalar_first=True)
    order = [robot.joint_names.index(joint) for joint in breadth_first(robot)]
    yield "--quaternion xyzw", recorded(clip, root_quat=np.roll(clip.root_quat, -1, axis=1))
    yield "--up y", recorded(clip, root_pos=down.apply(clip.root_pos), root_quat=turned)
    yield "--joint-order isaac", recorded(clip, joint_pos=clip.joint_pos[:, order])
    yield "--unit cm", recorded(clip, root_pos=100 * clip.root_pos)
    yield "--unit mm", recorded(clip, root_pos=1000 * clip.root_pos)
    yield "--angles degrees", recorded(clip, joint_pos=np.degrees(clip.joint_pos))
    yield (
        "--unit cm --angles degrees",
        recorded(clip, root_pos=100 * clip.root_pos, joint_pos=np.degrees(clip.joint_pos)),
    )
    yield "", recorded(clip, joint_pos=clip.joint_pos[:, ::-1])
    yield "", recorded(clip, joint_pos=np.roll(clip.joint_pos, -12, axis=1))
    yield "", recorded(clip, root_quat=np.roll(clip.root_quat, 1, axis=1))


def test_real_clips_leave_no_doubt_and_wrong_readings_are_refused(clips, tmp_path):
    robot, real = clips
    path = tmp_path / "clip.csv"
    for clip in real:
        assert doubt_of(robot, clip).size < plausible.GOOD, clip.name
        assert check_plausible(robot, recorded(clip), Reading(), clip, path) == [], clip.name
        for flags, recording in wrong(robot, clip):
            read, _ = converted(robot, recording, Reading(), clip.fps, path)
            with pytest.raises(InputError) as caught:
                check_plausible(robot, recording, Reading(), read, path)
            if flags:
                assert str(caught.value).endswith(f": {flags}"), clip.name


def test_a_rough_retarget_is_no_other_robot_s_motion(clips, tmp_path):
    """At 30 Hz, joints noisy by 0.02 rad, the root by 1 cm, its path a third too long: notes at most."""
    robot, real = clips
    rng = np.random.default_rng(0)
    for clip in real:
        slow = resample(clip, 30.0)
        rough = dataclasses.replace(
            slow,
            joint_pos=slow.joint_pos + rng.normal(0.0, 0.02, slow.joint_pos.shape),
            root_pos=slow.root_pos * [1.3, 1.3, 1.0]
            + gaussian_filter1d(rng.normal(0.0, 0.05, (slow.num_frames, 3)), 4.0, axis=0),
        )
        assert check_plausible(robot, recorded(rough), Reading(), rough, tmp_path / "clip.csv") == [], clip.name


def test_swapped_sides_are_noticed(clips, tmp_path):
    """In every clip but the walk whose feet skate as much as when it is swapped (yanjie)."""
    robot, real = clips
    for clip in real:
        swapped = dataclasses.replace(clip, joint_pos=clip.joint_pos[:, robot.counterpart])
        recording = recorded(swapped)
        try:
            notes = check_plausible(robot, recording, Reading(), swapped, tmp_path / "clip.csv")
        except InputError:
            continue
        assert any("left and right look swapped" in note for note in notes) or "yanjie" in clip.name, clip.name


def test_a_doubt_by_hand(robot):
    """The default pose 1 m too high that glides at 0.6 m/s, one joint 0.3 rad beyond its range."""
    frames = 60
    default = np.tile(np.asarray(robot.arrays.default_joint_pos, np.float64), (frames, 1))
    default[:, 20] = robot.joint_upper[20] + 0.3
    path = np.stack([0.01 * np.arange(frames), np.zeros(frames), np.full(frames, robot.default_height)], axis=-1)
    (clip,) = library.read_library(robot, None, ["walk"])
    still = dataclasses.replace(
        clip, fps=60.0, root_pos=path, root_quat=np.tile([1.0, 0, 0, 0], (frames, 1)), joint_pos=default
    )
    low = doubt_of(robot, still)
    high = doubt_of(robot, dataclasses.replace(still, root_pos=path + np.array([0.0, 0.0, 1.0])))
    assert low.limit == pytest.approx(0.3)
    assert (low.slide, low.travel) == pytest.approx((0.6, 0.6))
    assert low.wander == pytest.approx(0.0, abs=1e-9)
    assert high.level == pytest.approx(low.level + 1.0)
    assert low.size == pytest.approx(0.3 / 0.15 + abs(low.level) / 0.3 + 0.6 / 0.3)
    assert low.size_at_scale == pytest.approx(low.size - 0.3 * 0.6 / 0.3)
