"""Trials on a cluster of two dask workers of this machine: one is killed, and the other finishes its trial.

Then what every command that takes `--cluster` gives to its workers.
"""

import dataclasses
import json
import os
import re
import signal
import threading
from pathlib import Path

import pytest
from distributed import Client, LocalCluster
from miniature import TINY, Run, load_state
from trees import assert_same
from waiting import until

from forgetmimic_jax import pretrain, sweep
from forgetmimic_jax.basics.provenance import cores
from forgetmimic_jax.evaluation.document import read_evaluation
from forgetmimic_jax.settings.config import load_config, save_config
from forgetmimic_jax.settings.options import parse
from forgetmimic_jax.studies import executor, trials
from forgetmimic_jax.studies.executor import RESOURCE
from forgetmimic_jax.studies.task import Task
from forgetmimic_jax.studies.trials import Trial, make_trial, run_trials
from forgetmimic_jax.training.checkpoint import BEST, policy_hash, read_info

LENGTH = 30  # iterations, with a checkpoint every two: long enough to be killed on the way


@pytest.fixture(scope="module")
def cluster():
    resources = {RESOURCE: 1}
    with LocalCluster(
        n_workers=2, threads_per_worker=cores(), resources=resources, host="127.0.0.1", dashboard_address=":0"
    ) as cluster:
        yield cluster


def worker_of(trial: Trial) -> int:
    """The process of the worker that runs a trial."""
    return int(trial.task.mark.read_text().split()[1])


def kill_worker(trial: Trial, workers: list[int]) -> None:
    """Kill the worker of a trial that has trained a little; notes it, and the one that runs the trial then."""
    until((trial.folder / "checkpoints" / "00000002" / "meta.json").is_file)
    workers.append(worker_of(trial))
    os.kill(workers[0], signal.SIGKILL)
    until(lambda: worker_of(trial) != workers[0])
    workers.append(worker_of(trial))


def test_a_trial_whose_worker_is_killed_ends_on_the_other_as_it_would_have(cluster, base_run, tmp_path, capsys):
    options = {"base": base_run.checkpoint(4), "targets": "turn", "iterations": LENGTH, "episodes": 2}
    trial = make_trial(tmp_path / "trials", options)
    processes = set(Client(cluster, set_as_default=False).run(os.getpid).values())
    workers: list[int] = []
    killer = threading.Thread(target=kill_worker, args=(trial, workers), daemon=True)
    killer.start()
    assert run_trials([trial], jobs=1, cluster=cluster.scheduler_address, description="try") == {}
    killer.join()
    assert set(workers) == processes
    printed = trial.task.log.read_text()
    first, second = map(int, re.findall(rf"^forget turn by arft: (\d+)/{LENGTH}$", printed, re.MULTILINE))
    assert first == 0
    assert 2 <= second < LENGTH
    assert f"finished: {trial.folder.name}" in capsys.readouterr().out
    other = make_trial(tmp_path / "undisturbed", options)
    assert run_trials([other], jobs=1, cluster=cluster.scheduler_address, description="try") == {}
    disturbed, undisturbed = (Run(each.folder, each.task.log.read_text()) for each in (trial, other))
    assert disturbed.rows == undisturbed.rows
    states = [load_state(run.checkpoint(LENGTH)) for run in (disturbed, undisturbed)]
    assert_same(*states)
    measured = [json.loads((run.folder / "evaluation.json").read_text()) for run in (disturbed, undisturbed)]
    assert measured[0]["policies"] == measured[1]["policies"]


def test_a_control_is_trained_and_evaluated_on_a_cluster(cluster, library_folder, tmp_path, capsys):
    settings = [*TINY, "evaluate_every=2", "evaluate_episodes=2"]
    given = {"library": library_folder, "without": "turn", "iterations": 2, "episodes": 2, "set": [settings]}
    where = {"seeds": 1, "seed": 3, "cluster": cluster.scheduler_address, "output": tmp_path / "base"}
    pretrain.main(pretrain.Options(**given, **where))
    folder = tmp_path / "base-3"
    assert load_config(folder / "config.yaml").seed == 3
    best, document = read_info(folder / BEST), read_evaluation(folder / "evaluation.json")
    assert (document.episodes, document.targets, set(document.policies)) == (2, ["turn"], {"retrained", "zero_action"})
    assert document.policy_hashes == {"retrained": policy_hash(best)}
    assert f"Next: make play ROBOT=g1 CHECKPOINT={best.path}" in (tmp_path / "base-3.log").read_text()
    assert re.search(rf"^base-3 +{folder}$", capsys.readouterr().out, re.MULTILINE)


class Submitted(Exception):
    """Ends a command where it would run its tasks."""

    def __init__(self, tasks: list[Task], given: dict):
        super().__init__()
        self.tasks, self.where = tasks, {name: given[name] for name in ("jobs", "cluster")}


@pytest.fixture
def submitted(monkeypatch):
    """Calls a command, and returns the tasks that it wants to run, and where."""

    def run_tasks(tasks, **given):
        raise Submitted(list(tasks), given)

    def submitted(main, options) -> Submitted:
        with pytest.raises(Submitted) as found:
            main(options)
        return found.value

    monkeypatch.setattr(executor, "run_tasks", run_tasks)
    monkeypatch.setattr(trials, "run_tasks", run_tasks)
    return submitted


WHERE = {"jobs": 3, "cluster": "tcp://scheduler:8786"}


def test_every_seed_of_a_pretraining_is_a_task(submitted, library_folder, tmp_path):
    one = pretrain.Options(library=library_folder, without="turn", set=[["ppo.epochs=2"]], iterations=400)
    several = dataclasses.replace(one, seed=4, seeds=2, output=tmp_path / "base", **WHERE)
    found = submitted(pretrain.main, several)
    assert found.where == WHERE
    assert [task.folder.name for task in found.tasks] == ["base-4", "base-5"]
    for seed, task in zip((4, 5), found.tasks, strict=True):
        assert parse(pretrain.Options, "pretrain", task.flags) == dataclasses.replace(one, seed=seed)
        assert (task.command, task.iterations, task.adds) == ("pretrain", 400, False)


def test_a_seed_whose_folder_is_of_another_run_is_refused(refused, library_folder, tmp_path):
    folder = tmp_path / "base-5"
    folder.mkdir()
    (folder / "evaluation.json").write_text("{}")
    options = pretrain.Options(library=library_folder, iterations=400, seed=4, seeds=2, output=Path("base"))
    assert refused(pretrain.main, options) == (
        "base-5: exists already, and is of no run; remove it, or choose another --output"
    )
    save_config(pretrain.config_of(dataclasses.replace(options, seed=5), folder), folder / "config.yaml")
    assert refused(pretrain.main, dataclasses.replace(options, iterations=500)) == (
        "base-5: is of a run with other settings; remove it, or choose another --output"
    )


def test_every_trial_of_a_sweep_is_a_task(submitted, base_run, tmp_path):
    given = {"bases": str(base_run.checkpoint(4)), "targets": "turn", "trials": tmp_path, "output": tmp_path}
    found = submitted(sweep.main, sweep.Options(kind="seeds", seeds=2, iterations=2, episodes=2, **given, **WHERE))
    assert found.where == WHERE
    assert len(found.tasks) == 2


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"seeds": 0}, "--seeds: found 0; accepted: 1 or more"),
        ({"seeds": 2, "jobs": 0}, "--jobs: found 0; accepted: 1 or more"),
        ({"jobs": 2}, "--jobs: found 2; accepted: only with --seeds"),
        ({"cluster": "tcp://a:1"}, "--cluster: found tcp://a:1; accepted: only with --seeds"),
        (
            {"seeds": 2, "resume": True},
            "--resume: found with --seeds; leave it out: the same command continues what was stopped",
        ),
    ],
)
def test_flags_of_several_trainings_that_do_not_fit_are_refused(refused, given, message):
    assert refused(pretrain.main, pretrain.Options(output=Path("run"), **given)) == message
