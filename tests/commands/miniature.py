"""What tests of the commands share."""

import contextlib
import dataclasses
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from forgetmimic_jax.ppo.state import TrainState
from forgetmimic_jax.tracking.env import make_assets, make_environment
from forgetmimic_jax.tracking.setup import Setup, make_setup
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.start import start_state, template

# The assistive wrench is on, so that unlearning has something to turn off.
TINY = [
    *(
        "physics.engine=native",
        "evaluate_every=0",
        "checkpoint_every=2",
        "sampling.bin_seconds=0.4",
        "sampling.prior=bins",
    ),
    *(
        "wrench.max_gain=0.5",
        "ppo.num_envs=8",
        "ppo.branches=2",
        "ppo.num_steps=4",
        "ppo.epochs=2",
        "ppo.minibatches=2",
    ),
    *("ppo.actor_layers=[16]", "ppo.critic_layers=[16]"),
]


@dataclasses.dataclass(frozen=True)
class Run:
    """A run that came to its end: its folder and what it printed."""

    folder: Path
    printed: str

    def checkpoint(self, iteration: int) -> Path:
        return self.folder / "checkpoints" / f"{iteration:08d}"

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Of metrics.jsonl, without their clock, the one thing that two equal runs differ in."""
        rows = [json.loads(line) for line in (self.folder / "metrics.jsonl").read_text().splitlines()]
        return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]


def finished(main: Callable[[Any], None], options: Any) -> Run:
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        main(options)
    return Run(options.output, printed.getvalue())


def started(setup: Setup) -> TrainState:
    """The state that a run of the setup starts with."""
    return start_state(setup, make_environment(setup, setup.config.ppo.num_envs), make_assets(setup))


def load_state(path: Path) -> TrainState:
    """The whole state of a checkpoint."""
    info = checkpoint.read_info(path)
    setup = make_setup(info.config)
    shapes = template(make_environment(setup, info.config.ppo.num_envs), make_assets(setup))
    return checkpoint.load_state(info, shapes)
