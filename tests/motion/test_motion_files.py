"""Every kind of motion file that users have, and what an import does with it.

Once with files made here of a shipped clip, once with those of ../shared/cases, made of a clip of another project.
"""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from motion_files import write_all

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion import library
from forgetmimic_jax.motion.importing import import_motion
from forgetmimic_jax.motion.recording import Reading

CASES = Path(__file__).resolve().parents[3] / "shared" / "cases"
SAME = [
    *("ok", "header", "frame_column", "bom_crlf", "trailing_comma", "semicolons", "tabs", "spaces", "decimal_comma"),
    *("utf16", "isaac_joint_order_header", "quat_signs_flip", "quat_norm_1.03", "shoulder_wraps_2pi"),
    *("hip_yaw_plus_2pi", "floats_0.10", "sinks_0.05"),
]
# What the refusal names, and the flags that read the file: then it is the same clip.
MENDED = {
    "wxyz": ("--quaternion wxyz", {"quaternion": "wxyz"}),
    "y_up": ("--up y", {"up": "y"}),
    "millimetres": ("--unit mm", {"unit": "mm"}),
    "centimetres": ("--unit cm", {"unit": "cm"}),
    "degrees": ("--angles degrees", {"angles": "degrees"}),
    "isaac_joint_order_no_names": ("--joint-order isaac", {"joint_order": "isaac"}),
}


@pytest.fixture(scope="module", params=["ours", "shared"])
def cases(request, robot, tmp_path_factory):
    """The folder of files, and their rate in Hz."""
    folder = tmp_path_factory.mktemp(request.param)
    if request.param == "ours":
        (clip,) = library.read_library(robot, None, ["dance_b"])
        write_all(folder, robot, clip)
        return folder, clip.fps
    if not (CASES / "make.py").is_file():
        pytest.skip("the cases are not committed: no ../shared/cases beside this checkout")
    spec = importlib.util.spec_from_file_location("make_cases", CASES / "make.py")
    module = importlib.util.module_from_spec(spec)
    sys.dont_write_bytecode, before = True, sys.dont_write_bytecode
    try:
        spec.loader.exec_module(module)
    finally:
        sys.dont_write_bytecode = before
    module.main(folder)
    return folder, 60.0


@pytest.fixture(scope="module")
def brought_in(cases, robot):
    """brought_in(name, options) -> the import of a file."""
    folder, fps = cases

    def call(name, **options):
        file = next(folder.glob(f"{name}.*[a-z]"))
        return import_motion(robot, file, Reading(**{"fps": fps if file.suffix == ".csv" else None, **options}))

    return call


@pytest.fixture(scope="module")
def ok(brought_in):
    return brought_in("ok").clip


@pytest.fixture
def refusal(brought_in):
    """refusal(name, options) -> the one line."""

    def call(name, **options):
        with pytest.raises(InputError) as caught:
            brought_in(name, **options)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    return call


def assert_same(found, ok, atol=1.1e-5):
    """The same clip: 1e-5, and quaternions up to their sign."""
    assert found.num_frames == ok.num_frames
    np.testing.assert_allclose(found.root_pos, ok.root_pos, atol=atol)
    np.testing.assert_allclose(found.joint_pos, ok.joint_pos, atol=atol)
    np.testing.assert_allclose(np.abs(np.sum(found.root_quat * ok.root_quat, axis=-1)), 1.0, atol=1e-6)


@pytest.mark.parametrize("name", SAME)
def test_the_same_clip_by_every_way_of_writing_it(brought_in, ok, name):
    assert_same(brought_in(name).clip, ok)


def test_names_that_are_python_objects(brought_in, ok):
    found = brought_in("names_as_objects")
    assert_same(found.clip, ok, atol=2e-5)
    assert any("joint_vel fits" in note for note in found.notes)


@pytest.mark.parametrize("name", MENDED)
def test_another_convention_is_named_with_the_flag_that_reads_it(brought_in, refusal, ok, name):
    flag, options = MENDED[name]
    assert refusal(name).endswith(flag)
    assert_same(brought_in(name, **options).clip, ok, atol=2e-5)


def test_heights_are_shifted_and_it_is_said(brought_in):
    """The shift of each file against that of the clean one."""
    clean = brought_in("ok").facts["raised"]
    for name, shift in (("floats_0.10", -0.10), ("sinks_0.05", 0.05)):
        found = brought_in(name)
        assert found.facts["raised"] == pytest.approx(clean + shift, abs=2e-5)
        direction = "raised" if found.facts["raised"] > 0 else "lowered"
        assert f"heights: the whole clip is {direction} by {abs(found.facts['raised']):.3f} m" in found.notes


def test_a_height_that_drifts_is_said(brought_in):
    """Soles that rise by 0.3 m: in the last second no point is lower than 0.2 m."""
    assert any("no point touches the ground" in note for note in brought_in("height_drifts_0.3").notes)
    assert not any("no point touches" in note for note in brought_in("ok").notes)


def test_frames_that_no_body_moves_through(brought_in, refusal, ok, cases):
    """The second half of each file is bad from its first frame on; the first half is the clean clip's."""
    frames = {50.0: 250, 60.0: 233}[cases[1]]
    second = f"({frames / cases[1]:.2f} s)"
    assert f"by 1.50 m and 1 degrees from frame {frames - 1} to {frames} {second}" in refusal("teleports_1.5m")
    assert f"joint_pos: NaN or infinity in frame {frames} {second}" in refusal("nan")
    assert f"from frame 0 to 1 ({1 / cases[1]:.2f} s); the longest part without a jump: --start 0.02" in refusal(
        "glitch_first_frame"
    )
    spike = brought_in("elbow_spike_3_frames")
    assert any("left_elbow_joint jumps by" in note and f"frame {frames} {second}" in note for note in spike.notes)
    half = {"end": 3.0}
    clean = brought_in("ok", **half).clip
    for name in ("teleports_1.5m", "nan", "elbow_spike_3_frames"):
        assert_same(brought_in(name, **half).clip, clean)
    later = {"start": 1.0}
    assert_same(brought_in("glitch_first_frame", **later).clip, brought_in("ok", **later).clip)


def test_sides_that_are_swapped_are_warned_of(brought_in):
    warnings = [note for note in brought_in("sides_swapped_without_signs").notes if note.startswith("warning")]
    assert len(warnings) == 1
    assert "left and right look swapped" in warnings[0]
    assert "skate" in warnings[0]
    assert not any(note.startswith("warning") for note in brought_in("ok").notes)


def test_fewer_joints(brought_in, refusal, robot, ok):
    assert "--fill-missing" in refusal("23_joints")
    found = brought_in("23_joints", fill_missing=True)
    missing = ["waist_roll", "waist_pitch"] + [
        f"{side}_wrist_{axis}" for side in ("left", "right") for axis in ("pitch", "yaw")
    ]
    assert any(note.endswith(", ".join(f"{joint}_joint" for joint in missing)) for note in found.notes)
    for place, joint in enumerate(robot.joint_names):
        filled = joint.removesuffix("_joint") in missing
        expected = np.asarray(robot.arrays.default_joint_pos)[place] if filled else ok.joint_pos[:, place]
        np.testing.assert_allclose(found.clip.joint_pos[:, place], expected, atol=1e-5)


def test_too_short(brought_in, refusal):
    assert "1 frame(s)" in refusal("one_frame")
    assert "at least 0.5 s" in refusal("two_frames")
    assert brought_in("half_second").clip.num_frames == 25
    assert "empty" in refusal("empty")


def test_a_git_lfs_pointer(refusal):
    assert refusal("git_lfs_pointer").endswith("this is a Git LFS pointer, not the file: run git lfs pull")
