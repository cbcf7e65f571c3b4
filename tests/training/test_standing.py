"""Who teaches to stand: the base, where it can. The training of one that cannot is in the tests of the command."""

import dataclasses
import shutil

import numpy as np
import pytest

from forgetmimic_jax.evaluation.metrics import Rollout
from forgetmimic_jax.motion.library import only_clips
from forgetmimic_jax.settings.config import save_config
from forgetmimic_jax.training import standing
from forgetmimic_jax.training.checkpoint import META
from forgetmimic_jax.training.standing import standing_teacher, upright_rate

LENGTH = np.array([*[250] * 19, 249])  # of twenty episodes, one of which ends a step early


@pytest.fixture
def evaluated(monkeypatch) -> dict:
    """The setup that is evaluated, and how long each episode of 250 steps is."""
    seen = {"length": LENGTH}

    class Evaluator:
        def __init__(self, setup, *, episodes, seed, rule):
            seen.update(setup=setup, episodes=episodes, rule=rule)

        def rollout(self, policy) -> Rollout:
            length = seen["length"]
            return Rollout(0 * length, 0 * length, 0 * length + 250, length, np.ones((len(length), 250)))

    monkeypatch.setattr(standing, "Evaluator", Evaluator)
    return seen


@pytest.fixture
def setup(tiny_setup):
    """`turn` is to be forgotten."""
    unlearn = dataclasses.replace(tiny_setup.config.unlearn, targets=("turn",), settings={"stand_iterations": 6.0})
    config = dataclasses.replace(tiny_setup.config, unlearn=unlearn)
    return dataclasses.replace(tiny_setup, config=config, base=object())


def test_a_base_is_measured_in_the_targets_states_with_the_stand_as_its_reference(setup, evaluated):
    assert upright_rate(setup, None) == 0.95
    assert (evaluated["setup"].library.names, evaluated["episodes"]) == (("turn",), 20)
    assert (evaluated["rule"].replace_reference, evaluated["rule"].runs_on) == (True, 3.0)


def test_a_base_that_stays_upright_is_the_teacher(setup, evaluated, tmp_path, capsys):
    assert standing_teacher(setup, tmp_path / "run") is setup.base
    assert not list(tmp_path.iterdir())
    said = "with the stand as the reference, the base stays upright in 95% of the targets' episodes\n"
    assert capsys.readouterr().out == said


@pytest.fixture
def runs(evaluated, monkeypatch) -> list:
    """The trainings that begin. Before the first of them one episode in ten ends early."""
    evaluated["length"] = np.array([*LENGTH[1:], 3])
    begun: list = []

    def run(setup, folder, *, description, resume, rule):
        begun.append((setup, folder, resume, rule))
        evaluated["length"] = evaluated.get(len(begun), LENGTH)
        last = folder / "checkpoints" / f"{setup.config.iterations:08d}"
        last.mkdir(parents=True)
        (last / META).touch()
        save_config(setup.config, folder / "config.yaml")
        return folder, type("State", (), {"policy": f"taught by {len(begun)}"})

    monkeypatch.setattr(standing, "run", run)
    return begun


def test_a_base_that_falls_more_often_learns_it_from_the_targets_states(setup, runs, tmp_path):
    assert standing_teacher(setup, tmp_path / "run") == "taught by 1"
    [(learning, folder, resume, rule)] = runs
    assert (folder, resume, rule.replace_reference) == (tmp_path / "run-stand", False, True)
    config = learning.config
    assert (config.iterations, config.sampling.target_share, config.ppo.base_kl) == (6, 1.0, 0.0)
    starts = config.sampling  # most of them where it fails
    assert (starts.rule, starts.bin_seconds, starts.uniform_ratio) == ("adaptive", 0.3, 0.1)
    assert (starts.smoothing, starts.first_frame) == (0.05, 0.5)
    assert (config.ppo.learning_rate, config.max_episode_steps) == (3e-4, 100)  # the teacher's own
    assert config.unlearn == setup.config.unlearn
    assert learning.library is setup.library


def test_one_that_still_falls_learns_for_half_as_long_again(setup, evaluated, runs, tmp_path, capsys):
    evaluated[1] = np.array([*LENGTH[2:], 3, 9])  # 17 of 20 to the end, less than 92 %
    assert standing_teacher(setup, tmp_path / "run") == "taught by 2"
    assert [(of.config.iterations, resume) for of, _, resume, _ in runs] == [(6, False), (9, True)]
    assert runs[0][1] == runs[1][1]  # the second continues the first
    assert [of.config.sampling.first_frame for of, *_ in runs] == [0.5, 0.2]
    said = capsys.readouterr().out.splitlines()
    assert said[-2:] == [
        "it stays upright in 85% now; it goes on for half as many iterations",
        "after training it stays upright in 95%",
    ]


def test_one_that_still_falls_after_that_is_the_teacher_all_the_same(setup, evaluated, runs, tmp_path):
    evaluated[1] = evaluated[2] = np.full(20, 3)
    assert standing_teacher(setup, tmp_path / "run") == "taught by 2"


def test_a_longer_training_that_was_stopped_continues_as_such(setup, evaluated, runs, tmp_path):
    evaluated[1] = evaluated[2] = evaluated[3] = np.full(20, 3)
    standing_teacher(setup, tmp_path / "run")
    shutil.rmtree(tmp_path / "run-stand" / "checkpoints" / "00000009")
    assert standing_teacher(setup, tmp_path / "run") == "taught by 3"
    assert [(of.config.iterations, resume) for of, _, resume, _ in runs[2:]] == [(9, True)]


def test_a_library_of_only_some_clips_has_their_frames_alone(library):
    turn = only_clips(library, ["turn"])
    assert (turn.names, turn.frames.joint_pos.shape[0], int(turn.length[0])) == (("turn",), 41, 41)
    np.testing.assert_array_equal(turn.frames.joint_pos, library.clip(1).joint_pos)
    both = only_clips(library, ["turn", "sway"])
    np.testing.assert_array_equal(both.length, [41, 80])
