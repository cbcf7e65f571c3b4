"""Pretraining in miniature: every phase is passed, and a run that is killed anywhere ends with the same bits."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest
from trees import assert_same

from forgetmimic_jax.attacks.control import check_never_rolled_out
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.robot.model import load_robot
from forgetmimic_jax.settings.config import PretrainConfig, UnlearnConfig
from forgetmimic_jax.tracking.env import make_assets, make_environment
from forgetmimic_jax.tracking.setup import Setup, make_setup
from forgetmimic_jax.training import checkpoint, distil, pretraining, watch
from forgetmimic_jax.training import run as run_module
from forgetmimic_jax.training.checkpoint import newest_checkpoint
from forgetmimic_jax.training.pretraining import Pretraining
from forgetmimic_jax.training.start import template
from forgetmimic_jax.unlearning.registry import unlearning_config

ITERATIONS, AVERAGE = 40, 5
# (success, tracking) of sway, turn and nod in one evaluation after the other, every two iterations.
CURVE = [
    *[((0.9, 0.6), (0.2, 0.3), (0.0, 0.1))] * 3,  # broad, until the mean stalls twice
    *[((0.9, 0.6), (0.2, 0.3), (0.0, 0.1))] * 2,  # lagging, until both that lag are stuck
    ((0.0, 0.0), (0.9, 0.5), (0.0, 0.0)),  # a specialist masters the turn
    ((0.0, 0.0), (0.0, 0.0), (0.3, 0.4)),  # one for the nod, which starts with a search
    ((0.0, 0.0), (0.0, 0.0), (0.9, 0.6)),
    ((0.9, 0.6), (0.9, 0.5), (0.8, 0.6)),  # the distilled policy: the nod's specialist did it better
    ((0.0, 0.0), (0.0, 0.0), (0.95, 0.7)),  # it continues
    ((1.0, 0.7), (1.0, 0.7), (1.0, 0.7)),  # distilled again: all mastered
]
PHASES = [*["broad"] * 3, *["lagging"] * 2, *["stuck"] * 3, "distil", "stuck", "distil"]
SPECIALISTS = {5: "turn", 6: "nod", 7: "nod", 9: "nod"}  # by row
NAMES = ("sway", "turn", "nod")


class Killed(BaseException):
    """What a kill -9 is to the code that runs: nothing is done after it."""


@pytest.fixture(scope="module")
def setup(tiny_config, library_folder) -> Setup:
    rules = PretrainConfig(average=AVERAGE, mastered=0.9, patience=2, search_rounds=5, distil_rounds=2)
    ppo = dataclasses.replace(tiny_config.ppo, schedule="adaptive_iteration", branches=2)
    config = dataclasses.replace(
        tiny_config,
        library=str(library_folder),
        iterations=ITERATIONS,
        evaluate_every=2,
        checkpoint_every=1,
        ppo=ppo,
        pretrain=rules,
    )
    return make_setup(config)


@pytest.fixture(scope="module")
def pretrain(setup) -> Callable[..., Path]:
    """`pretrain(folder, resume=..., kill=...)`: evaluations are the curve's; `kill` names where the run is killed.

    All runs share the compiled iteration and rounds. Those that are killed and resumed draw no picture.
    """
    made: dict[str, object] = {}
    results: dict[str, list] = {}

    def once(name: str, make: Callable[..., object]) -> Callable[..., object]:
        return lambda *arguments: made.setdefault(name, make(*arguments))

    def pretrain(folder: Path, *, resume: bool = False, kill: str | None = None) -> Path:
        calls: dict[str, int] = {}

        def counted(name: str, function: Callable) -> Callable:
            def call(*arguments, **more):
                calls[name] = calls.get(name, 0) + 1
                if f"{name} {calls[name]}" == kill:
                    raise Killed
                result = function(*arguments, **more)
                results.setdefault(name, []).append(result)
                return result

            return call

        def measure(self, policy, iteration, environment_steps):
            row = CURVE[len(read_rows(folder / watch.FILE))]
            clips = {
                name: {"success_rate": success, "survival_weighted_tracking": tracking}
                | {"episode_length": 20.0, "completed": success}
                for name, (success, tracking) in zip(NAMES, row, strict=True)
            }
            kept = float(np.mean([tracking for _, tracking in row]))
            return {
                "iteration": iteration,
                "environment_steps": environment_steps,
                "kept_tracking": kept,
                "clips": clips,
            }

        iterate, make_round = once("iteration", run_module.make_iteration), distil.make_round
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(distil, "make_round", lambda env, config: once(str(config), make_round)(env, config))
            if kill or resume:
                patch.setattr(watch, "clips_over_time", lambda *given: None)
            patch.setattr(watch.Watch, "measure", counted("evaluation", measure))
            patch.setattr(run_module, "make_iteration", lambda *given: counted("iteration", iterate(*given)))
            for name in ("first_failure", "search", "begin", "distil"):
                patch.setattr(pretraining, name, counted(name, getattr(pretraining, name)))
            for name in ("save_policy", "save_checkpoint"):
                patch.setattr(checkpoint, name, counted(name, getattr(checkpoint, name)))
            return run_module.run(setup, folder, description="pretrain", resume=resume, make_course=Pretraining)[0]

    pretrain.results, pretrain.made = results, made
    return pretrain


@pytest.fixture(scope="module")
def unbroken(pretrain, tmp_path_factory) -> Path:
    """The folder of a run that nothing interrupts."""
    folder = tmp_path_factory.mktemp("pretraining") / "unbroken"
    pretrain(folder)
    pretrain.unbroken = {name: list(results) for name, results in pretrain.results.items()}
    return folder


def evaluations(folder: Path) -> list[dict]:
    return read_rows(folder / watch.FILE)


def test_every_phase_is_passed(unbroken):
    rows = evaluations(unbroken)
    assert [row["phase"] for row in rows] == PHASES
    assert {number: row["specialist"] for number, row in enumerate(rows) if "specialist" in row} == SPECIALISTS
    # The distilled policy is evaluated in the iteration of the last specialist's evaluation.
    assert [row["iteration"] for row in rows] == [2, 4, 6, 8, 10, 12, 14, 16, 16, 18, 18]
    assert [rows[number]["clips"]["nod"]["state"] for number in (0, 4, 5, 6, 7)] == [
        *("new", "stuck", "new", "learning", "mastered"),
    ]


def test_the_run_ends_when_every_clip_is_mastered(unbroken):
    newest = newest_checkpoint(unbroken)
    assert newest.name == "00000018"
    info = checkpoint.read_info(newest)
    assert info.curriculum["phase"] == "done"
    assert checkpoint.read_info(unbroken / "best").iteration == 18


def test_every_step_counts(pretrain, unbroken):
    """18 iterations of 8 robots and 4 steps, a search of 5 rounds and 3 rollouts more, regressions of 2 rounds."""
    (found,), regressions = pretrain.unbroken["search"], len(pretrain.unbroken["distil"])
    expected = 18 * 8 * 4 + (5 + 1) * 8 * found.steps + regressions * 2 * 8 * 24
    assert checkpoint.read_info(newest_checkpoint(unbroken)).environment_steps == expected
    assert regressions == 2 + (found.passed > 0)


def test_the_log_has_phase_and_state_in_every_row(unbroken):
    rows = read_rows(unbroken / "metrics.jsonl")
    assert [row["phase"] for row in rows if row["iteration"] in (1, 8, 12, 18)] == ["broad", "lagging", "stuck", "done"]
    assert {row["clips"]["sway"]["state"] for row in rows if row["iteration"] > 2} == {"mastered"}
    assert (unbroken / "evaluations.png").stat().st_size > 0


def test_a_specialist_sees_its_clip_alone_and_lagging_clips_get_most(unbroken):
    rows = {row["iteration"]: row["clips"] for row in read_rows(unbroken / "metrics.jsonl")}
    assert [rows[12][name]["step_share"] for name in NAMES] == [0.0, 1.0, 0.0]
    assert [rows[14][name]["probability"] for name in NAMES] == [0.0, 0.0, 1.0]
    assert rows[7]["sway"]["probability"] == pytest.approx(0.25, abs=1e-4)


def test_what_is_evaluated_and_kept_is_averaged_over_iterations(unbroken):
    """The nod's specialist starts again from the expert, the policy of evaluation 8, at iteration 16."""
    info = checkpoint.read_info(unbroken / "checkpoints" / "00000017")
    setup = make_setup(info.config)
    env = make_environment(setup, info.config.ppo.num_envs)
    state = checkpoint.load_state(info, template(env, make_assets(setup)))
    kept = checkpoint.read_info(unbroken / "policies" / "0008")
    expert = checkpoint.load_policy(kept, setup.robot).parameters
    assert any((x != y).any() for x, y in zip(*map(jax.tree.leaves, (expert, state.policy.parameters)), strict=True))
    expected = jax.tree.map(lambda old, new: old + (new - old) / AVERAGE, expert, state.policy.parameters)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-7), state.average, expected)
    assert_same(state.averaged.parameters, state.average)


def test_no_phase_compiles_the_iteration_again(pretrain, unbroken):
    assert pretrain.made["iteration"]._cache_size() == 1


def test_policies_that_nothing_needs_are_removed(unbroken):
    """The best one is the last; the checkpoint before knows the first distilled one, and the expert of the nod."""
    assert {int(path.name) for path in (unbroken / "policies").iterdir()} == {8, 9, 11}


def test_a_clip_that_is_left_out_is_evaluated_but_never_trained_on(setup, tmp_path, monkeypatch):
    config = dataclasses.replace(setup.config, iterations=6)
    config = unlearning_config(config, UnlearnConfig(("nod",), "retrain"))

    def measure(self, policy, iteration, environment_steps):
        clips = {
            name: {"success_rate": success, "survival_weighted_tracking": success}
            | {"episode_length": 20.0, "completed": success}
            for name, success in zip(NAMES, (0.95, 0.5, 0.0), strict=True)
        }
        steps = {"iteration": iteration, "environment_steps": environment_steps}
        return steps | {"kept_tracking": 0.95, "clips": clips}

    monkeypatch.setattr(watch.Watch, "measure", measure)
    path, state = run_module.run(make_setup(config), tmp_path / "run", description="", make_course=Pretraining)
    rows = evaluations(tmp_path / "run")
    assert [row["phase"] for row in rows] == ["broad", "broad", "lagging"]
    assert checkpoint.read_info(path).curriculum["best"]["clips"].keys() == {"sway", "turn"}
    assert [name for name in NAMES if "state" in rows[-1]["clips"][name]] == ["sway", "turn"]
    log = read_rows(tmp_path / "run" / "metrics.jsonl")
    assert {(row["clips"]["nod"]["probability"], row["clips"]["nod"]["step_share"]) for row in log} == {(0.0, 0.0)}
    assert all(row["clips"][name]["probability"] > 0.0 for row in log for name in ("sway", "turn"))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state.policy))
    info = checkpoint.read_info(tmp_path / "run")
    assert (info.path.name, info.base) == ("best", None)
    check_never_rolled_out(info, ("nod",))
    with pytest.raises(InputError, match=r"unlearn.targets: found \['nod'\]; accepted for a control: \['turn'\]"):
        check_never_rolled_out(info, ("turn",))
    pretraining_ = Pretraining(make_setup(config), None, path, None, checkpoint.read_info(path))
    assert (pretraining_._indices(), pretraining_._indices("turn")) == ([0, 1], [0])


@pytest.mark.parametrize(
    "kills",
    [
        # The first iteration of a phase, of a specialist and of one that a search started; the last of all.
        ["iteration 1", "iteration 7", "iteration 5", "iteration 3", "iteration 6"],
        # Between an evaluation and its checkpoint, in the search, in the regressions, while a policy is saved.
        ["evaluation 3", "first_failure 1", "search 1", "begin 1", "distil 2", "evaluation 1", "save_policy 1"],
    ],
    ids=["iterations", "between"],
)
def test_a_run_that_is_killed_ends_with_the_same_bits(pretrain, unbroken, tmp_path, kills):
    folder = tmp_path / "run"
    for number, kill in enumerate(kills):
        with pytest.raises(Killed):
            pretrain(folder, resume=number > 0, kill=kill)
    pretrain(folder, resume=True)
    for name in ("checkpoints/00000018", "best"):
        infos = [checkpoint.read_info(one / name) for one in (folder, unbroken)]
        policies = [checkpoint.load_policy(info, load_robot(info.robot)) for info in infos]
        assert_same(*policies)
    assert evaluations(folder) == evaluations(unbroken)
    infos = [checkpoint.read_info(newest_checkpoint(one)) for one in (folder, unbroken)]
    assert infos[0].curriculum == infos[1].curriculum
    assert infos[0].environment_steps == infos[1].environment_steps
