"""Evaluate a checkpoint clip by clip: `forgetmimic evaluate --robot g1`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from forgetmimic_jax.basics.errors import run_command
from forgetmimic_jax.settings.config import EngineName
from forgetmimic_jax.settings.options import at_least, comma_separated, parse


@dataclass
class Options:
    """Roll a policy out on every clip, deterministic and unassisted, beside the zero-action baseline."""

    robot: str = "g1"
    """Robot under robots/."""
    checkpoint: Path | None = None
    """Checkpoint folder; the shipped base data/ROBOT/base by default."""
    base: Path | None = None
    """For an unlearned checkpoint, the base to compare with; the one it started from by default."""
    targets: str | None = None
    """Clips that count as forgotten, comma-separated; by default those that the checkpoint unlearned."""
    episodes: int = 20
    """Episodes a clip: half from frame 0, half spread over the clip."""
    seed: int = 0
    """Seed of start frames and reset noise; the same for every policy."""
    physics: EngineName | None = None
    """Physics engine; auto is native on a CPU and mjx on a GPU or TPU."""
    library: Path | None = None
    """Folder of clips; the checkpoint's by default."""
    output: Path | None = None
    """Folder for evaluation.json, .md and .png; beside the checkpoints of the run, or runs/evaluate-ROBOT."""


def main(options: Options) -> None:
    """Evaluate, write the files and print the table."""
    from forgetmimic_jax.basics.console import closing, command_line
    from forgetmimic_jax.evaluation.evaluate import evaluate, show_and_write
    from forgetmimic_jax.training.comparison import load_comparison
    from forgetmimic_jax.training.folder import check_writable, folder_of
    from forgetmimic_jax.training.start import base_folder

    at_least(1, "--episodes", options.episodes)
    at_least(0, "--seed", options.seed)
    path = options.checkpoint or base_folder(options.robot)
    output = options.output or folder_of(path) or Path("runs") / f"evaluate-{options.robot}"
    check_writable(output)
    compared = load_comparison(
        path,
        robot=options.robot,
        base=options.base,
        targets=None if options.targets is None else comma_separated(options.targets),
        library=options.library,
        physics=options.physics,
    )
    setup = compared.setup
    document = evaluate(
        setup,
        compared.subjects,
        checkpoint=str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path),
        targets=compared.targets,
        episodes=options.episodes,
        seed=options.seed,
    )
    base = options.checkpoint if list(compared.info) == ["base"] else None
    closing(show_and_write(output, document), command_line("unlearn", robot=options.robot, base=base))


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "evaluate")))
