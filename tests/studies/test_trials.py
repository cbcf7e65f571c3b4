"""Trials as processes. The process here is a few lines that write what a run writes, so that only the care counts."""

import dataclasses
import fcntl
import json
import os
import re
import shutil
import signal
import sys
import threading
import time
from pathlib import Path

import pytest

from forgetmimic_jax import unlearn
from forgetmimic_jax.basics.errors import Interrupted
from forgetmimic_jax.basics.provenance import provenance
from forgetmimic_jax.motion.library import DATA_DIR
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.settings.options import parse
from forgetmimic_jax.studies import trials
from forgetmimic_jax.studies.trials import Trial, make_trial, run_trials, without_code
from forgetmimic_jax.training.start import base_folder
from forgetmimic_jax.training.unlearning_run import config_of
from forgetmimic_jax.unlearning import method

RUN = """#!{python}
import pathlib, signal, sys, time
flag = dict(zip(sys.argv[1:], sys.argv[2:]))
folder = pathlib.Path(flag["--output"])
journal = folder.parent / "journal"
def note(what):
    with journal.open("a") as file:
        file.write(what + " " + flag["--seed"] + ("+" if "--resume" in sys.argv else "") + chr(10))
def stop(*_):
    note("stopped")
    sys.exit(130)
signal.signal(signal.SIGTERM, stop)
note("start")
if flag["--seed"] == "1":
    print("some words")
    sys.exit("error: no luck")
(folder / "checkpoints" / "00000001").mkdir(parents=True, exist_ok=True)
(folder / "checkpoints" / "00000001" / "meta.json").write_text("{{}}")
(folder / "metrics.jsonl").write_text('{{"iteration": 1}}')
time.sleep(60 if flag["--seed"] == "9" else 0.2)
(folder / "evaluation.json").write_text("{{}}")
note("end")
"""


@pytest.fixture(autouse=True)
def quick(tmp_path, monkeypatch):
    script = tmp_path / "run"
    script.write_text(RUN.format(python=sys.executable))
    script.chmod(0o755)
    monkeypatch.setattr(trials.sys, "executable", str(script))
    monkeypatch.setattr(trials, "POLL", 0.02)


def trial(tmp_path: Path, seed: int) -> Trial:
    config = dataclasses.replace(Config(), iterations=1, seed=seed)
    return Trial(tmp_path / "trials" / f"s{seed}", config, ("--seed", str(seed)))


def journal(tmp_path: Path) -> list[str]:
    return (tmp_path / "trials" / "journal").read_text().splitlines()


def test_a_trial_that_fails_is_told_and_stops_no_other(tmp_path, capsys):
    wanted = [trial(tmp_path, seed) for seed in (0, 1, 2)]
    assert run_trials(wanted, jobs=1, description="try") == {wanted[1]: "no luck"}
    assert [one.evaluation.is_file() for one in wanted] == [True, False, True]
    printed = capsys.readouterr().out
    assert f"failed: s1: no luck ({wanted[1].log})" in printed
    assert "finished: s2" in printed
    assert wanted[1].log.read_text() == "some words\nerror: no luck\n"


def test_what_is_finished_is_not_run_again_and_what_failed_is(tmp_path):
    wanted = [trial(tmp_path, seed) for seed in (0, 1)]
    for _ in range(2):
        run_trials(wanted, jobs=1, description="try")
    assert journal(tmp_path) == ["start 0", "end 0", "start 1", "start 1"]


@pytest.mark.parametrize("jobs", [1, 3])
def test_as_many_run_at_a_time_as_are_asked_for(tmp_path, jobs):
    run_trials([trial(tmp_path, seed) for seed in (2, 3, 4)], jobs=jobs, description="try")
    at_work = most = 0
    for line in journal(tmp_path):
        at_work += 1 if line.startswith("start") else -1
        most = max(most, at_work)
    assert most == jobs


def test_the_same_trial_asked_for_twice_runs_once(tmp_path):
    run_trials([trial(tmp_path, 2), trial(tmp_path, 2)], jobs=2, description="try")
    assert journal(tmp_path) == ["start 2", "end 2"]


def test_a_stop_lets_the_running_trial_save_and_the_next_time_it_is_resumed(tmp_path):
    wanted = trial(tmp_path, 9)

    def stop_at(line: str) -> None:
        while not (tmp_path / "trials" / "journal").is_file() or line not in journal(tmp_path):
            time.sleep(0.02)
        while not (wanted.folder / "metrics.jsonl").is_file():
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGTERM)

    for expected in (["start 9", "stopped 9"], ["start 9+", "stopped 9+"]):
        thread = threading.Thread(target=stop_at, args=(expected[0],))
        thread.start()
        with pytest.raises(Interrupted, match="finished trials are kept; the same command continues"):
            run_trials([wanted], jobs=1, description="try")
        thread.join()
        assert journal(tmp_path)[-2:] == expected
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_a_trial_at_which_another_process_works_is_left_to_it(tmp_path):
    wanted = [trial(tmp_path, seed) for seed in (2, 3)]
    wanted[0].log.parent.mkdir(parents=True)
    with wanted[0].log.open("a") as log:
        fcntl.flock(log, fcntl.LOCK_EX)
        assert run_trials(wanted, jobs=1, description="try") == {wanted[0]: "another process runs it"}
    assert journal(tmp_path) == ["start 3", "end 3"]


def test_a_folder_without_a_checkpoint_is_begun_anew(tmp_path):
    wanted = trial(tmp_path, 2)
    wanted.folder.mkdir(parents=True)
    (wanted.folder / "half").touch()
    assert run_trials([wanted], jobs=1, description="try") == {}
    assert not (wanted.folder / "half").exists()


@pytest.fixture
def base(tmp_path) -> Path:
    return Path(shutil.copytree(base_folder("g1"), tmp_path / "base"))


def test_a_trials_folder_says_what_it_is_and_its_flags_make_its_settings(tmp_path, base):
    found = make_trial(tmp_path, {"base": base, "iterations": 5, "seed": 2, "method": "arft"})
    assert re.fullmatch(rf"arft-punch\+kick-s2-[0-9a-f]{{8}}-{provenance().code}", found.folder.name)
    assert found.flags == ("--iterations", "5", "--seed", "2", "--base", str(base))
    wanted = {"base": base, "iterations": 5, "penalty": 8.0, "wrench": True, "sampler": None, "targets": "run, walk"}
    other = make_trial(tmp_path, {**wanted, "physics": "native", "set": ["ppo.base_kl=0.5", "ppo.epochs=7"]})
    assert other.folder.name.startswith("arft-run+walk-s0-")
    assert without_code(other.folder.name) + f"-{provenance().code}" == other.folder.name
    config = other.config
    assert (config.unlearn.settings, config.ppo.base_kl, config.ppo.epochs) == ({"penalty": 8.0}, 0.5, 7)
    assert (config.iterations, other.iterations, config.physics.engine) == (5, 5, "native")
    assert config.wrench.max_gain > 0.0
    for trial in (found, other):  # what the process makes of the flags is the trial's config
        assert config_of(parse(unlearn.Options, "unlearn", trial.flags)) == trial.config


def test_the_same_question_has_the_same_folder_wherever_its_base_lies(tmp_path, base):
    wanted = {"base": base, "iterations": 5, "penalty": 8.0}
    moved = Path(shutil.copytree(base, tmp_path / "moved"))
    same = make_trial(tmp_path, {"penalty": 8.0, "iterations": 5, "method": "arft", "base": moved})
    assert make_trial(tmp_path, wanted).folder == same.folder
    assert make_trial(tmp_path, {**wanted, "targets": "punch,kick"}).folder == same.folder  # the default
    different = [{"penalty": 9.0}, {"iterations": 6}, {"seed": 1}, {"set": ["ppo.base_kl=0.5"]}, {"episodes": 3}]
    folders = {make_trial(tmp_path, wanted | change).folder for change in different}
    meta = json.loads((base / "meta.json").read_text())
    (base / "meta.json").write_text(json.dumps({**meta, "iteration": meta["iteration"] + 1}))
    folders.add(make_trial(tmp_path, wanted).folder)
    library = Path(shutil.copytree(DATA_DIR / "g1", tmp_path / "library", ignore=shutil.ignore_patterns("base")))
    assert make_trial(tmp_path, {**wanted, "base": moved, "library": library}).folder == same.folder
    (library / "punch.npz").write_bytes((library / "kick.npz").read_bytes())
    folders.add(make_trial(tmp_path, {**wanted, "base": moved, "library": library}).folder)
    assert len(folders | {same.folder}) == 8


def test_a_default_that_changes_makes_another_trial(tmp_path, base, monkeypatch):
    before = make_trial(tmp_path, {"base": base, "iterations": 5})
    monkeypatch.setitem(method.SHORT, "learning_rate", 2e-4)
    assert make_trial(tmp_path, {"base": base, "iterations": 5}).folder != before.folder


def test_other_code_makes_another_trial(tmp_path, base, monkeypatch):
    found = [make_trial(tmp_path, {"base": base, "iterations": 5}).folder.name]
    other = dataclasses.replace(provenance(), code="0123abcd")
    monkeypatch.setattr(trials, "provenance", lambda: other)
    found.append(make_trial(tmp_path, {"base": base, "iterations": 5}).folder.name)
    assert found[1] == f"{without_code(found[0])}-0123abcd"
