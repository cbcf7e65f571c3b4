"""Evaluate a checkpoint clip by clip: `forgetmimic evaluate --robot g1`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from forgetmimic_jax.basics.errors import run_command
from forgetmimic_jax.settings.config import EngineName
from forgetmimic_jax.settings.options import at_least, comma_separated, parse

if TYPE_CHECKING:
    from forgetmimic_jax.training.comparison import Comparison


@dataclass
class Options:
    """Roll a policy out on every clip, deterministic and unassisted, beside the zero-action baseline."""

    robot: str = "g1"
    """Robot under robots/."""
    checkpoint: Path | None = None
    """Checkpoint, or the folder of a run; the shipped base data/ROBOT/base by default."""
    base: Path | None = None
    """For an unlearned checkpoint, the base to compare with; the one it started from by default."""
    targets: str | None = None
    """Clips that count as forgotten, comma-separated; by default those that the checkpoint unlearned."""
    episodes: int = 20
    """Episodes a clip: half from frame 0, half spread over the clip."""
    seed: int = 0
    """Seed of start frames and reset noise; the same for every policy."""
    noise: bool = False
    """Evaluate with the randomisation, the pushes and the sensor noise of training."""
    physics: EngineName | None = None
    """Physics engine; auto is native on a CPU and mjx on a GPU or TPU."""
    library: Path | None = None
    """Folder of clips, which may be other ones than the checkpoint's; the checkpoint's by default."""
    output: Path | None = None
    """Folder for evaluation.json, .md and .png; beside the checkpoints of the run, or runs/evaluate-ROBOT. An
    evaluation with noise has the folder `noise` there."""


def main(options: Options) -> None:
    """Evaluate, write the files and print the table."""
    from forgetmimic_jax.basics.console import closing
    from forgetmimic_jax.evaluation.evaluate import evaluate, show_and_write
    from forgetmimic_jax.training.checkpoint import read_info
    from forgetmimic_jax.training.comparison import load_comparison
    from forgetmimic_jax.training.folder import check_writable, folder_of
    from forgetmimic_jax.training.start import base_folder

    at_least(1, "--episodes", options.episodes)
    at_least(0, "--seed", options.seed)
    path = options.checkpoint or base_folder(options.robot)
    output = options.output or folder_of(path) or Path("runs") / f"evaluate-{options.robot}"
    output = output / "noise" if options.noise and options.output is None else output
    check_writable(output)
    compared = load_comparison(
        path,
        robot=options.robot,
        base=options.base,
        targets=None if options.targets is None else comma_separated(options.targets),
        library=options.library,
        physics=options.physics,
    )
    setup, path = compared.setup, read_info(path).path
    document = evaluate(
        setup,
        compared.subjects,
        checkpoint=str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path),
        targets=compared.targets,
        episodes=options.episodes,
        seed=options.seed,
        noise=options.noise,
    )
    closing(show_and_write(output, document), _next(options, compared))


def _next(options: Options, compared: Comparison) -> str:
    """Unlearning from a base on its own library, if a clip would be left to keep; else the viewer."""
    from forgetmimic_jax.basics.console import command_line
    from forgetmimic_jax.tracking.setup import default_targets

    names, checkpoint = compared.setup.library.names, options.checkpoint
    if list(compared.info) != ["base"] or options.library is not None or len(names) == 1:
        return command_line("play", robot=options.robot, checkpoint=checkpoint, library=options.library)
    targets = None if default_targets(compared.setup.config) else ",".join(compared.targets) or names[0]
    return command_line("unlearn", robot=options.robot, base=checkpoint, targets=targets)


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "evaluate")))
