"""Train a policy by plain PPO: `forgetmimic train --robot g1`."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from pathlib import Path

from forgetmimic_jax.basics.errors import run_command
from forgetmimic_jax.settings.config import EngineName, Preset
from forgetmimic_jax.settings.options import Settings, check_same, on_engine, override, parse, replace_given


@dataclass
class Options:
    """Train a motion-tracking policy on a library of clips by plain PPO. Ctrl-C saves and stops; --resume continues."""

    robot: str = "g1"
    """Robot under robots/."""
    preset: Preset = "cpu"
    """Settings to start from: cpu for a laptop, paper for a GPU."""
    iterations: int | None = None
    """PPO iterations; the preset's by default."""
    seed: int | None = None
    """Random seed; 0 by default."""
    physics: EngineName | None = None
    """Physics engine; auto is native on a CPU and mjx on a GPU or TPU."""
    devices: int | None = None
    """Devices that share the environments: GPUs, or on a CPU parts of its cores; 1 by default (docs/cluster.md)."""
    library: Path | None = None
    """Folder of clips; data/ROBOT by default."""
    base: Path | None = None
    """Checkpoint whose policy to start from, another robot's too, with its observations and actions; a random
    policy by default."""
    output: Path | None = None
    """Folder of the run; runs/train-ROBOT by default."""
    resume: bool = False
    """Continue from the newest checkpoint in the output folder, with the settings saved there."""
    set: Settings = field(default_factory=list)
    """Any other settings, such as ppo.learning_rate=1e-4."""


def main(options: Options) -> None:
    """Train, and say where the checkpoint is."""
    from forgetmimic_jax.basics.console import closing, command_line
    from forgetmimic_jax.settings.config import load_config, preset
    from forgetmimic_jax.tracking.setup import make_setup
    from forgetmimic_jax.training.devices import join, own_folder
    from forgetmimic_jax.training.folder import BEST, prepare_folder
    from forgetmimic_jax.training.run import run
    from forgetmimic_jax.training.start import with_interface_of_base

    output = options.output or Path("runs") / f"train-{options.robot}"
    prepare_folder(output, resume=options.resume)
    if options.resume:
        config = load_config(output / "config.yaml")
        check_same(options, {name: getattr(config, name) for name in ("robot", "preset", "seed", "library", "base")})
    else:
        config = replace_given(
            preset(options.preset),
            robot=options.robot,
            seed=options.seed,
            library=options.library,
            base=options.base,
        )
        config = with_interface_of_base(config)
    config = replace_given(config, iterations=options.iterations, devices=options.devices)
    config = on_engine(override(config, itertools.chain(*options.set)), options.physics)
    join(config)
    output = own_folder(output)
    setup = make_setup(config)
    path, _ = run(setup, output, description=f"train {config.robot}", resume=options.resume)
    best = output / BEST
    files = {"checkpoint": path}
    if best.is_dir():
        files |= {"best policy": best, "clips over time": output / "evaluations.png"}
    files |= {"curves": output / "metrics.jsonl", "TensorBoard": output / "events"}
    closing(files, command_line("evaluate", robot=config.robot, checkpoint=files.get("best policy", path)))


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "train")))
