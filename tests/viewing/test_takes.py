import dataclasses

import jax
import numpy as np
import pytest

from forgetmimic_jax.evaluation.metrics import episode_metrics
from forgetmimic_jax.evaluation.rollout import Evaluator
from forgetmimic_jax.evaluation.side_by_side import SideBySide, push
from forgetmimic_jax.viewing.takes import Take, at, in_words, record, reference_qpos


def test_what_is_shown_is_what_the_evaluation_measures(library, tiny_setup, policy, episodes):
    evaluator = Evaluator(tiny_setup, episodes=1, seed=3)
    for name, networks in (("zero_action", None), ("random", policy)):
        rollout = evaluator.rollout(networks)
        tracking = episode_metrics(rollout)["survival_weighted_tracking"]
        for episode in episodes:
            row = library.names.index(episode.clip)
            take = episode.takes[name]
            assert len(take.tracking_reward) == rollout.horizon[row]
            assert (take.ended or rollout.horizon[row]) == rollout.length[row]
            assert take.survival_weighted_tracking == pytest.approx(tracking[row], abs=1e-6)


def test_an_episode_does_not_depend_on_which_clips_are_chosen(tiny_setup, episodes):
    (alone,) = record(tiny_setup, {"zero_action": None}, ["sway"], ["turn"], seed=3)
    np.testing.assert_array_equal(alone.takes["zero_action"].qpos, episodes[1].takes["zero_action"].qpos)


def test_every_policy_starts_from_the_same_configuration_and_then_goes_its_own_way(episodes):
    for episode in episodes:
        zero, random = episode.takes.values()
        np.testing.assert_array_equal(zero.qpos[0], random.qpos[0])
        assert np.abs(zero.qpos[1] - random.qpos[1]).max() > 1e-5
        hold = 150 if episode.clip == "turn" else 0  # a target runs on for 3 s
        assert len(zero.qpos) == len(episode.reference) == len(zero.impact) + 1 == len(zero.tracking_reward) + 1 + hold


def test_a_target_runs_on_while_its_last_frame_is_held_and_the_robot_falls(robot, library, episodes):
    turn, sway = episodes
    assert (turn.target, sway.target) == (True, False)
    np.testing.assert_array_equal(turn.reference[:41], reference_qpos(robot, library, 1))
    np.testing.assert_array_equal(turn.reference[41:], np.tile(turn.reference[40], (150, 1)))
    for take in turn.takes.values():
        assert take.ended is not None
        assert take.ended < take.fell < 150
        below = take.qpos[:, 2] < 0.38  # half of the standing height; the robot may be tilted before
        assert take.fell <= below.argmax() < take.fell + 50
        assert take.impact[: take.ended].max() == 0.0
        assert take.impact.max() > 1.0


def test_an_episode_in_words():
    def words(policy: str, target: bool, fell: float | None, impact: float = 0.0, ended: float | None = 0.4):
        return in_words(policy, target=target, ended=ended, fell=fell, now=2.0, impact=impact)

    assert words("stand", True, None) == ("forgets the motion at 0.40 s", "stands 2.00 s")
    assert words("arft", True, 0.6, 7.25) == (
        "forgets the motion at 0.40 s",
        "falls at 0.60 s, impact 7.2 times its weight",
    )
    assert words("base", True, None) == ("leaves the motion at 0.40 s", "stands 2.00 s")
    assert words("stand", False, None) == ("leaves the motion at 0.40 s", "stands 2.00 s")
    assert words("stand", True, None, ended=None) == ("", "stands 2.00 s")


def test_words_know_nothing_of_what_comes_later(episodes):
    take = episodes[0].takes["random"]
    assert at(episodes[0], "random", take.ended - 1) == ("", f"stands {(take.ended - 1) / 50:.2f} s")
    follows, stands = at(episodes[0], "random", take.fell)
    assert follows == f"forgets the motion at {take.ended / 50:.2f} s"
    assert stands.startswith(f"falls at {take.fell / 50:.2f} s")


def test_the_reference_is_the_clip_itself(robot, library):
    qpos = reference_qpos(robot, library, 1)
    assert qpos.shape == (41, 7 + robot.num_joints)
    # `turn` walks at 0.2 m/s and turns by 1 rad/s, from the default pose's height.
    assert np.linalg.norm(qpos[1, :2] - qpos[0, :2]) == pytest.approx(0.2 / 50.0, rel=1e-3)
    yaw = 2.0 * np.arctan2(qpos[40, 6], qpos[40, 3])
    assert yaw == pytest.approx(0.8, abs=1e-2)


def test_zeros_count_after_the_end():
    reward = np.array([0.8, 0.6, 0.9, 0.9])
    take = Take(qpos=np.zeros((5, 36)), tracking_reward=reward, ended=2, fell=None, impact=np.zeros(4))
    assert take.survival_weighted_tracking == pytest.approx(1.4 / 4)
    assert dataclasses.replace(take, ended=None).survival_weighted_tracking == pytest.approx(3.2 / 4)


def test_a_push_changes_the_roots_velocity_alone(tiny_setup):
    stage = SideBySide(tiny_setup, {"zero_action": None})
    state = stage.begin([0], [5])
    pushed = push(state, [1.0, -2.0, 0.5])
    change = np.asarray(pushed.physics.qvel - state.physics.qvel)
    np.testing.assert_allclose(change[0, :3], [1.0, -2.0, 0.5], atol=1e-6)
    assert not change[0, 3:].any()
    for old, new in zip(jax.tree.leaves(state), jax.tree.leaves(push(state, np.zeros(3))), strict=True):
        np.testing.assert_array_equal(old, new)
