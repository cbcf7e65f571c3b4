"""Trials as processes. The process here is a few lines that write what a run writes, so that only the care counts."""

import fcntl
import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest

from forgetmimic_jax.basics.errors import Interrupted
from forgetmimic_jax.studies import trials
from forgetmimic_jax.studies.trials import Trial, make_trial, run_trials

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
    return Trial(tmp_path / "trials" / f"s{seed}", ("--seed", str(seed)), 1)


def journal(tmp_path: Path) -> list[str]:
    return (tmp_path / "trials" / "journal").read_text().splitlines()


def test_a_trial_that_fails_is_told_and_stops_no_other(tmp_path, capsys):
    asked = [trial(tmp_path, seed) for seed in (0, 1, 2)]
    assert run_trials(asked, jobs=1, description="try") == {asked[1]: "no luck"}
    assert [one.evaluation.is_file() for one in asked] == [True, False, True]
    printed = capsys.readouterr().out
    assert f"failed: s1: no luck ({asked[1].log})" in printed
    assert "finished: s2" in printed
    assert asked[1].log.read_text() == "some words\nerror: no luck\n"


def test_what_is_finished_is_not_run_again_and_what_failed_is(tmp_path):
    asked = [trial(tmp_path, seed) for seed in (0, 1)]
    for _ in range(2):
        run_trials(asked, jobs=1, description="try")
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
    asked = trial(tmp_path, 9)

    def stop_at(line: str) -> None:
        while not (tmp_path / "trials" / "journal").is_file() or line not in journal(tmp_path):
            time.sleep(0.02)
        while not (asked.folder / "metrics.jsonl").is_file():
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGTERM)

    for expected in (["start 9", "stopped 9"], ["start 9+", "stopped 9+"]):
        thread = threading.Thread(target=stop_at, args=(expected[0],))
        thread.start()
        with pytest.raises(Interrupted, match="what is finished is kept; the same command goes on"):
            run_trials([asked], jobs=1, description="try")
        thread.join()
        assert journal(tmp_path)[-2:] == expected
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_a_trial_at_which_another_process_works_is_left_to_it(tmp_path):
    asked = [trial(tmp_path, seed) for seed in (2, 3)]
    asked[0].log.parent.mkdir(parents=True)
    with asked[0].log.open("a") as log:
        fcntl.flock(log, fcntl.LOCK_EX)
        assert run_trials(asked, jobs=1, description="try") == {asked[0]: "another process is at work on it"}
    assert journal(tmp_path) == ["start 3", "end 3"]


def test_a_folder_without_a_checkpoint_is_begun_anew(tmp_path):
    asked = trial(tmp_path, 2)
    asked.folder.mkdir(parents=True)
    (asked.folder / "half").touch()
    assert run_trials([asked], jobs=1, description="try") == {}
    assert not (asked.folder / "half").exists()


@pytest.fixture
def base(tmp_path) -> Path:
    return written(tmp_path / "base")


def written(folder: Path, meta: str = "one", settings: str = "fast") -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "meta.json").write_text(meta)
    (folder / "config.yaml").write_text(settings)
    return folder


def test_a_trial_s_folder_says_what_it_is_and_its_flags_leave_defaults_out(tmp_path, base):
    found = make_trial(tmp_path, {"base": base, "iterations": 5, "penalty": 16.0, "seed": 2, "method": "arft"})
    assert found.folder.name.startswith("arft-s2-")
    assert found.flags == ("--base", str(base), "--iterations", "5", "--seed", "2")
    other = make_trial(
        tmp_path,
        {"base": base, "iterations": 5, "penalty": 8.0, "wrench": True, "sampler": None, "set": ["a=1", "b=2"]},
    )
    assert other.folder.name.startswith("arft-penalty_8.0-wrench_True-s0-")
    assert other.flags[4:] == ("--penalty", "8.0", "--wrench", "--set", "a=1", "b=2")
    assert other.iterations == 5


def test_the_same_question_has_the_same_folder_wherever_its_base_lies(tmp_path, base):
    asked = {"base": base, "iterations": 5, "penalty": 8.0}
    moved = base.rename(tmp_path / "moved")
    same = make_trial(tmp_path, {"penalty": 8.0, "iterations": 5, "method": "arft", "base": moved})
    written(tmp_path / "base")
    assert make_trial(tmp_path, asked).folder == same.folder
    different = [{"penalty": 9.0}, {"iterations": 6}, {"seed": 1}, {"set": ["a=1"]}]
    folders = {make_trial(tmp_path, asked | change).folder for change in different}
    for meta, settings in (("two", "fast"), ("one", "slow")):
        written(tmp_path / "base", meta, settings)
        folders.add(make_trial(tmp_path, asked).folder)
    assert len(folders | {same.folder}) == 7
