"""The whole path in miniature: a base of four iterations and a policy that forgets `turn` for two more."""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from miniature import TINY, Run, finished

from forgetmimic_jax import train, unlearn
from forgetmimic_jax.basics.errors import run_command
from forgetmimic_jax.evaluation.rollout import Evaluator
from forgetmimic_jax.evaluation.side_by_side import SideBySide
from forgetmimic_jax.settings.config import config_hash
from forgetmimic_jax.training import comparison, run


@pytest.fixture(scope="session", autouse=True)
def compiled_once() -> Iterator[None]:
    """Runs of the same settings share one compiled iteration; it depends on none of the settings left out here."""
    make, compiled = run.make_iteration, {}

    def shared(env, rule, mesh=None):
        key = config_hash(dataclasses.replace(env.config, seed=0))
        return compiled.setdefault(key, make(env, rule, mesh))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "make_iteration", shared)
        yield


@pytest.fixture(scope="module", autouse=True)
def rolled_out_once() -> Iterator[None]:
    """Evaluations on the same episodes of environments with equal settings share what is compiled.

    Of one file alone, since every environment also holds the memory of its simulations.
    """
    made: dict[tuple, Any] = {}

    def program_of(rolls: Evaluator | SideBySide) -> tuple:
        """What the compiled functions depend on, beside the shapes of their arguments."""
        env, own = (
            (rolls._env, (rolls.clip.tobytes(), rolls.start_frame.tobytes(), rolls._seed))
            if isinstance(rolls, Evaluator)
            else (rolls.env, (rolls.names, rolls._starts))
        )
        config, robot = env.config, [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(env.robot.arrays)]
        settings = (config.physics, config.observation, config.action, config.reward, config.termination, config.noise)
        rest = (config.max_episode_steps, env.num_envs, env.noisy, env.runs_on, env.replace_reference)
        return (type(rolls), *own, *robot, str(settings), *rest)

    def shared(make: Callable[..., None]) -> Callable[..., None]:
        def init(self, *given, **more) -> None:
            make(self, *given, **more)
            for name in ("_begin", "_advance"):
                setattr(self, name, made.setdefault((name, *program_of(self)), getattr(self, name)))

        return init

    with pytest.MonkeyPatch.context() as patch:
        for kind in (Evaluator, SideBySide):
            patch.setattr(kind, "__init__", shared(kind.__init__))
        yield


@pytest.fixture(scope="session", autouse=True)
def checked_once() -> Iterator[None]:
    """Whether a base completes anything is found once for a policy and its clips, since that compiles an evaluation."""
    check, found = comparison.completes_nothing, {}

    def once(setup, policy):
        key = (
            comparison.Evaluator,
            setup.library.names,
            *(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(policy)),
        )
        if key not in found:
            found[key] = check(setup, policy)
        return found[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(comparison, "completes_nothing", once)
        yield


@pytest.fixture(scope="session")
def base_run(tmp_path_factory, library_folder) -> Run:
    output = tmp_path_factory.mktemp("runs") / "base"
    return finished(train.main, train.Options(library=library_folder, output=output, iterations=4, set=[TINY]))


@pytest.fixture(scope="session")
def unlearned_run(base_run) -> Run:
    output = base_run.folder.parent / "unlearned"
    options = unlearn.Options(
        base=base_run.checkpoint(4), targets=" turn, turn ,", iterations=2, episodes=3, output=output
    )
    return finished(unlearn.main, options)


@pytest.fixture
def refused(tmp_path, monkeypatch, capfd) -> Callable[[Callable[[Any], None], Any], str]:
    """`refused(main, options)`: the one line that a command ends with, having left every file as it was."""
    monkeypatch.chdir(tmp_path)

    def files() -> dict[Path, bytes | None]:
        return {path: path.read_bytes() if path.is_file() else None for path in tmp_path.rglob("*")}

    def refused(main: Callable[[Any], None], options: Any) -> str:
        before = files()
        with pytest.raises(SystemExit) as exit_:
            run_command(lambda: main(options))
        printed, error = capfd.readouterr()
        assert exit_.value.code == 2
        assert printed == ""
        assert error.startswith("error: ")
        assert error.count("\n") == 1
        assert files() == before
        return error.removeprefix("error: ").rstrip()

    return refused
