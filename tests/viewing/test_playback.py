import dataclasses

import numpy as np
import pytest

from forgetmimic_jax.evaluation.side_by_side import SideBySide
from forgetmimic_jax.motion.library import only_clips
from forgetmimic_jax.viewing.playback import Playback
from forgetmimic_jax.viewing.takes import record


@pytest.fixture(scope="module")
def stage(tiny_setup, policy) -> SideBySide:
    return SideBySide(tiny_setup, {"zero_action": None, "random": policy})


@pytest.fixture
def playback(stage) -> Playback:
    return Playback(stage, clip=1, seed=3)


def test_it_shows_the_episode_that_a_film_of_the_same_start_shows(playback, library, tiny_setup, policy):
    # Alone in its library, a clip's noise is drawn for one start, as the playback's is.
    setup = dataclasses.replace(tiny_setup, library=only_clips(library, ["turn"]))
    (episode,) = record(setup, {"zero_action": None, "random": policy}, ["turn"], ["turn"], seed=3)
    while not playback.done:
        playback.advance()
    for row, take in enumerate(episode.takes.values()):
        assert (playback.ended[row], playback.fell[row]) == (take.ended, take.fell)
        assert playback.impact[row] == pytest.approx(take.impact.max(), rel=1e-4)
        np.testing.assert_allclose(playback.qpos[row], take.qpos[-1], atol=1e-5)
        tracking = np.array(playback.tracking)[: playback.horizon, row]
        assert tracking.mean() == pytest.approx(take.survival_weighted_tracking, abs=1e-6)
    assert len(playback.height) == len(episode.reference) == playback.horizon + 150 + 1
    np.testing.assert_allclose(playback.height[-1], [*playback.qpos[:, 2], episode.reference[-1, 2]], atol=1e-6)


def test_it_stops_3_s_after_the_clips_end_and_begins_again_where_it_began(playback):
    first = playback.qpos.copy()
    for _ in range(playback.horizon + 153):
        playback.advance()
    assert (playback.step, playback.done) == (190, True)
    assert None not in playback.fell
    playback.begin(1)
    np.testing.assert_array_equal(playback.qpos, first)
    assert (playback.step, playback.done, playback.tracking) == (0, False, [])
    assert playback.ended == playback.fell == [None, None]
    assert not playback.impact.any()
    playback.begin(0)
    assert (playback.clip, playback.horizon) == (0, 79)


def test_a_push_moves_every_robot_the_same_way(stage, playback):
    pushed = Playback(stage, clip=1, seed=3)
    pushed.push(np.array([2.0, 0.0, 0.0]))
    playback.advance()
    pushed.advance()
    moved = pushed.qpos[:, 0] - playback.qpos[:, 0]
    np.testing.assert_allclose(moved, 2.0 * 0.02, atol=0.02)
    assert (moved > 0.02).all()
