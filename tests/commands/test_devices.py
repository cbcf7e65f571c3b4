"""Runs on several devices and processes, beside a reference on one device that gets the same noise.

A CPU is two or four devices here, in processes of their own. The reference rolls out each shard's environments one
after the other, puts the steps together and learns from them as an iteration on one device does. Mini-batches are drawn
in another order on every number of devices, so there is one of them an epoch.
"""

import dataclasses
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from miniature import TINY, Run, finished, load_state, started
from trees import assert_same, leaves
from waiting import until

from forgetmimic_jax import pretrain, train, unlearn
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.ppo.collect import collect
from forgetmimic_jax.ppo.log import rollout_metrics
from forgetmimic_jax.ppo.state import TrainState
from forgetmimic_jax.ppo.update import advantages, improve, learn_normalizers, learn_sampler, make_batch
from forgetmimic_jax.settings.config import load_config
from forgetmimic_jax.tracking.env import make_assets, make_environment
from forgetmimic_jax.tracking.setup import Setup, make_setup
from forgetmimic_jax.training import run as run_module
from forgetmimic_jax.training.checkpoint import newest_checkpoint
from forgetmimic_jax.training.start import saved_state
from forgetmimic_jax.unlearning.registry import method_of

ITERATIONS = 2
ENVS, BRANCHES = 8, 2
ROUNDING = 2e-5  # of a parameter or a state, absolute; an iteration moves a parameter by 4e-4
SETTINGS = [*TINY, "wrench.max_gain=0", "ppo.minibatches=1", "ppo.schedule=fixed", "ppo.equal_clips=true"]


def process(output: Path, *arguments: object, **environment: object) -> subprocess.Popen:
    """`train` with these arguments in a process of its own."""
    return python("-m", "forgetmimic_jax", "train", "--output", output, *arguments, **environment)


def python(*arguments: object, **environment: object) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, *map(str, arguments)],
        env={**os.environ, **{name: str(value) for name, value in environment.items()}},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def printed(process: subprocess.Popen) -> str:
    out, error = process.communicate(timeout=600)
    assert process.returncode == 0, error
    return out


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


@pytest.fixture(scope="module")
def runs(library_folder, tmp_path_factory) -> SimpleNamespace:
    """Runs of two iterations on one, two and four devices, and the first one continued by two processes."""
    folder = tmp_path_factory.mktemp("devices")
    settings = ["--library", library_folder, "--iterations", ITERATIONS, "--set", *SETTINGS]
    several = {
        devices: process(folder / f"{devices}", "--devices", devices, *settings, PYTHON_CPU_COUNT=devices)
        for devices in (2, 4)
    }
    options = train.Options(library=library_folder, output=folder / "1", iterations=ITERATIONS, set=[SETTINGS])
    one = finished(train.main, options)
    shutil.copytree(one.folder, folder / "continued")
    together = {"JAX_COORDINATOR_ADDRESS": f"127.0.0.1:{free_port()}", "JAX_NUM_PROCESSES": 2, "PYTHON_CPU_COUNT": 1}
    temporary = [folder / f"temporary-{number}" for number in range(2)]
    processes = []
    for number in range(2):
        temporary[number].mkdir()
        more = ["--resume", "--devices", 2, "--iterations", 2 * ITERATIONS]
        own = {"JAX_PROCESS_ID": number, "TMPDIR": temporary[number]}
        processes.append(process(folder / "continued", *more, **together, **own))
    found = {devices: Run(folder / f"{devices}", printed(process)) for devices, process in several.items()}
    said = [printed(process) for process in processes]
    return SimpleNamespace(one=one, **{"two": found[2], "four": found[4]}, continued=Run(folder / "continued", said[0]),
                           said=said, temporary=temporary)  # fmt: skip


@pytest.fixture(scope="module")
def setup(runs) -> Setup:
    return make_setup(load_config(runs.one.folder / "config.yaml"))


class Reference:
    """Iterations on one device with the noise of several."""

    def __init__(self, setup: Setup, shards: int):
        config, assets, rule = setup.config, make_assets(setup), method_of(setup.config)
        self._assets, self._shards, self._each = assets, shards, ENVS // shards
        env = make_environment(setup, self._each)
        self._collect = jax.jit(lambda state: collect(env, assets, state, rule))

        @jax.jit
        def learn(state, transition, outcome):
            advantage, value_target = advantages(config.ppo, assets.focus.gae_lambda, outcome)
            batch = make_batch(config, assets, transition, outcome.value, advantage, value_target)
            state, losses = improve(config, assets.focus, state, batch, rule)
            state = learn_normalizers(state, transition)
            state = learn_sampler(config, state, transition.clip, outcome)
            return state, losses | rollout_metrics(config, assets, state, transition.clip, outcome)

        self._learn = learn

    def rollout(self, state: TrainState, shard: int):
        """State, transition and outcome of one shard."""
        rows = slice(shard * self._each, (shard + 1) * self._each)
        own = jax.tree.map(lambda x: x[rows], state.env)
        return self._collect(dataclasses.replace(state, env=own, key=jax.random.fold_in(state.key, shard)))

    def iterate(self, state: TrainState):
        """State and metrics after an iteration."""
        key = jax.random.fold_in(state.key, self._shards)
        parts = [self.rollout(state, shard) for shard in range(self._shards)]
        env = jax.tree.map(lambda *x: jnp.concatenate(x), *(after.env for after, _, _ in parts))
        steps = jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), *(seen for _, *seen in parts))
        state, metrics = self._learn(dataclasses.replace(state, env=env), *steps)
        return dataclasses.replace(state, key=key, iteration=state.iteration + 1), metrics


@pytest.fixture(scope="module")
def references(setup) -> dict[int, Reference]:
    return {shards: Reference(setup, shards) for shards in (2, 4)}


def assert_agree(found: TrainState, expected: TrainState) -> None:
    """The same but for rounding.

    Adam divides a gradient by its own size. A weight of an observation that is 0 but for rounding moves by rounding
    alone, so one weight in a hundred may differ.
    """
    found_leaves, expected_leaves = leaves(found), leaves(expected)
    assert found_leaves.keys() == expected_leaves.keys()
    for name, leaf in expected_leaves.items():
        if leaf.dtype.kind == "f":
            close = np.isclose(found_leaves[name], leaf, rtol=1e-3, atol=ROUNDING)
            assert close.mean() >= 0.99, (name, np.abs(found_leaves[name] - leaf).max())
        else:
            np.testing.assert_array_equal(found_leaves[name], leaf, err_msg=name)


@pytest.mark.parametrize(("devices", "name"), [(2, "two"), (4, "four")])
def test_several_devices_are_one_device_with_the_same_noise(runs, setup, references, devices, name):
    run, state = getattr(runs, name), started(setup)
    rows = []
    for _ in range(ITERATIONS):
        state, metrics = references[devices].iterate(state)
        rows.append(metrics)
    assert_agree(load_state(run.checkpoint(ITERATIONS)), state)
    shown = [metric for metric in rows[0] if metric in run.rows[0]]
    assert {"reward", "kl", "gradient_norm", "episode_length", "terminated/height"} & set(shown)
    for metric in shown:
        np.testing.assert_allclose(run.rows[0][metric], rows[0][metric], rtol=1e-3, atol=1e-6, err_msg=metric)
    assert sum(clip["step_share"] for clip in run.rows[0]["clips"].values()) == pytest.approx(1.0, abs=1e-4)
    assert load_config(run.folder / "config.yaml").devices == devices


def test_a_run_of_one_device_continues_in_two_processes_as_on_two_devices(runs, references):
    state = load_state(runs.one.checkpoint(ITERATIONS))
    for _ in range(ITERATIONS):
        state, _ = references[2].iterate(state)
    assert_agree(load_state(runs.continued.checkpoint(2 * ITERATIONS)), state)
    assert [row["iteration"] for row in runs.continued.rows] == [1, 2, 4]


def test_one_of_two_processes_prints_and_the_other_leaves_no_file(runs):
    first, second = runs.said
    assert "was made with --devices 1, this run has 2: its noise will differ" in first
    assert f"checkpoint   {runs.continued.checkpoint(2 * ITERATIONS)}" in first
    assert second == ""
    assert [list(folder.iterdir()) for folder in runs.temporary] == [[], []]


def test_a_process_without_the_state_takes_what_it_can_and_the_rest_from_the_first(runs, setup, tmp_path, monkeypatch):
    """As in METHOD=stand, whose teacher continues in the processes that have just trained it."""
    of_another = Path(shutil.copytree(runs.one.checkpoint(ITERATIONS), tmp_path / "checkpoint"))
    shutil.rmtree(of_another / "run")
    env, assets = make_environment(setup, ENVS), make_assets(setup)
    with pytest.raises(InputError, match="no run/ to resume from"):
        saved_state(setup, env, assets, of_another)
    monkeypatch.setattr(jax, "process_index", lambda: 1)
    found, steps = saved_state(setup, env, assets, of_another)
    first, of_the_first = saved_state(setup, env, assets, runs.one.checkpoint(ITERATIONS))
    assert (int(found.iteration), steps) == (ITERATIONS, of_the_first)
    assert jax.tree.map(jnp.shape, found) == jax.tree.map(jnp.shape, first)


def test_every_shard_draws_its_own_noise_and_keeps_its_branches(setup, references):
    state = started(setup)
    noise = []
    for shard in range(4):
        _, transition, _ = references[4].rollout(state, shard)
        noise.append(transition.action - transition.mean)
        first = np.asarray(transition.critic_observation[0]).reshape(
            -1, BRANCHES, transition.critic_observation.shape[-1]
        )
        np.testing.assert_array_equal(first[:, 0], first[:, 1])
    for one in range(4):
        for other in range(one):
            assert np.abs(noise[one] - noise[other]).min() > 0.0


def test_a_run_of_two_devices_continues_on_one(runs, setup, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(runs.two.folder, folder)
    resumed = finished(train.main, train.Options(output=folder, resume=True, devices=1, iterations=ITERATIONS + 1))
    assert "was made with --devices 2, this run has 1: its noise will differ" in resumed.printed
    assert int(newest_checkpoint(folder).name) == ITERATIONS + 1
    env = make_environment(setup, ENVS)
    iterate = run_module.make_iteration(env, method_of(setup.config))
    expected, _ = iterate(make_assets(setup), load_state(runs.two.checkpoint(ITERATIONS)))
    assert_same(load_state(resumed.checkpoint(ITERATIONS + 1)), expected)


ENDS = """
import dataclasses, sys
from pathlib import Path
from types import SimpleNamespace
import jax
from rich.console import Console
from forgetmimic_jax.settings.config import UnlearnConfig, load_config
from forgetmimic_jax.tracking.env import make_assets
from forgetmimic_jax.tracking.setup import make_setup
from forgetmimic_jax.training import stopping
from forgetmimic_jax.training.course import Position

settings, address, process = sys.argv[1:]
jax.distributed.initialize(address, 2, int(process))
stopping.Targets = lambda setup: SimpleNamespace(skill=lambda policy: float(process))
unlearn = UnlearnConfig(("turn",), settings={"penalty": 16.0}, stop_every=5)
setup = make_setup(dataclasses.replace(load_config(Path(settings)), evaluate_every=0, unlearn=unlearn))
course = stopping.Stopping(setup, None, Path("."), Console(), None)
position = course.begin(Position(SimpleNamespace(policy=None), make_assets(setup), 0, 0))
while not course.finished and position.iteration < 200:
    position = course.after(dataclasses.replace(position, iteration=position.iteration + 1))
print("the last iteration is", position.iteration)
"""


def test_two_processes_end_together_where_the_first_ones_targets_are_at_the_baseline(runs):
    """The second process measures a skill of 1 throughout; alone it would never end."""
    address = f"127.0.0.1:{free_port()}"
    both = [python("-c", ENDS, runs.one.folder / "config.yaml", address, number) for number in range(2)]
    assert [printed(process).splitlines()[-1] for process in both] == ["the last iteration is 110"] * 2


def test_a_process_whose_other_one_is_killed_ends_in_one_line(library_folder, tmp_path):
    together = {"JAX_COORDINATOR_ADDRESS": f"127.0.0.1:{free_port()}", "JAX_NUM_PROCESSES": 2, "PYTHON_CPU_COUNT": 1}
    given = ["--devices", 2, "--library", library_folder, "--iterations", 10**6, "--set", *SETTINGS]
    first, second = (process(tmp_path / "run", *given, **together, JAX_PROCESS_ID=number) for number in range(2))
    until(lambda: int((newest_checkpoint(tmp_path / "run") or Path("0")).name) > 0 or first.poll() is not None)
    second.kill()
    second.communicate()
    _, error = first.communicate(timeout=600)
    assert (first.returncode, error.count("\n")) == (1, 1), error
    assert error.startswith("error: ")
    assert error.endswith("; if another process has ended, start all of them again with --resume\n")


COMMANDS = [(train.main, train.Options), (pretrain.main, pretrain.Options), (unlearn.main, unlearn.Options)]


@pytest.mark.parametrize(("main", "options"), COMMANDS)
def test_a_number_of_devices_that_does_not_fit_is_refused(main, options, refused, library_folder, monkeypatch):
    monkeypatch.setenv("NPROC", "2")  # which a run on several devices sets
    given = {"output": Path("run"), "library": library_folder}
    if main is unlearn.main:
        given.pop("library")
    assert refused(main, options(**given, devices=256)) == (
        "devices: found 256; accepted: a divisor of num_envs / branches = 128"
    )
    assert refused(main, options(**given, devices=2)) == ("--devices: found 2; accepted: 1 (the cores that there are)")


def test_processes_that_do_not_fit_are_refused(refused, library_folder, monkeypatch):
    options = train.Options(output=Path("run"), library=library_folder, devices=4, iterations=1)
    monkeypatch.setenv("JAX_COORDINATOR_ADDRESS", "127.0.0.1:1")
    assert refused(train.main, options) == (
        "JAX_NUM_PROCESSES: found ''; accepted: a whole number, beside JAX_COORDINATOR_ADDRESS"
    )
    monkeypatch.setenv("JAX_NUM_PROCESSES", "3")
    together = "accepted: a multiple of 3, the processes that were started together"
    assert refused(train.main, options) == f"--devices: found 4; {together}"
    assert refused(train.main, dataclasses.replace(options, devices=None)) == f"--devices: found 1; {together}"


def test_a_gradient_step_needs_a_step_of_every_device(refused, library_folder):
    options = train.Options(output=Path("run"), library=library_folder, devices=2, set=[["ppo.minibatches=7000"]])
    assert refused(train.main, options) == "ppo.minibatches: found 7000; accepted: 1 to 6144, the steps of each device"
