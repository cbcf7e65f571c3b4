"""Tasks on this machine. The process here is a few lines that write what a run writes, so that only the care counts."""

import contextlib
import itertools
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from distributed import LocalCluster
from waiting import until

from forgetmimic_jax.basics.errors import InputError, Interrupted
from forgetmimic_jax.basics.provenance import cores, provenance
from forgetmimic_jax.studies import executor, task
from forgetmimic_jax.studies.executor import RESOURCE, at_a_time, on_cluster, run_tasks, run_together
from forgetmimic_jax.studies.process import CODE
from forgetmimic_jax.studies.task import ATTEMPTS, Task, run_task

RUN = """#!{python}
import os, pathlib, signal, sys, time
flag = dict(zip(sys.argv[1:], sys.argv[2:]))
folder = pathlib.Path(flag.get("--output") or flag["--run"])
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
    sys.exit("error: no [/luck]")
(folder / "checkpoints" / "00000001").mkdir(parents=True, exist_ok=True)
(folder / "checkpoints" / "00000001" / "meta.json").write_text("{{}}")
(folder / "metrics.jsonl").write_text('{{"iteration": 1}}')
if flag["--seed"] == "6" or flag["--seed"] == "7" and "--resume" not in sys.argv:
    os.kill(os.getpid(), signal.SIGKILL)
if flag["--seed"] == "5":
    (folder / "threads").write_text(" ".join(os.environ[name] for name in ("PYTHON_CPU_COUNT", "NPROC")))
if flag["--seed"] == "2":
    of_launchers = ("SLURM_STEP", "JAX_NUM_PROC", "JAX_COORDINATOR", "JAX_PROCESS")
    (folder / "started").write_text(str([name for name in os.environ if name.startswith(of_launchers)]))
if flag["--seed"] in "23":
    (folder / "gpu").write_text(os.environ.get("CUDA_VISIBLE_DEVICES", "all"))
time.sleep(60 if flag["--seed"] == "9" else 0.2)
(folder / flag.get("--last", "evaluation.json")).write_text("{{}}")
note("end")
"""


START = task._start_of(os.getpid())


@pytest.fixture(autouse=True)
def quick(tmp_path, monkeypatch):
    script = tmp_path / "run"
    script.write_text(RUN.format(python=sys.executable))
    script.chmod(0o755)
    monkeypatch.setattr(task.sys, "executable", str(script))
    monkeypatch.setattr(executor, "POLL", 0.02)
    monkeypatch.setattr(executor, "gpus", list)


def a_task(tmp_path: Path, seed: int) -> Task:
    return Task(tmp_path / "trials" / f"s{seed}", "unlearn", ("--seed", str(seed)), iterations=1)


def journal(tmp_path: Path) -> list[str]:
    return (tmp_path / "trials" / "journal").read_text().splitlines()


def test_a_task_that_fails_is_named_and_stops_no_other(tmp_path, capsys):
    wanted = [a_task(tmp_path, seed) for seed in (0, 1, 2)]
    assert run_tasks(wanted, jobs=1, description="try") == {wanted[1]: "no [/luck]"}
    assert [one.finished for one in wanted] == [True, False, True]
    printed = capsys.readouterr().out
    assert f"failed: s1: no [/luck] ({wanted[1].log})" in printed
    assert "finished: s2" in printed
    assert wanted[1].log.read_text() == "some words\nerror: no [/luck]\n"


def test_one_table_has_the_progress_and_the_failures(tmp_path, capsys):
    run_tasks([a_task(tmp_path, seed) for seed in (0, 1)], jobs=1, description="try")
    printed = capsys.readouterr().out
    assert printed.startswith("try: 0/2 iterations  2 waiting\n")
    *_, title, _, header, _, failed, finished, _ = printed.splitlines()
    assert title == "try: 1/2 iterations  1 finished  1 failed"
    assert re.split(r"\s*[┃│]\s*", header)[1:4] == ["task", "iterations", "state"]
    assert re.split(r"\s*[┃│]\s*", failed)[1:4] == ["s1", "0/1", "failed: no [/luck]"]
    assert re.split(r"\s*[┃│]\s*", finished)[1:4] == ["s0", "1/1", "finished"]


def test_what_is_finished_is_not_run_again_and_what_failed_is(tmp_path):
    wanted = [a_task(tmp_path, seed) for seed in (0, 1)]
    for _ in range(2):
        run_tasks(wanted, jobs=1, description="try")
    assert journal(tmp_path) == ["start 0", "end 0", "start 1", "start 1"]


def test_a_command_that_adds_to_a_run_finds_the_run_as_it_was(tmp_path):
    run, flags = tmp_path / "trials" / "run", ("--seed", "2", "--last", "evidence.json")
    (run / "checkpoints" / "00000008").mkdir(parents=True)
    (run / "checkpoints" / "00000008" / "meta.json").write_text("{}")
    (run / "evaluation.json").write_text("of the run")
    wanted = Task(run, "evidence", (*flags, "--run", str(run)), iterations=0, last="evidence.json", adds=True)
    assert run_tasks([wanted], jobs=1, description="try") == {}
    assert (run / "checkpoints" / "00000008").is_dir()
    assert (run / "evaluation.json").read_text() == "of the run"
    assert journal(tmp_path) == ["start 2", "end 2"]  # and no --resume


def test_a_task_knows_nothing_of_the_processes_that_its_worker_was_started_with(tmp_path, monkeypatch):
    for name in ("SLURM_STEP_NUM_TASKS", "JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID"):
        monkeypatch.setenv(name, "8")
    wanted = a_task(tmp_path, 2)
    assert run_tasks([wanted], jobs=1, description="try") == {}
    assert (wanted.folder / "started").read_text() == "[]"


@pytest.mark.parametrize(("seeds", "code"), [((0, 2), None), ((0, 1), 1)])
def test_a_command_of_many_tasks_says_where_they_are_and_fails_if_one_does(tmp_path, seeds, code, capsys):
    wanted = [a_task(tmp_path, seed) for seed in seeds]
    with contextlib.suppress(SystemExit) if code is None else pytest.raises(SystemExit) as end:
        run_together(wanted, "make it so", jobs=1, description="try")
    printed = capsys.readouterr()
    assert str(wanted[0].folder) in printed.out
    assert "Next: make it so" in printed.out
    if code:
        assert end.value.code == code
        assert printed.err == "1 of 2 failed; the same command tries them again\n"


@pytest.mark.parametrize("jobs", [1, 3])
def test_as_many_run_at_a_time_as_are_wanted(tmp_path, jobs):
    run_tasks([a_task(tmp_path, seed) for seed in (2, 3, 4)], jobs=jobs, description="try")
    at_work = most = 0
    for line in journal(tmp_path):
        at_work += 1 if line.startswith("start") else -1
        most = max(most, at_work)
    assert most == jobs


def test_a_task_has_its_share_of_the_cores(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHON_CPU_COUNT", "7")
    assert cores() == 7
    wanted = a_task(tmp_path, 5)
    for jobs, share in ((2, "3"), (9, "1")):
        run_tasks([wanted], jobs=jobs, description="try")
        assert (wanted.folder / "threads").read_text() == f"{share} {share}"
        (wanted.folder / "evaluation.json").unlink()


@pytest.mark.parametrize(("there", "seen"), [([], {"all"}), (["4", "GPU-7"], {"4", "GPU-7"}), (["4"], {"4"})])
def test_every_task_has_a_gpu_for_itself(tmp_path, monkeypatch, there, seen):
    monkeypatch.setattr(executor, "gpus", lambda: there)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    wanted = [a_task(tmp_path, seed) for seed in (2, 3)]
    for _ in range(2):  # a GPU is free again after its task
        run_tasks(wanted, jobs=2, description="try")
        assert {(one.folder / "gpu").read_text() for one in wanted} == seen
        for one in wanted:
            (one.folder / "evaluation.json").unlink()
    most = max(itertools.accumulate(1 if line.startswith("start") else -1 for line in journal(tmp_path)))
    assert most == (len(there) or 2)


def test_by_default_one_task_runs_on_each_gpu_and_more_are_refused(monkeypatch):
    assert (at_a_time(None, None), at_a_time(None, None, few=2), at_a_time(3, None)) == (1, 2, 3)
    monkeypatch.setattr(executor, "gpus", lambda: ["4", "5"])
    assert (at_a_time(None, None), at_a_time(2, None), at_a_time(3, "tcp://a:8786")) == (2, 2, 3)
    with pytest.raises(InputError, match=r"^--jobs: found 3; accepted: 1 to 2, since each takes one of the GPUs$"):
        at_a_time(3, None)


def test_a_task_that_is_given_twice_runs_once(tmp_path):
    run_tasks([a_task(tmp_path, 2), a_task(tmp_path, 2)], jobs=2, description="try")
    assert journal(tmp_path) == ["start 2", "end 2"]


def test_a_stop_lets_the_running_task_save_and_the_next_time_it_is_resumed(tmp_path):
    wanted = a_task(tmp_path, 9)

    def stop_at(line: str) -> None:
        until(lambda: (tmp_path / "trials" / "journal").is_file() and line in journal(tmp_path))
        until((wanted.folder / "metrics.jsonl").is_file)
        os.kill(os.getpid(), signal.SIGTERM)

    for expected in (["start 9", "stopped 9"], ["start 9+", "stopped 9+"]):
        thread = threading.Thread(target=stop_at, args=(expected[0],))
        thread.start()
        with pytest.raises(Interrupted, match="finished trials are kept; the same command continues"):
            run_tasks([wanted, a_task(tmp_path, 2)], jobs=1, description="try")
        thread.join()
        assert journal(tmp_path)[-2:] == expected
        assert not wanted.mark.exists()
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_a_process_that_the_system_kills_is_started_again_from_its_checkpoint(tmp_path):
    assert run_tasks([a_task(tmp_path, 7)], jobs=1, description="try") == {}
    assert journal(tmp_path) == ["start 7", "start 7+", "end 7+"]


def test_a_process_that_is_killed_each_time_fails(tmp_path):
    wanted = a_task(tmp_path, 6)
    assert run_tasks([wanted], jobs=1, description="try") == {wanted: f"killed by signal 9, {ATTEMPTS} times"}
    assert journal(tmp_path) == ["start 6", *["start 6+"] * (ATTEMPTS - 1)]


@pytest.mark.parametrize("system", ["Linux", "macOS"])
def test_a_task_at_which_another_process_works_is_left_to_it(tmp_path, monkeypatch, system):
    if system == "macOS":
        monkeypatch.setattr(task, "PROC", tmp_path / "none")
    wanted = [a_task(tmp_path, seed) for seed in (2, 3)]
    wanted[0].mark.parent.mkdir(parents=True)
    mark = f"{task.platform.node()} {os.getppid()} {task._start_of(os.getppid())}"
    wanted[0].mark.write_text(mark)
    assert run_tasks(wanted, jobs=1, description="try") == {wanted[0]: f"process {os.getppid()} runs it"}
    assert journal(tmp_path) == ["start 3", "end 3"]
    assert wanted[0].mark.read_text() == mark


def test_a_process_does_not_take_a_task_twice(tmp_path):
    wanted = a_task(tmp_path, 2)
    wanted.mark.parent.mkdir(parents=True)
    with task._marked(wanted):
        assert run_tasks([wanted], jobs=1, description="try") == {wanted: f"process {os.getpid()} runs it"}
    assert run_tasks([wanted], jobs=1, description="try") == {}


@pytest.mark.skipif(not START, reason="the system does not say when a process started")
@pytest.mark.parametrize("process", [os.getpid, os.getppid])
@pytest.mark.parametrize("start", ["", f"{START}0", f"0{START}"], ids=["unknown", "another", "another boot"])
def test_the_mark_of_a_process_that_had_the_number_before_is_replaced(tmp_path, process, start):
    wanted = a_task(tmp_path, 2)
    wanted.mark.parent.mkdir(parents=True)
    wanted.mark.write_text(f"{task.platform.node()} {process()} {start}")
    assert run_tasks([wanted], jobs=1, description="try") == {}
    assert not wanted.mark.exists()


@pytest.mark.parametrize("mark", ["", "gone", f"{task.platform.node()} 4194304", "another-host 1"])
def test_the_mark_of_a_worker_that_is_gone_is_replaced(tmp_path, mark):
    wanted = a_task(tmp_path, 2)
    wanted.mark.parent.mkdir(parents=True)
    wanted.mark.write_text(mark)
    assert run_tasks([wanted], jobs=1, description="try") == {}
    assert not wanted.mark.exists()


def test_a_folder_without_a_checkpoint_is_begun_anew(tmp_path):
    wanted = a_task(tmp_path, 2)
    wanted.folder.mkdir(parents=True)
    (wanted.folder / "half").touch()
    assert run_tasks([wanted], jobs=1, description="try") == {}
    assert not (wanted.folder / "half").exists()


def test_a_worker_with_other_code_or_without_the_folder_runs_nothing(tmp_path):
    wanted, host = a_task(tmp_path, 2), task.platform.node()
    code = provenance().code
    accepted = "accepted: 0123abcd, the code that wants the task"
    assert run_task(wanted, tmp_path, "0123abcd", 1) == f"{host}: its code is {code}; {accepted}"
    missing = f"{host}: no folder {wanted.folder.parent} there; every worker must see it under this path"
    assert run_task(wanted, tmp_path, code, 1) == missing
    assert list(tmp_path.iterdir()) == [tmp_path / "run"]


def test_the_process_of_a_task_ends_with_its_starter(monkeypatch):
    """What the command is does not matter: it runs beside the thread that waits for the starter."""
    monkeypatch.undo()
    code = "import runpy, time; runpy.run_module = lambda *_, **__: time.sleep(60); "
    code += "import sys; exec(open(sys.argv[1]).read())"
    path = Path(task.__file__).with_name("process.py")
    environment = os.environ | {CODE: provenance().code}
    process = subprocess.Popen([sys.executable, "-c", code, path], stdin=subprocess.PIPE, env=environment)
    time.sleep(0.5)
    assert process.poll() is None
    assert process.stdin
    process.stdin.close()
    assert process.wait(timeout=60) == -signal.SIGKILL


def test_the_process_of_a_task_has_the_code_of_its_starter_or_none(monkeypatch):
    monkeypatch.undo()
    path = Path(task.__file__).with_name("process.py")
    environment = os.environ | {CODE: "0123abcd"}
    ended = subprocess.run([sys.executable, path, "--help"], env=environment, capture_output=True, text=True)
    assert ended.returncode == 1
    here = provenance().code
    assert (
        ended.stderr
        == f"error: the checkout has changed: found code {here}; accepted: 0123abcd, which wants the task\n"
    )


LOCAL = {"host": "127.0.0.1", "protocol": "tcp://", "dashboard_address": ":0"}


@pytest.fixture
def worker() -> Iterator[LocalCluster]:
    """A dask worker in this process, with two threads."""
    with LocalCluster(1, processes=False, threads_per_worker=2, resources={RESOURCE: 1}, **LOCAL) as cluster:
        yield cluster


def test_a_worker_of_a_cluster_runs_one_task_at_a_time_with_all_its_threads(tmp_path, worker):
    wanted = [a_task(tmp_path, seed) for seed in (1, 4, 5)]
    failed = run_tasks(wanted, jobs=1, cluster=worker.scheduler_address, description="try")
    assert failed == {wanted[0]: "no [/luck]"}
    assert [line.split()[0] for line in journal(tmp_path) if not line.endswith("1")] == ["start", "end"] * 2
    assert (wanted[2].folder / "threads").read_text() == "2 2"


def test_a_stop_lets_the_tasks_of_a_cluster_save(tmp_path, worker):
    wanted = a_task(tmp_path, 9)

    def stop() -> None:
        until((wanted.folder / "metrics.jsonl").is_file)
        os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.Thread(target=stop)
    thread.start()
    with pytest.raises(Interrupted):
        run_tasks([wanted, a_task(tmp_path, 2)], jobs=1, cluster=worker.scheduler_address, description="try")
    thread.join()
    assert journal(tmp_path) == ["start 9", "stopped 9"]


def test_a_task_whose_program_is_gone_saves_and_ends(tmp_path, worker, monkeypatch):
    monkeypatch.setattr(task, "POLL", 0.05)
    wanted = a_task(tmp_path, 9)
    wanted.folder.parent.mkdir()
    with on_cluster(worker.scheduler_address) as place:
        place.executor.submit(place.run, wanted, tmp_path, provenance().code)
        until((wanted.folder / "metrics.jsonl").is_file)
    until(lambda: not wanted.mark.exists())
    assert journal(tmp_path) == ["start 9", "stopped 9"]


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("nonsense://x", "--cluster: found nonsense://x; accepted: the address of a dask scheduler"),
        ("tcp://127.0.0.1:1", "--cluster: found tcp://127.0.0.1:1; accepted: the address of a dask scheduler"),
    ],
)
def test_an_address_without_a_scheduler_is_refused(tmp_path, monkeypatch, address, message):
    monkeypatch.setattr(executor, "PATIENCE", 0.5)
    with pytest.raises(InputError, match=re.escape(message)):
        run_tasks([a_task(tmp_path, 2)], jobs=1, cluster=address, description="try")
    assert not (tmp_path / "trials").exists()


def test_a_cluster_whose_workers_run_no_trials_is_refused(tmp_path):
    with LocalCluster(1, processes=False, **LOCAL) as cluster:
        address = cluster.scheduler_address
        with pytest.raises(InputError, match=f"--cluster: no worker of {address} has the resource 'trial'"):
            run_tasks([a_task(tmp_path, 2)], jobs=1, cluster=address, description="try")
    assert not (tmp_path / "trials").exists()
