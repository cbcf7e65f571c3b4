"""What is said of frames that no body moves through, and which part of the clip the mend keeps."""

import pytest
from motion_cases import waving

from forgetmimic_jax.motion.roughness import spikes


@pytest.mark.parametrize(
    ("frame", "mend"),
    [
        (0, "; leave it out with --start 0.18"),
        (50, "; leave it out with --end 0.98 or --start 1.18"),
        (99, "; leave it out with --end 1.96"),
    ],
)
def test_only_parts_that_are_long_enough_are_offered_in_place_of_a_spike(robot, frame, mend):
    clip = waving(robot, "wave", 100)
    clip.joint_pos[frame, robot.joint_names.index("left_elbow_joint")] += 1.0
    (note,) = spikes(robot, clip, 0)
    assert note.startswith("left_elbow_joint jumps by")
    assert note.endswith(f"and back at frame {frame} ({frame / 50:.2f} s){mend}")
