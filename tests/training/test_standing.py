"""Who teaches to stand: the base, where it can. The training of one that cannot is in the tests of the command."""

import dataclasses

import numpy as np
import pytest

from forgetmimic_jax.evaluation.metrics import Rollout
from forgetmimic_jax.motion.library import only_clips
from forgetmimic_jax.tracking.stand import stand_frame
from forgetmimic_jax.training import standing
from forgetmimic_jax.training.standing import stand_success, standing_teacher


@pytest.fixture
def evaluated(monkeypatch) -> dict:
    """The setup that is evaluated; `length` steps of 250 are completed in each of four episodes."""
    seen = {"length": np.array([250, 250, 250, 249])}

    class Evaluator:
        def __init__(self, setup, *, episodes, seed):
            seen.update(setup=setup, episodes=episodes)

        def rollout(self, policy) -> Rollout:
            length = seen["length"]
            return Rollout(0 * length, 0 * length, 0 * length + 250, length, np.ones((len(length), 250)))

    monkeypatch.setattr(standing, "Evaluator", Evaluator)
    return seen


def test_a_base_is_measured_on_a_stand_of_five_seconds(tiny_setup, robot, evaluated):
    assert stand_success(tiny_setup, None) == 0.75
    library = evaluated["setup"].library
    assert (library.names, int(library.length[0]), evaluated["episodes"]) == (("stand",), 251, 20)
    np.testing.assert_array_equal(library.clip(0).joint_pos[250], stand_frame(robot).joint_pos)


def test_a_base_that_stands_is_the_teacher(tiny_setup, evaluated, tmp_path, capsys):
    base = object()
    assert standing_teacher(dataclasses.replace(tiny_setup, base=base), tmp_path / "run") is base
    assert not list(tmp_path.iterdir())
    assert capsys.readouterr().out == "the base completes 75% of 20 episodes of the stand\n"


def test_a_base_that_stands_less_often_learns_it_on_all_clips_and_the_stand(
    tiny_setup, evaluated, tmp_path, monkeypatch, library, robot
):
    evaluated["length"] = np.array([250, 250, 250, 250, 250, 250, 249, 3, 2])
    config = dataclasses.replace(
        tiny_setup.config,
        unlearn=dataclasses.replace(tiny_setup.config.unlearn, targets=("turn",), settings={"stand_iterations": 7.0}),
    )
    started = {}

    def run(setup, folder, *, description, resume):
        started.update(setup=setup, folder=folder, resume=resume)
        return folder, type("State", (), {"policy": "taught"})

    monkeypatch.setattr(standing, "run", run)
    setup = dataclasses.replace(tiny_setup, config=config, base=object())
    assert standing_teacher(setup, tmp_path / "run") == "taught"
    assert (started["folder"], started["resume"]) == (tmp_path / "run-stand", False)
    learning = started["setup"]
    assert (learning.config.iterations, learning.config.sampling.target_share) == (7, 0.5)
    assert (learning.config.unlearn.targets, learning.config.unlearn.method) == (("stand",), "finetune")
    assert learning.library.names == ("sway", "turn", "stand")
    np.testing.assert_array_equal(learning.library.length, [80, 41, 251])
    for clip in range(2):
        np.testing.assert_array_equal(learning.library.clip(clip).joint_pos, library.clip(clip).joint_pos)
    np.testing.assert_array_equal(learning.library.clip(2).joint_pos[250], stand_frame(robot).joint_pos)


def test_a_library_of_only_some_clips_has_their_frames_alone(library):
    turn = only_clips(library, ["turn"])
    assert (turn.names, turn.frames.joint_pos.shape[0], int(turn.length[0])) == (("turn",), 41, 41)
    np.testing.assert_array_equal(turn.frames.joint_pos, library.clip(1).joint_pos)
    both = only_clips(library, ["turn", "sway"])
    np.testing.assert_array_equal(both.length, [41, 80])
