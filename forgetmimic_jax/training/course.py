"""What a run does after its iterations: plain training evaluates, pretraining may change its phase."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from rich.console import Console

from forgetmimic_jax.ppo.state import TrainState
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.env import Assets, Environment
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.checkpoint import CheckpointInfo, Progress
from forgetmimic_jax.training.folder import BEST
from forgetmimic_jax.training.start import unlearned_base
from forgetmimic_jax.training.watch import Watch


@dataclass(frozen=True)
class Position:
    """Where a run is."""

    state: TrainState
    assets: Assets
    iteration: int
    environment_steps: int


class Course(Protocol):
    """What a run does before its first iteration and after each."""

    @property
    def command(self) -> str:
        """The command that continues the run with --resume."""
        ...

    @property
    def finished(self) -> bool:
        """Whether the run ends before its last iteration."""
        ...

    @property
    def curriculum(self) -> Mapping[str, Any] | None:
        """Plain values for the checkpoint, from which the course can continue."""
        ...

    @property
    def note(self) -> Mapping[str, Any]:
        """More fields for the rows of the log; what stands under `clips` is by clip."""
        ...

    def begin(self, position: Position) -> Position:
        """Before the first iteration, of a new run or of one that is resumed."""
        ...

    def after(self, position: Position) -> Position:
        """After an iteration; the run continues from the position that is returned."""
        ...


MakeCourse = Callable[[Setup, Environment, Path, Console, CheckpointInfo | None], Course]


def evaluates(config: Config, iteration: int) -> bool:
    """Whether a run is evaluated after its iteration `iteration`."""
    return config.evaluate_every > 0 and iteration % config.evaluate_every == 0


class Plain:
    """The same training all along; `best/` is the best policy on the clips to keep, of those evaluated."""

    def __init__(
        self, setup: Setup, env: Environment, directory: Path, console: Console, resumed: CheckpointInfo | None
    ):
        self.command = "unlearn" if setup.config.unlearn.targets else "train"
        self._setup, self._directory, self._console = setup, directory, console
        self._watch: Watch | None = None

    @property
    def finished(self) -> bool:
        return False

    @property
    def curriculum(self) -> Mapping[str, Any] | None:
        return None

    @property
    def note(self) -> Mapping[str, Any]:
        return {}

    def begin(self, position: Position) -> Position:
        if self._setup.config.evaluate_every:
            self._watch = Watch(self._setup, self._directory, position.iteration)
        return position

    def after(self, position: Position) -> Position:
        if evaluates(self._setup.config, position.iteration):
            self._evaluate(position)
        return position

    def _evaluate(self, position: Position) -> None:
        assert self._watch is not None
        state = position.state
        row = self._watch.measure(state.policy, position.iteration, position.environment_steps)
        if self._watch.add(row):
            base = unlearned_base(self._setup.config)
            progress = Progress(position.iteration, position.environment_steps, base)
            checkpoint.save_policy(self._directory / BEST, self._setup, state.policy, state.failure_level, progress)
        self._console.print(self._watch.table())
