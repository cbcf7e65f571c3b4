"""The loop around the iterations, here ones that only count: what is saved, logged, resumed and said at a stop."""

import contextlib
import dataclasses
import errno
import json
import os
import shutil
import signal
import struct
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tensorboardX.proto.event_pb2 import Event

from forgetmimic_jax.basics.errors import InputError, Interrupted
from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.basics.provenance import provenance
from forgetmimic_jax.evaluation.metrics import Rollout
from forgetmimic_jax.tracking.env import make_assets, make_environment
from forgetmimic_jax.tracking.setup import Setup, check_targets, make_setup
from forgetmimic_jax.training import checkpoint, start, watch
from forgetmimic_jax.training import run as run_module
from forgetmimic_jax.training.folder import default_folder, prepare_folder
from forgetmimic_jax.training.log import Log
from forgetmimic_jax.training.start import base_checkpoint, base_folder

CLIPS = 3


@pytest.fixture(scope="module")
def setup(tiny_config, library_folder) -> Setup:
    config = dataclasses.replace(
        tiny_config, library=str(library_folder), iterations=40, checkpoint_every=15, evaluate_every=0
    )
    return make_setup(config)


@pytest.fixture
def run(setup, tmp_path, monkeypatch):
    """`run(...)` in the folder `run`, whose iterations only count; `run.before[i]` is called in iteration i."""
    calls = {}
    shapes = start.template(make_environment(setup, setup.config.ppo.num_envs), make_assets(setup))

    def nothing(_setup, _env, _assets):
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def iterate(_assets, state):
        iteration = int(state.iteration) + 1
        calls.get(iteration, lambda: None)()
        per_clip = [
            *("clip/steps", "clip/episodes", "clip/episode_length_sum", "clip/completed", "clip/survival_weighted_sum"),
            *("clip/tracking_sum", "clip/probability"),
        ]
        metrics = {name: np.full(CLIPS, float(iteration)) for name in per_clip}
        metrics |= {name: np.float32(iteration) for name in ("episode_length", "tracking_reward")}
        return dataclasses.replace(state, iteration=jnp.int32(iteration)), metrics

    monkeypatch.setattr(run_module, "start_state", nothing)
    monkeypatch.setattr(run_module, "make_iteration", lambda _env, _rule, _mesh: iterate)

    def run(*, resume: bool = False, **settings):
        config = dataclasses.replace(setup.config, **settings)
        return run_module.run(
            dataclasses.replace(setup, config=config), tmp_path / "run", description="count", resume=resume
        )

    run.folder = tmp_path / "run"
    run.before = calls
    return run


def rows(folder: Path) -> list[dict]:
    """The rows without their clock, the one thing that two equal runs differ in."""
    found = read_rows(folder / "metrics.jsonl")
    assert all(row.pop("seconds", 0.0) >= 0.0 for row in found)
    return found


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "checkpoints").iterdir())


def test_a_run_saves_logs_and_keeps_the_newest(run):
    path, state = run()
    assert path == run.folder / "checkpoints" / "00000040"
    assert state.iteration == 40
    assert names(run.folder) == ["00000030", "00000040"]
    # A row ends after the first iteration, every ten and at every checkpoint, with the mean of its own: 2 to 10 is 6.
    assert [row["iteration"] for row in rows(run.folder)] == [1, 10, 15, 20, 30, 40]
    assert [row["tracking_reward"] for row in rows(run.folder)] == [1.0, 6.0, 13.0, 18.0, 25.5, 35.5]
    assert [row["environment_steps"] for row in rows(run.folder)] == [n * 8 * 4 for n in (1, 10, 15, 20, 30, 40)]
    assert rows(run.folder)[2]["clips"]["turn"] == {
        "success": 1.0,
        "survival_weighted_tracking": 1.0,
        "episode_length": 1.0,
        "tracking_reward": 1.0,
        "probability": 13.0,
        "step_share": pytest.approx(1 / 3, abs=1e-5),
    }


def test_tensorboard_gets_the_same_numbers(run):
    run(iterations=10)
    (file,) = (run.folder / "events").iterdir()
    assert file.name.startswith("events.out.tfevents.")
    data, events = file.read_bytes(), []
    while data:  # records: length, its checksum, content, its checksum
        (length,) = struct.unpack("Q", data[:8])
        events.append(Event.FromString(data[12 : 12 + length]))
        data = data[16 + length :]
    scalars = {value.tag: value.simple_value for value in events[-1].summary.value}
    assert events[-1].step == 320
    assert scalars["tracking_reward"] == 6.0
    assert scalars["turn/success"] == 1.0


def test_named_checkpoints_are_kept(run):
    named = run.folder / "checkpoints" / "00000030 good"
    run.before[40] = lambda: named.mkdir()
    run()
    assert names(run.folder) == ["00000030", "00000030 good", "00000040"]


def test_a_resumed_run_logs_what_an_unbroken_one_does(run, tmp_path):
    run(iterations=15)
    run(resume=True)
    unbroken = rows(run.folder)
    run.folder.rename(tmp_path / "resumed")
    run()
    assert rows(run.folder) == unbroken


def test_a_killed_run_goes_on_from_its_newest_whole_checkpoint(run):
    # What kill -9 leaves: rows after the checkpoint, half a row, a checkpoint half written.
    run(iterations=20)
    expected = rows(run.folder)
    with (run.folder / "metrics.jsonl").open("a") as file:
        file.write('{"iteration": 30, "environment_steps": 960, "clips": {}}\n{"iteration": 40, "clips": {"sway": {}')
    (run.folder / "checkpoints" / ".00000030.tmp" / "policy").mkdir(parents=True)
    path, state = run(resume=True, iterations=21)
    assert state.iteration == 21
    assert names(run.folder) == ["00000020", "00000021"]
    assert rows(run.folder)[:-1] == expected
    assert rows(run.folder)[-1]["iteration"] == 21
    assert checkpoint.read_info(path).environment_steps == 21 * 32


@pytest.fixture
def skill(monkeypatch) -> list[float]:
    """The survival-weighted tracking that one evaluation after the other finds."""
    found = []

    class Evaluator:
        clip = np.arange(CLIPS)

        def __init__(self, *_arguments, episodes, seed):
            pass

        def rollout(self, _policy) -> Rollout:
            one = np.ones(CLIPS, int)
            reward = np.broadcast_to(found.pop(0), CLIPS).reshape(CLIPS, 1)
            return Rollout(np.arange(CLIPS), 0 * one, horizon=one, length=one, tracking_reward=reward)

    monkeypatch.setattr(watch, "Evaluator", Evaluator)
    return found


def test_the_best_policy_is_kept_too_also_over_a_resume(run, skill):
    def evaluations():
        rows = read_rows(run.folder / "evaluations.jsonl")
        return {row["iteration"]: row["survival_weighted_tracking"] for row in rows}

    skill += [0.25, 0.5, 0.375]
    run(evaluate_every=10, iterations=30)
    assert evaluations() == {10: 0.25, 20: 0.5, 30: 0.375}
    assert (run.folder / "evaluations.png").stat().st_size > 0
    best = run.folder / "best"
    assert checkpoint.read_info(best).iteration == 20
    assert not (best / "run").exists()
    assert prepare_folder(run.folder, resume=True).name == "00000030"

    shutil.rmtree(run.folder / "checkpoints" / "00000030")  # as if killed before it was whole: 15 is the newest
    with (run.folder / "evaluations.jsonl").open("a") as file:
        file.write('{"iteration": 40, "cl')
    skill += [0.5, 0.4375, 0.75]
    run(evaluate_every=10, resume=True)
    assert evaluations() == {10: 0.25, 20: 0.5, 30: 0.4375, 40: 0.75}
    assert checkpoint.read_info(best).iteration == 40


def test_the_best_policy_of_unlearning_is_the_best_on_the_clips_to_keep(run, skill, setup):
    skill += [[0.5, 1.0, 0.5], [0.625, 0.0, 0.5], [0.5, 0.75, 0.5]]  # sway, turn, nod
    unlearn = dataclasses.replace(setup.config.unlearn, targets=("turn",))
    run(unlearn=unlearn, evaluate_every=10, iterations=30)
    assert checkpoint.read_info(run.folder / "best").iteration == 20


def test_a_finished_run_resumes_to_its_own_end(run):
    run()
    before = (run.folder / "metrics.jsonl").read_text()
    path, state = run(resume=True)
    assert (path.name, int(state.iteration)) == ("00000040", 40)
    assert (run.folder / "metrics.jsonl").read_text() == before


def test_a_resume_on_another_machine_says_that_the_last_digits_differ(run, capsys):
    run(iterations=5)
    capsys.readouterr()
    run(iterations=6, resume=True)
    assert "digits" not in capsys.readouterr().out
    path = run.folder / "checkpoints" / "00000006"
    note = json.loads((path / "meta.json").read_text())
    note["made"] |= {"processor": "Abacus", "cores": 99}
    (path / "meta.json").write_text(json.dumps(note))
    run(iterations=7, resume=True)
    here = f"{provenance().processor} (cores: {provenance().cores})"
    expected = f"{path} was made on Abacus (cores: 99), this is {here}: the numbers will differ in the last digits"
    assert expected in capsys.readouterr().out.splitlines()


def test_more_iterations_are_remembered_by_the_next_resume(run):
    run(iterations=5)
    run(resume=True, iterations=7)
    assert checkpoint.load_config(run.folder / "config.yaml").iterations == 7


def test_a_learning_rate_that_was_changed_holds_and_the_state_s_own_otherwise(run, setup):
    run(iterations=5)  # the state's is 0, as an adaptive schedule may have left it
    assert run(iterations=6, resume=True)[1].learning_rate == 0.0
    ppo = dataclasses.replace(setup.config.ppo, learning_rate=0.5)
    assert run(iterations=7, resume=True, ppo=ppo)[1].learning_rate == 0.5


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_ends_the_iteration_saves_and_says_how_to_go_on(run, number):
    handler = signal.getsignal(number)
    run.before[4] = lambda: os.kill(os.getpid(), number)
    with pytest.raises(Interrupted) as message:
        run()
    assert str(message.value) == (
        f"stopped; saved {run.folder}/checkpoints/00000004; "
        f"continue with: make train ROBOT=g1 RESUME=1 OUTPUT={run.folder}"
    )
    assert signal.getsignal(number) is handler
    assert rows(run.folder)[-1]["iteration"] == 4
    run.before.clear()
    assert run(resume=True)[1].iteration == 40


def test_a_stop_in_the_last_iteration_is_still_a_stop(run):
    run.before[3] = lambda: os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(Interrupted, match="00000003"):
        run(iterations=3)


@contextlib.contextmanager
def full_disk(at: int) -> Iterator[None]:
    """The system refuses to save iteration `at`."""
    save = checkpoint.save_checkpoint

    def failing(path, *arguments, **options):
        if int(path.name) == at:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        save(path, *arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoint, "save_checkpoint", failing)
        yield


def test_a_disk_that_fills_up_leaves_the_checkpoints_before(run):
    with full_disk(at=30), pytest.raises(OSError, match="No space left on device"):
        run()
    assert names(run.folder) == ["00000000", "00000015"]
    assert run(resume=True, iterations=16)[1].iteration == 16


def test_a_row_that_does_not_fit_is_refused_with_its_folder(run, monkeypatch):
    def full(*_arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    run.before[12] = lambda: monkeypatch.setattr(Log, "write", full)
    with pytest.raises(OSError, match="No space left on device") as refusal:
        run()
    assert refusal.value.filename == str(run.folder)
    assert names(run.folder) == ["00000000"]


def test_a_run_that_cannot_save_at_all_leaves_no_folder(run):
    with full_disk(at=0), pytest.raises(OSError, match="No space left on device"):
        run()
    assert not run.folder.exists()


def test_a_folder_must_be_new(tmp_path):
    prepare_folder(tmp_path / "new", resume=False)
    prepare_folder(tmp_path, resume=False)  # there, but empty
    (tmp_path / "note").write_text("mine")
    with pytest.raises(InputError, match=r"exists already; choose another --output, or remove it$"):
        prepare_folder(tmp_path, resume=False)
    (tmp_path / "checkpoints" / "00000001").mkdir(parents=True)
    (tmp_path / "checkpoints" / "00000001" / "meta.json").touch()
    with pytest.raises(InputError, match=r"exists already; choose another --output, or continue with --resume$"):
        prepare_folder(tmp_path, resume=False)
    assert prepare_folder(tmp_path, resume=True) == tmp_path / "checkpoints" / "00000001"
    for path in (tmp_path / "note", tmp_path / "note" / "below" / "it"):
        with pytest.raises(InputError, match=rf"^{path}: {tmp_path}/note is a file; choose another --output$"):
            prepare_folder(path, resume=False)


def test_what_a_run_left_that_was_killed_before_its_first_checkpoint_is_removed(tmp_path):
    run = tmp_path / "run"
    (run / "checkpoints" / ".00000000.tmp").mkdir(parents=True)
    for name in ("config.yaml", "metrics.jsonl"):
        (run / name).touch()
    assert prepare_folder(run, resume=False) is None
    assert not run.exists()


@pytest.mark.parametrize("kept", ["metrics.jsonl", "note"])
def test_a_folder_with_anything_of_worth_is_not_removed(tmp_path, kept):
    (tmp_path / "config.yaml").touch()
    (tmp_path / kept).write_text("{}")
    with pytest.raises(InputError, match=r"exists already; choose another --output, or remove it$"):
        prepare_folder(tmp_path, resume=False)
    assert (tmp_path / kept).read_text() == "{}"


def test_a_folder_without_permission_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda _path, _mode: False)  # which root would have everywhere
    with pytest.raises(InputError, match=rf"no permission to write in {tmp_path}; choose another --output"):
        prepare_folder(tmp_path / "run", resume=False)


def test_nothing_to_resume_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"new: --resume finds no checkpoint there; leave it out to start$"):
        prepare_folder(tmp_path / "new", resume=True)
    assert not (tmp_path / "new").exists()


def test_numbered_folders_follow_the_last(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert str(default_folder("unlearn-g1", resume=False)) == "runs/unlearn-g1-001"
    assert str(default_folder("unlearn-g1", resume=True)) == "runs/unlearn-g1-001"
    for name in ("unlearn-g1-009", "unlearn-g1-010", "unlearn-g1-x", "unlearn-g1-5-old", "unlearn-h2-020"):
        (tmp_path / "runs" / name).mkdir(parents=True)
    assert str(default_folder("unlearn-g1", resume=False)) == "runs/unlearn-g1-011"
    assert str(default_folder("unlearn-g1", resume=True)) == "runs/unlearn-g1-010"


def test_targets_are_clips_of_the_library_and_leave_one():
    check_targets((), ("punch", "kick"))
    check_targets(("kick",), ("punch", "kick"))
    with pytest.raises(InputError, match=r"no clip 'punhc' in the library; did you mean 'punch'\?"):
        check_targets(("punhc",), ("punch", "kick"))
    with pytest.raises(InputError, match=r"all 2 clips of the library; leave at least one to keep"):
        check_targets(("kick", "punch"), ("punch", "kick"))


def test_the_base_is_the_one_named_or_the_shipped_one(tmp_path, setup, monkeypatch):
    monkeypatch.setattr(start, "DATA_DIR", tmp_path)
    with pytest.raises(InputError, match=r"g1/base: no policy is shipped for 'g1'; train one"):
        base_checkpoint(setup.config)
    (tmp_path / "g1" / "base").mkdir(parents=True)
    assert base_checkpoint(setup.config) == tmp_path / "g1" / "base"
    assert base_checkpoint(dataclasses.replace(setup.config, base="runs/mine")) == Path("runs/mine")
    with pytest.raises(InputError, match=r"robot 'g11': .*did you mean 'g1'\?"):
        base_folder("g11")


def test_clips_are_resampled_to_the_control_rate(setup):
    physics = dataclasses.replace(setup.config.physics, substeps=8)  # 25 Hz
    slower = make_setup(dataclasses.replace(setup.config, physics=physics))
    assert setup.library.length.tolist() == [80, 41, 60]
    assert slower.library.length.tolist() == [40, 21, 30]
