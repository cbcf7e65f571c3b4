import dataclasses

import numpy as np
import pytest

from forgetmimic_jax.viewing.playback import AFTER_END_SECONDS, Playback
from forgetmimic_jax.viewing.side_by_side import SideBySide, record


@pytest.fixture(scope="module")
def stage(tiny_setup, policy) -> SideBySide:
    return SideBySide(tiny_setup, {"zero_action": None, "random": policy})


@pytest.fixture
def playback(stage, robot) -> Playback:
    return Playback(stage, robot, clip=1, seed=3)


def test_it_shows_the_episode_that_a_film_of_the_same_start_shows(playback, library, tiny_setup, policy):
    # Alone in its library, a clip's noise is drawn for one start, as the playback's is.
    import jax

    alone = jax.tree.map(lambda values: values[1:], library).replace(names=library.names[1:])
    setup = dataclasses.replace(tiny_setup, library=alone)
    (episode,) = record(setup, {"zero_action": None, "random": policy}, ["turn"], seed=3)
    while playback.step < playback.horizon:
        playback.advance()
    for row, take in enumerate(episode.takes.values()):
        assert playback.ended[row] == take.ended
        np.testing.assert_allclose(playback.qpos[row], take.qpos[-1], atol=1e-5)
        tracking = np.array(playback.tracking)[:, row]
        assert tracking.mean() == pytest.approx(take.survival_weighted_tracking, abs=1e-6)
    assert len(playback.height) == playback.horizon + 1
    np.testing.assert_allclose(playback.height[-1], [*playback.qpos[:, 2], episode.reference[-1, 2]], atol=1e-6)


def test_it_stops_at_the_clips_end_and_begins_again_where_it_began(playback):
    first = playback.qpos.copy()
    for _ in range(playback.horizon + 3):
        playback.advance()
    assert (playback.step, playback.done) == (40, True)
    playback.begin(1)
    np.testing.assert_array_equal(playback.qpos, first)
    assert (playback.step, playback.done, playback.tracking, playback.ended) == (0, False, [], [None, None])
    playback.begin(0)
    assert (playback.clip, playback.horizon) == (0, 79)


def test_it_is_done_a_while_after_every_policy_lost_the_motion(playback):
    playback.horizon = 1000
    playback.ended = [4, 30]
    after = round(AFTER_END_SECONDS / playback.control_step)
    for playback.step, done in ((30, False), (29 + after, False), (30 + after, True)):
        assert playback.done == done
    playback.ended = [4, None]
    assert not playback.done


def test_a_push_moves_every_robot_the_same_way(stage, robot, playback):
    pushed = Playback(stage, robot, clip=1, seed=3)
    pushed.push(np.array([2.0, 0.0, 0.0]))
    playback.advance()
    pushed.advance()
    moved = pushed.qpos[:, 0] - playback.qpos[:, 0]
    np.testing.assert_allclose(moved, 2.0 * 0.02, atol=0.02)
    assert (moved > 0.02).all()
