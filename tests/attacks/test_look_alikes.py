"""Dynamic time warping by hand and against a plain recursion; segments, and what policies do in them."""

import functools

import numpy as np
import pytest

from forgetmimic_jax.attacks import look_alikes, warping
from forgetmimic_jax.attacks.look_alikes import SegmentPair
from forgetmimic_jax.attacks.warping import Segment
from forgetmimic_jax.evaluation.metrics import Rollout
from forgetmimic_jax.motion.clip import Clip


def motion(*values: float) -> np.ndarray:
    """One motion of one joint, [1, frame, 1]."""
    return np.array(values)[None, :, None]


def clip(name: str, joints: np.ndarray) -> Clip:
    frames = len(joints)
    return Clip(
        name, 50.0, ("a",), np.zeros((frames, 3)), np.tile([1.0, 0, 0, 0], (frames, 1)), joints[:, None].astype(float)
    )


@pytest.mark.parametrize(
    ("one", "other", "distance"),
    [
        ((0, 1), (0, 1), 0.0),
        ((0, 2), (0, 0, 2, 2), 0.0),  # the same at half the speed
        ((0, 0), (1, 1), 1.0),  # 2 · 1 + 2 · 1 over 4 frames
        ((0, 1, 2), (0, 2), 0.2),  # 0 and 0 in both, 1 in the first alone: 0 + 1 + 2 · 0 over 5 frames
        ((0,), (3, 3, 3), 3.0),  # 2 · 3 + 3 + 3 over 4 frames
    ],
)
def test_warped_distance_by_hand(one, other, distance):
    assert warping.warped_distance(motion(*one), motion(*other)) == pytest.approx([distance])


def test_a_frames_cost_is_the_root_mean_square_over_joints():
    one, other = np.zeros((1, 1, 2)), np.array([[[3.0, 4.0]]])
    assert warping.warped_distance(one, other) == pytest.approx([np.sqrt(12.5)])


def test_warped_distance_is_that_of_a_plain_recursion():
    random = np.random.default_rng(0)
    one, other = random.standard_normal((3, 6, 4)), random.standard_normal((3, 5, 4))
    found = warping.warped_distance(one, other)
    for pair in range(3):

        @functools.cache
        def total(i: int, j: int, pair: int = pair) -> float:
            cost = float(np.sqrt(np.mean((one[pair, i] - other[pair, j]) ** 2)))
            ways = [total(i - 1, j) + cost] if i else []
            ways += [total(i, j - 1) + cost] if j else []
            ways += [total(i - 1, j - 1) + 2 * cost] if i and j else []
            return min(ways) if ways else 2 * cost

        assert found[pair] == pytest.approx(total(5, 4) / 11)


def test_segments_of_a_second_overlap_by_half():
    assert warping.segments(clip("long", np.zeros(110))) == [
        Segment("long", 0, 50), Segment("long", 25, 75), Segment("long", 50, 100)
    ]  # fmt: skip
    assert warping.segments(clip("short", np.zeros(20))) == [Segment("short", 0, 20)]


def test_a_kept_segments_distance_is_to_the_nearest_target():
    targets = [clip("t1", np.full(50, 1.0)), clip("t2", np.full(20, 4.0))]
    found = warping.distances([clip("kept", np.r_[np.full(50, 1.5), np.full(50, 3.8)])], targets)
    assert found[Segment("kept", 0, 50)] == pytest.approx(0.5)
    assert found[Segment("kept", 50, 100)] == pytest.approx(0.2)


def test_near_segments_meet_far_ones_of_their_difficulty():
    near, middle, far, other = (Segment(name, 0, 50) for name in ("near", "middle", "far", "other"))
    distance = {near: 0.1, middle: 0.5, far: 0.9, other: 0.8, Segment("unseen", 0, 50): 0.0}
    difficulty = {near: 0.7, middle: 0.7, far: 0.2, other: 0.6}
    assert look_alikes.matched(distance, difficulty, count=1) == [SegmentPair(near, other, 0.1, 0.8)]
    pairs = look_alikes.matched(distance, difficulty, count=8)
    assert [(pair.near, pair.far) for pair in pairs] == [(near, other), (middle, far)]


def test_a_clip_that_repeats_itself_is_not_all_of_the_nearest():
    cycles = [Segment("walk", 25 * place, 25 * place + 50) for place in range(4)]
    others = [Segment(name, 0, 50) for name in ("a", "b", "c", "d")]
    distance = {segment: 0.1 + 0.01 * place for place, segment in enumerate([*cycles, *others])}
    pairs = look_alikes.matched(distance, dict.fromkeys(distance, 0.5), count=3)
    assert [pair.near for pair in pairs] == [cycles[0], cycles[1], others[0]]
    assert {pair.far for pair in pairs} <= {*cycles[2:], *others[1:]}


@pytest.fixture
def rollouts() -> dict[str, Rollout]:
    """Three episodes of one clip from the frames 0, 0 and 6; the reward of step t is t / 10."""
    start, horizon = np.array([0, 0, 6]), np.array([9, 9, 3])
    reward = np.tile(np.arange(9) / 10.0, (3, 1))

    def of(*length: int) -> Rollout:
        return Rollout(np.zeros(3, int), start, horizon, np.array(length), reward)

    return {"base": of(9, 9, 3), "unlearned": of(6, 2, 3)}


def test_tracking_in_a_segment_counts_who_was_still_there(rollouts):
    # Frames 5 to 7 are tracked at the steps 4, 5 and 6 of the first episode, and at the step 0 of the third, which
    # starts at frame 6. The second has fallen before. The unlearned policy misses the first's step 6.
    found = look_alikes.tracking_in(rollouts, ["clip"], Segment("clip", 5, 8))
    assert found["base"] == pytest.approx((0.4 + 0.5 + 0.6 + 0.0) / 4)
    assert found["unlearned"] == pytest.approx((0.4 + 0.5 + 0.0) / 4)


def test_a_segment_that_too_few_episodes_reach_has_no_tracking(rollouts):
    rollouts["unlearned"] = Rollout(
        np.zeros(3, int), np.array([0, 0, 6]), np.array([9, 9, 3]), np.array([1, 2, 3]), np.zeros((3, 9))
    )
    assert look_alikes.tracking_in(rollouts, ["clip"], Segment("clip", 5, 8)) == {}
