import dataclasses
import itertools
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from miniature import TINY, finished, load_state, started
from trees import assert_same

from forgetmimic_jax import train
from forgetmimic_jax.motion.library import read_manifest, write_manifest
from forgetmimic_jax.settings.config import load_config
from forgetmimic_jax.settings.options import parse
from forgetmimic_jax.tracking.setup import make_setup
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.checkpoint import newest_checkpoint


@pytest.fixture
def options(library_folder):
    """Options of a tiny run in the working folder."""

    def options(**given) -> train.Options:
        given.setdefault("set", [TINY])
        return train.Options(**{"library": library_folder, "output": Path("run"), "iterations": 4} | given)

    return options


def test_a_run_leaves_its_settings_metrics_and_checkpoints(base_run, library_folder):
    assert {path.name for path in base_run.folder.iterdir()} == {
        "checkpoints",
        "config.yaml",
        "events",
        "metrics.jsonl",
    }
    config = load_config(base_run.folder / "config.yaml")
    assert (config.preset, config.library, config.iterations) == ("cpu", str(library_folder), 4)
    assert (config.ppo.num_envs, config.ppo.actor_layers, config.wrench.max_gain) == (8, (16,), 0.5)
    assert [row["iteration"] for row in base_run.rows] == [1, 2, 4]
    assert all(np.isfinite(value) for row in base_run.rows for value in row.values() if isinstance(value, float))
    assert sum(clip["step_share"] for clip in base_run.rows[0]["clips"].values()) == pytest.approx(1.0, abs=1e-4)
    info = checkpoint.read_info(base_run.checkpoint(4))
    assert (info.iteration, info.environment_steps, info.config) == (4, 4 * 8 * 4, config)


def test_it_ends_with_where_the_results_are_and_what_to_do_next(base_run):
    printed = base_run.printed.splitlines()
    assert printed[0] == "train g1: 0/4"
    assert f"checkpoint   {base_run.checkpoint(4)}" in printed
    assert printed[-1] == f"Next: make evaluate ROBOT=g1 CHECKPOINT={base_run.checkpoint(4)}"


def start(output: Path, *arguments: object) -> subprocess.Popen:
    command = [sys.executable, "-m", "forgetmimic_jax.train", "--iterations", "1000000", "--output", output]
    return subprocess.Popen([*map(str, command), *map(str, arguments)], stderr=subprocess.PIPE, text=True)


def wait_for(process: subprocess.Popen, output: Path, iteration: int) -> None:
    """Until a checkpoint at or past `iteration` is there."""
    deadline = time.monotonic() + 120.0
    while (newest := newest_checkpoint(output)) is None or int(newest.name) < iteration:
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_run_survives_ctrl_c_and_kill_9_bit_for_bit(tmp_path, library_folder, options):
    output = tmp_path / "run"
    process = start(output, "--library", library_folder, "--set", *TINY)
    wait_for(process, output, 4)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[1]
    stopped = newest_checkpoint(output)
    assert process.returncode == 130
    assert said == f"stopped; saved {stopped}; continue with: make train ROBOT=g1 RESUME=1 OUTPUT={output}\n"

    process = start(output, "--resume", "--set", "checkpoint_every=1")
    wait_for(process, output, int(stopped.name) + 3)
    process.kill()
    process.communicate()
    iterations = int(newest_checkpoint(output).name) + 2
    again = finished(train.main, train.Options(output=output, iterations=iterations, resume=True))
    unbroken = finished(train.main, options(output=tmp_path / "unbroken", iterations=iterations))
    assert_same(load_state(again.checkpoint(iterations)), load_state(unbroken.checkpoint(iterations)))
    saved, whole = (load_config(tmp_path / run / "config.yaml") for run in ("run", "unbroken"))
    assert saved == dataclasses.replace(whole, checkpoint_every=1)
    # Rows may be shorter where it stopped; no iteration is missing or twice.
    iterations_logged = [row["iteration"] for row in again.rows]
    assert iterations_logged == sorted(set(iterations_logged))
    assert {row["iteration"] for row in unbroken.rows} <= set(iterations_logged)


def test_training_may_go_on_from_a_base_with_other_clips(base_run, tmp_path, library_folder):
    library = Path(shutil.copytree(library_folder, tmp_path / "library"))
    manifest = read_manifest(library)
    del manifest["clips"]["nod"]
    write_manifest(library, manifest)
    config = checkpoint.read_info(base_run.checkpoint(4)).config
    config = dataclasses.replace(config, library=str(library), base=str(base_run.checkpoint(4)))
    state = started(make_setup(config))
    assert_same(state.policy, load_state(base_run.checkpoint(4)).policy)
    assert all((np.asarray(leaf) == 0).all() for leaf in jax.tree.leaves(state.optimizer))
    assert state.failure_level.shape[0] == 2


def test_what_a_base_lived_counts_for_the_training_that_goes_on_from_it(base_run, tmp_path, options):
    further = finished(train.main, options(output=tmp_path / "run", base=base_run.checkpoint(4), iterations=2))
    assert [row["environment_steps"] for row in further.rows] == [(4 + done) * 8 * 4 for done in (1, 2)]
    assert checkpoint.read_info(further.checkpoint(2)).environment_steps == (4 + 2) * 8 * 4


def test_settings_given_twice_add_up():
    options = parse(train.Options, "train", ["--set", "ppo.num_envs=8", "seed=1", "--set", "iterations=3"])
    assert [*itertools.chain(*options.set)] == ["ppo.num_envs=8", "seed=1", "iterations=3"]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"robot": "gg1"}, "robot 'gg1': no robots/gg1/gg1.yaml; did you mean 'g1'?"),
        ({"library": Path("nowhere")}, "nowhere/manifest.json: not found; a library is a folder with manifest.json"),
        ({"iterations": 0}, "iterations: found 0; accepted: a whole number from 1"),
        ({"seed": -1}, "seed: found -1; accepted: a whole number from 0 to 4294967295"),
        ({"base": Path("nowhere")}, "nowhere: no such checkpoint folder"),
        ({"resume": True}, "run: --resume finds no checkpoint there; leave it out to start"),
        ({"set": [["ppo.epochs"]]}, "--set ppo.epochs: accepted: SECTION.NAME=VALUE, such as ppo.learning_rate=1e-4"),
        ({"set": [["pppo.epochs=1"]]}, "--set: no setting 'pppo'; did you mean 'ppo'?"),
        ({"set": [["ppo.epochs=many"]]}, "--set: ppo.epochs: found 'many'; accepted: a whole number from 1"),
        ({"set": [["ppo.epochs=[1"]]}, "--set ppo.epochs=[1: found '[1'; accepted: a number, a word or [a, list]"),
        (
            {"set": [["ppo.schedule=cosine"]]},
            "--set: ppo.schedule: found 'cosine'; accepted: adaptive, adaptive_iteration, fixed, trapezoid",
        ),
        (
            {"set": [[*TINY, "ppo.minibatches=33"]]},
            "ppo.minibatches: found 33; accepted: 1 to 32, the steps of each device",
        ),
        ({"set": [[*TINY, "ppo.discount=nan"]]}, "--set: ppo.discount: found 'nan'; accepted: a number from 0 to 1"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_in_one_line(refused, options, given, message):
    assert refused(train.main, options(**given)) == message


def test_a_damaged_library_is_refused_in_one_line(refused, options, tmp_path, library_folder):
    library = Path(shutil.copytree(library_folder, tmp_path / "library"))
    content = bytearray((library / "turn.npz").read_bytes())
    content[len(content) // 2] ^= 1
    (library / "turn.npz").write_bytes(content)
    assert refused(train.main, options(library=library)).startswith(f"{library}/turn.npz: sha256 ")


def test_a_folder_that_cannot_be_the_run_s_is_refused(refused, options, tmp_path, base_run):
    (tmp_path / "file").write_text("mine")
    message = f"{tmp_path}/file is a file; choose another --output"
    assert refused(train.main, options(output=tmp_path / "file")) == f"{tmp_path}/file: {message}"
    assert refused(train.main, options(output=tmp_path / "file" / "run")) == f"{tmp_path}/file/run: {message}"
    message = f"{base_run.folder}: exists already; choose another --output, or continue with --resume"
    assert refused(train.main, options(output=base_run.folder)) == message


def test_flags_that_contradict_the_run_to_resume_are_refused(refused, base_run):
    def resume(**flags):
        return refused(train.main, train.Options(output=base_run.folder, resume=True, **flags))

    message = "but the run to resume has 0; leave the flag out"
    assert resume(seed=1) == f"--seed: found 1, {message}"
    assert resume(preset="paper").startswith("--preset: found paper, but the run to resume has cpu")
    assert resume(set=[["ppo.num_envs=16"]]) == (
        f"{base_run.checkpoint(4)}: ppo.num_envs: the checkpoint's is 8, this run's 16"
    )


def test_a_base_of_another_network_is_refused(refused, options, base_run):
    message = refused(train.main, options(base=base_run.checkpoint(4), set=[[*TINY, "ppo.actor_layers=[8,8]"]]))
    assert message == f"{base_run.checkpoint(4)}: ppo.actor_layers: the checkpoint's is [16], this run's [8, 8]"


def test_damaged_settings_of_the_run_to_resume_are_refused(refused, base_run, tmp_path):
    run = Path(shutil.copytree(base_run.folder, tmp_path / "run"))
    settings = (run / "config.yaml").read_text()
    for content, message in (
        (settings.replace("seed:", "sead:"), "no setting 'sead'; did you mean 'seed'?"),
        (
            settings.replace("seed: 0", "seed: zero"),
            "seed: found 'zero'; accepted: a whole number ",
        ),
        (settings.replace("seed: 0", "seed: [0"), "not YAML: "),
        ("", "found None; accepted: a table of settings"),
    ):
        (run / "config.yaml").write_text(content)
        assert refused(train.main, train.Options(output=run, resume=True)).startswith(f"{run}/config.yaml: {message}")
