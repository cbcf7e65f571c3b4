"""Forget chosen clips: `forgetmimic unlearn --robot g1 --targets punch,kick`."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.settings.config import Config, UnlearnConfig, WrenchConfig, load_config, preset
from forgetmimic_jax.settings.options import (
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
    """Make a base policy forget the target clips, by default with the anti-reward, then evaluate before and after.

    Uniform sampling, no assistive wrench, Adam reset (the paper's ForgetMimic); at laptop scale kept clips are held to
    the base and targets have half of the starts (--set ppo.anchor=0 sampling.target_share=0 leaves both out). Stop with
    Ctrl-C, go on with --resume.
    """

    robot: str = "g1"
    """Robot under robots/."""
    targets: str | None = None
    """Clips to forget, comma-separated; the library's default targets (g1: punch,kick) by default."""
    method: str = "arft"
    """How, by the name of a file of forgetmimic_jax/unlearning:
    arft (the paper's), distill, retrain, finetune,
    random_reward, negated_reward, gradient_ascent,
    trajdeleter, poisoning, decremental or policy_edit."""
    penalty: float = 16.0
    """Penalty λ of arft on the targets' normalised tracking reward; W = 8 is the paper's edge."""
    sampler: Literal["uniform_clips", "uniform_bins", "frozen", "adaptive"] | None = None
    """How starts are drawn; frozen: as the base's last ones. uniform_clips by default, for retrain the base's own."""
    wrench: bool = False
    """Assist by the wrench, as strongly as the base's training did (at most 0.6 where it had none)."""
    clips: Literal["all", "kept"] | None = None
    """Clips that episodes start from; all by default; distill, retrain, finetune: kept."""
    preset: Literal["cpu", "paper"] | None = None
    """Settings of the fine-tuning; by default the base's own, at the default budget of a laptop."""
    iterations: int | None = None
    """PPO iterations; 640 by default (1000 with --preset paper), distill: 200,
    retrain: as many steps as the base was trained for."""
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
    """Any other settings, such as ppo.learning_rate=1e-4."""


def main(options: Options) -> None:
    """Unlearn, evaluate base, new policy and zero action, and print what was forgotten and what was kept."""
    from forgetmimic_jax.basics.console import closing, command_line
    from forgetmimic_jax.basics.provenance import provenance
    from forgetmimic_jax.evaluation.evaluate import evaluate, show_and_write
    from forgetmimic_jax.tracking.setup import make_setup
    from forgetmimic_jax.training import checkpoint
    from forgetmimic_jax.training.comparison import subject
    from forgetmimic_jax.training.folder import default_folder, prepare_folder
    from forgetmimic_jax.training.run import interrupted, run
    from forgetmimic_jax.training.start import base_checkpoint, base_policy
    from forgetmimic_jax.unlearning.registry import method_of

    at_least(1, "--episodes", options.episodes)
    provenance()  # of the code that is loaded now; a checkout may change while the run trains
    output = options.output or default_folder(f"unlearn-{options.robot}", resume=options.resume)
    prepare_folder(output, resume=options.resume)
    config = _config_of_run(options, output) if options.resume else config_of_new_run(options)
    config = override(replace_given(config, iterations=options.iterations), itertools.chain(*options.set))
    if not config.unlearn.targets:
        raise InputError("--targets: no clip named; name at least one to forget, such as --targets punch,kick")
    setup = make_setup(on_engine(config, options.physics))
    base = base_policy(setup)
    setup = dataclasses.replace(setup, base=base)
    info = checkpoint.read_info(base_checkpoint(config))
    description = f"forget {', '.join(config.unlearn.targets)}"
    method = method_of(config)
    if method.result == "fine_tuned" and config.sampling.clips == "all":
        description = "fine-tune on all clips"  # which is no forgetting
    elif config.unlearn.method != UnlearnConfig.method:
        description += f" by {config.unlearn.method}"
    path, state = run(setup, output, description=description, resume=options.resume)
    try:
        document = evaluate(
            setup,
            {
                "base": subject(base, info),
                method.result: subject(state.policy, checkpoint.read_info(path)),
            },
            checkpoint=str(path),
            targets=config.unlearn.targets,
            episodes=options.episodes,
            seed=config.seed,
        )
    except KeyboardInterrupt:
        raise interrupted(config, output) from None
    name = f"{method.result.replace('_', '-')} policy"
    files = {name: path, **show_and_write(output, document), "curves": output / "metrics.jsonl"}
    closing(files, command_line("evaluate", robot=config.robot, checkpoint=path, episodes=100))


def config_of_new_run(options: Options) -> Config:
    """The base's settings, or the preset's, as the method and the flags change them."""
    from forgetmimic_jax.tracking.setup import default_targets
    from forgetmimic_jax.training import checkpoint
    from forgetmimic_jax.training.start import base_folder
    from forgetmimic_jax.unlearning.registry import find_method, unlearning_config

    info = checkpoint.read_info(options.base or base_folder(options.robot))
    config = _on_preset(info.config, options.preset) if options.preset else info.config
    config = dataclasses.replace(config, base=None, evaluate_every=0)
    config = replace_given(config, robot=options.robot, seed=options.seed, library=options.library, base=options.base)
    targets = default_targets(config) if options.targets is None else comma_separated(options.targets)
    unlearn = UnlearnConfig(targets=targets, penalty=options.penalty, method=options.method)
    config = unlearning_config(config, unlearn)
    pace = find_method(options.method).pace
    config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, **pace.ppo.get(config.preset, {})))
    sampling = replace_given(config.sampling, rule=options.sampler, clips=options.clips)
    if (sampling.rule, sampling.clips) == ("uniform_clips", "all"):  # the other samplers' shares are their own
        sampling = dataclasses.replace(sampling, target_share=pace.target_share.get(config.preset, 0.0))
    wrench = config.wrench
    if options.wrench:
        wrench = dataclasses.replace(wrench, max_gain=info.config.wrench.max_gain or WrenchConfig.max_gain)
    if pace.iterations:
        iterations = pace.iterations[options.preset or "cpu"]
    elif info.environment_steps or options.iterations:
        iterations = max(1, round(info.environment_steps / (config.ppo.num_envs * config.ppo.num_steps)))
    else:
        raise InputError(f"--iterations: {info.path} does not say how long it was trained; say how long to retrain")
    return dataclasses.replace(config, iterations=iterations, sampling=sampling, wrench=wrench)


def _on_preset(base: Config, name: str) -> Config:
    """A preset's settings with what the base's policy brings: its observation, network, bins and clips."""
    config = preset(name)
    return dataclasses.replace(
        config,
        library=base.library,
        observation=base.observation,
        sampling=dataclasses.replace(config.sampling, bin_seconds=base.sampling.bin_seconds),
        ppo=dataclasses.replace(config.ppo, actor_layers=base.ppo.actor_layers, critic_layers=base.ppo.critic_layers),
    )


def _config_of_run(options: Options, output: Path) -> Config:
    """The settings of the run to resume, which no flag contradicts."""
    config = load_config(output / "config.yaml")
    if options.targets is not None:
        options = dataclasses.replace(options, targets=",".join(comma_separated(options.targets)))
    check_same(options, {name: getattr(config, name) for name in ("robot", "preset", "seed", "library", "base")})
    unlearn, sampling = config.unlearn, config.sampling
    check_same(options, {"targets": ",".join(unlearn.targets), "penalty": unlearn.penalty, "method": unlearn.method})
    check_same(options, {"sampler": sampling.rule, "clips": sampling.clips, "wrench": config.wrench.max_gain > 0})
    return config


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "unlearn")))
