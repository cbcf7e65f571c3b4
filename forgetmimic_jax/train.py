"""Train a base policy: `python -m forgetmimic_jax.train --robot g1`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from forgetmimic_jax.errors import run_command


@dataclass
class Options:
    """Train a motion-tracking policy on a library of clips. Stop with Ctrl-C (it saves first); go on with --resume."""

    robot: str = "g1"
    """Robot under robots/."""
    preset: Literal["cpu", "paper"] = "cpu"
    """Settings to start from: cpu for a laptop, paper for a GPU."""
    iterations: int | None = None
    """PPO iterations; the preset's by default."""
    seed: int | None = None
    """Random seed; 0 by default."""
    physics: Literal["auto", "native", "mjx", "mjx-warp"] | None = None
    """Physics engine; auto is native on a CPU and mjx on a GPU or TPU."""
    library: Path | None = None
    """Folder of clips; data/ROBOT by default."""
    base: Path | None = None
    """Checkpoint whose policy to start from; a random policy by default."""
    output: Path | None = None
    """Folder of the run; runs/train-ROBOT by default."""
    resume: bool = False
    """Go on from the newest checkpoint in the output folder, with the settings saved there."""
    set: Annotated[list[str], tyro.conf.arg(metavar="SECTION.NAME=VALUE")] = field(default_factory=list)
    """Any other settings, such as ppo.learning_rate=1e-4."""


def main(options: Options) -> None:
    """Train, and say where the checkpoint is."""
    from forgetmimic_jax import runner
    from forgetmimic_jax.config import load_config, preset
    from forgetmimic_jax.console import closing
    from forgetmimic_jax.options import override, replace_given

    output = options.output or Path("runs") / f"train-{options.robot}"
    if options.resume:
        config = load_config(output / "config.yaml")
    else:
        library = str(options.library) if options.library else None
        config = replace_given(preset(options.preset), robot=options.robot, seed=options.seed, library=library)
    config = override(replace_given(config, iterations=options.iterations), options.set)
    if options.physics:
        config = dataclasses.replace(config, physics=dataclasses.replace(config.physics, engine=options.physics))
    runner.prepare_folder(output, resume=options.resume)
    setup = runner.make_setup(config)
    path, _ = runner.run(setup, output, description=f"train {config.robot}", base=options.base, resume=options.resume)
    closing(
        {"checkpoint": path, "curves": output / "metrics.jsonl", "TensorBoard": output / "events"},
        f"python -m forgetmimic_jax.evaluate --robot {config.robot} --checkpoint {path}",
    )


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Options)))
