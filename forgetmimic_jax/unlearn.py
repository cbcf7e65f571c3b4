"""Forget chosen clips: `python -m forgetmimic_jax.unlearn --robot g1 --targets punch,kick`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from forgetmimic_jax.errors import run_command


@dataclass
class Options:
    """Fine-tune a base policy with the anti-reward on the target clips, then evaluate before and after.

    Uniform sampling, no assistive wrench, Adam reset (the paper's ForgetMimic). Stop with Ctrl-C, go on with --resume.
    """

    robot: str = "g1"
    """Robot under robots/."""
    targets: str | None = None
    """Clips to forget, comma-separated; the library's default targets (g1: punch,kick) by default."""
    penalty: float = 16.0
    """Penalty λ on the targets' normalised tracking reward; W = 8 is the paper's edge."""
    preset: Literal["cpu", "paper"] | None = None
    """Settings of the fine-tuning; by default the base's own, at the default budget of a laptop."""
    iterations: int | None = None
    """PPO iterations; 400 by default (1000 with --preset paper)."""
    seed: int = 0
    """Random seed of the fine-tuning and of the evaluation."""
    base: Path | None = None
    """Checkpoint to start from; the shipped data/ROBOT/base by default."""
    episodes: int = 20
    """Evaluation episodes a clip."""
    physics: Literal["auto", "native", "mjx", "mjx-warp"] | None = None
    """Physics engine; auto is native on a CPU and mjx on a GPU or TPU."""
    library: Path | None = None
    """Folder of clips; the base's by default."""
    output: Path | None = None
    """Folder of the run; the next free runs/unlearn-ROBOT-NUMBER by default."""
    resume: bool = False
    """Go on from the newest checkpoint in the output folder (by default the newest run), with its settings."""
    set: Annotated[list[str], tyro.conf.arg(metavar="SECTION.NAME=VALUE")] = field(default_factory=list)
    """Any other settings, such as sampling.rule=adaptive."""


ITERATIONS = {"cpu": 400, "paper": 1000}


def main(options: Options) -> None:
    """Unlearn, evaluate base, unlearned and zero action, and print what was forgotten and what was kept."""
    from forgetmimic_jax import checkpoint, runner
    from forgetmimic_jax.config import UnlearnConfig, load_config, preset
    from forgetmimic_jax.console import closing
    from forgetmimic_jax.errors import InputError
    from forgetmimic_jax.evaluation.evaluate import cost, evaluate, show_and_write
    from forgetmimic_jax.options import comma_separated, override
    from forgetmimic_jax.unlearning.antireward import unlearning_config

    if not options.penalty > 0:
        raise InputError(f"--penalty: found {options.penalty:g}; a number above 0 is needed (the paper's is 16)")
    if options.episodes < 1:
        raise InputError(f"--episodes: found {options.episodes}; at least 1 is needed")
    output = options.output or runner.default_folder(f"unlearn-{options.robot}", resume=options.resume)
    runner.prepare_folder(output, resume=options.resume)
    base = options.base or runner.base_folder(options.robot)
    info = checkpoint.read_info(base)
    if options.resume:
        config = load_config(output / "config.yaml")
        if options.iterations is not None:
            config = dataclasses.replace(config, iterations=options.iterations)
    else:
        config = dataclasses.replace(info.config, robot=options.robot, seed=options.seed)
        if options.library:
            config = dataclasses.replace(config, library=str(options.library))
        if options.preset:
            # The network is the base's: it is what unlearning starts from.
            network = {"actor_layers": config.ppo.actor_layers, "critic_layers": config.ppo.critic_layers}
            asked = preset(options.preset)
            config = dataclasses.replace(
                asked, robot=config.robot, seed=config.seed, library=config.library,
                ppo=dataclasses.replace(asked.ppo, **network),
            )  # fmt: skip
        targets = runner.default_targets(config) if options.targets is None else comma_separated(options.targets)
        if not targets:
            raise InputError("--targets: no clip named; name at least one to forget, such as --targets punch,kick")
        config = unlearning_config(config, UnlearnConfig(targets=targets, penalty=options.penalty))
        config = dataclasses.replace(config, iterations=options.iterations or ITERATIONS[options.preset or "cpu"])
        config = override(config, options.set)
    if options.physics:
        config = dataclasses.replace(config, physics=dataclasses.replace(config.physics, engine=options.physics))
    setup = runner.make_setup(config)
    description = f"forget {', '.join(config.unlearn.targets)}"
    path, state = runner.run(setup, output, description=description, base=base, resume=options.resume)
    base_policy = checkpoint.load_policy(base, runner.template(setup))
    document = evaluate(
        config,
        setup.robot,
        setup.library,
        setup.library_hash,
        {"base": base_policy, "unlearned": state.policy},
        checkpoint=str(path),
        targets=config.unlearn.targets,
        episodes=options.episodes,
        seed=config.seed,
        budget={"base": cost(info), "unlearned": cost(checkpoint.read_info(path))},
    )
    files = {"unlearned policy": path, **show_and_write(output, document), "curves": output / "metrics.jsonl"}
    closing(files, f"make evaluate ROBOT={config.robot} CHECKPOINT={path} EPISODES=100")


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(Options)))
