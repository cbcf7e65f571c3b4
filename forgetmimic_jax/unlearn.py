"""Forget chosen clips: `python -m forgetmimic_jax.unlearn --robot g1 --targets punch,kick`."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from forgetmimic_jax.config import Config, UnlearnConfig, load_config, preset
from forgetmimic_jax.errors import InputError, run_command
from forgetmimic_jax.options import (
    Settings,
    at_least,
    check_same,
    comma_separated,
    on_engine,
    override,
    parse,
    replace_given,
)


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
    set: Settings = field(default_factory=list)
    """Any other settings, such as sampling.rule=adaptive."""


ITERATIONS = {"cpu": 400, "paper": 1000}


def main(options: Options) -> None:
    """Unlearn, evaluate base, unlearned and zero action, and print what was forgotten and what was kept."""
    from forgetmimic_jax import checkpoint, runner
    from forgetmimic_jax.console import closing
    from forgetmimic_jax.evaluation.evaluate import cost, evaluate, show_and_write

    at_least(1, "--episodes", options.episodes)
    output = options.output or runner.default_folder(f"unlearn-{options.robot}", resume=options.resume)
    runner.prepare_folder(output, resume=options.resume)
    config = _config_of_run(options, output) if options.resume else _config_of_new_run(options)
    config = override(replace_given(config, iterations=options.iterations), itertools.chain(*options.set))
    if not config.unlearn.targets:
        raise InputError("--targets: no clip named; name at least one to forget, such as --targets punch,kick")
    setup = runner.make_setup(on_engine(config, options.physics))
    base = runner.base_checkpoint(config)
    info = checkpoint.read_info(base)
    checkpoint.check_matches(info, setup.robot, setup.library, setup.library_hash, config)
    description = f"forget {', '.join(config.unlearn.targets)}"
    path, state = runner.run(setup, output, description=description, resume=options.resume)
    base_policy = checkpoint.load_policy(base, runner.template(setup))
    try:
        document = evaluate(
            setup.config,
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
    except KeyboardInterrupt:
        raise runner.interrupted(config, output) from None
    files = {"unlearned policy": path, **show_and_write(output, document), "curves": output / "metrics.jsonl"}
    closing(files, f"make evaluate ROBOT={config.robot} CHECKPOINT={path} EPISODES=100")


def _config_of_new_run(options: Options) -> Config:
    """The base's settings, or the preset's, with the anti-reward."""
    from forgetmimic_jax import checkpoint, runner
    from forgetmimic_jax.unlearning.antireward import unlearning_config

    base = checkpoint.read_info(options.base or runner.base_folder(options.robot)).config
    config = base
    if options.preset:
        config = preset(options.preset)
        # The network is the base's: it is what unlearning starts from.
        layers: dict[str, Any] = {name: getattr(base.ppo, name) for name in ("actor_layers", "critic_layers")}
        config = dataclasses.replace(config, library=base.library, ppo=dataclasses.replace(config.ppo, **layers))
    config = dataclasses.replace(config, base=None, evaluate_every=0, iterations=ITERATIONS[options.preset or "cpu"])
    config = replace_given(config, robot=options.robot, seed=options.seed, library=options.library, base=options.base)
    targets = runner.default_targets(config) if options.targets is None else comma_separated(options.targets)
    return unlearning_config(config, UnlearnConfig(targets=targets, penalty=options.penalty))


def _config_of_run(options: Options, output: Path) -> Config:
    """The settings of the run to resume, which no flag contradicts."""
    config = load_config(output / "config.yaml")
    if options.targets is not None:
        options = dataclasses.replace(options, targets=",".join(comma_separated(options.targets)))
    check_same(options, {name: getattr(config, name) for name in ("robot", "preset", "seed", "library", "base")})
    check_same(options, {"targets": ",".join(config.unlearn.targets), "penalty": config.unlearn.penalty})
    return config


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "unlearn")))
