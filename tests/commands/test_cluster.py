"""Trials on a cluster of two dask workers of this machine: one is killed, and the other finishes its trial."""

import json
import os
import re
import signal
import threading

import jax
import numpy as np
import pytest
from distributed import Client, LocalCluster
from miniature import Run, load_state
from waiting import until

from forgetmimic_jax.basics.provenance import cores
from forgetmimic_jax.studies.executor import RESOURCE
from forgetmimic_jax.studies.trials import Trial, make_trial, run_trials

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
    jax.tree.map(np.testing.assert_array_equal, *states)
    measured = [json.loads((run.folder / "evaluation.json").read_text()) for run in (disturbed, undisturbed)]
    assert measured[0]["policies"] == measured[1]["policies"]
