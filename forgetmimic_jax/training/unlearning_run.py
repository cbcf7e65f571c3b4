"""The flags of an unlearning run, and the settings that follow from them.

The command `unlearn` runs it, and the studies make many of them.
"""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.settings.config import (
    Config,
    EngineName,
    PPOConfig,
    Preset,
    PretrainConfig,
    SamplingConfig,
    UnlearnConfig,
    WrenchConfig,
    load_config,
    preset,
)
from forgetmimic_jax.settings.interface import with_interface
from forgetmimic_jax.settings.options import (
    Settings,
    check_same,
    comma_separated,
    on_engine,
    override,
    replace_given,
)

if TYPE_CHECKING:
    from forgetmimic_jax.training.checkpoint import CheckpointInfo
    from forgetmimic_jax.unlearning.method import Pace


@dataclass
class Options:
    """Make a base policy forget the target clips, by default with the anti-reward, then evaluate before and after.

    Uniform sampling, no assistive wrench, Adam reset (the paper's ForgetMimic). At laptop scale a KL term keeps the
    kept clips close to the base, and targets have half of the starts (--set ppo.base_kl=0 sampling.target_share=0
    leaves both out). Ctrl-C saves and stops; --resume continues.
    """

    robot: str = "g1"
    """Robot under robots/."""
    targets: str | None = None
    """Clips to forget, comma-separated; the library's default targets (g1: punch,kick) by default."""
    method: str = "arft"
    """Unlearning method, the name of a file of forgetmimic_jax/unlearning:
    arft (the paper's), distill, retrain, finetune,
    random_reward, negated_reward, gradient_ascent,
    trajdeleter, poisoning, decremental, policy_edit,
    or stand (the robot stands where a target is wanted)."""
    penalty: float | None = None
    """Penalty λ of arft on the targets' normalised tracking reward; 16 by default. The paper's threshold is W = 8."""
    sampler: Literal["uniform_clips", "uniform_bins", "frozen", "adaptive"] | None = None
    """How starts are drawn; frozen: by the base's failure levels. Default: uniform_clips; retrain: the base's own."""
    wrench: bool = False
    """Assist by the wrench, as strongly as the base's training did (at most 0.6 where it had none)."""
    clips: Literal["all", "kept"] | None = None
    """Clips that episodes start from; all by default; distill, retrain, finetune: kept."""
    preset: Preset | None = None
    """Settings of the fine-tuning; by default the base's own, at the default budget of a laptop."""
    iterations: int | None = None
    """PPO iterations; 640 by default, distill: 200, stand: 100 (with --preset paper 1000, 1000 and 400),
    retrain: as many steps as the base was trained for. With a stop rule the most of them."""
    no_stop: bool = False
    """Train all iterations. Without this flag arft, random_reward, negated_reward and gradient_ascent
    end soon after the targets' skill has fallen to the zero-action baseline."""
    seed: int = 0
    """Random seed of the fine-tuning and of the evaluation."""
    base: Path | None = None
    """Checkpoint to start from, or the folder of a run; the shipped data/ROBOT/base by default."""
    episodes: int = 20
    """Evaluation episodes a clip."""
    physics: EngineName | None = None
    """Physics engine; auto is native on a CPU and mjx on a GPU or TPU."""
    devices: int | None = None
    """Devices that share the environments: GPUs, or on a CPU parts of its cores; 1 by default (docs/cluster.md)."""
    library: Path | None = None
    """Folder of clips; the base's by default."""
    output: Path | None = None
    """Folder of the run; the next free runs/unlearn-ROBOT-NUMBER by default."""
    resume: bool = False
    """Continue from the newest checkpoint in the output folder (by default the newest run), with its settings."""
    set: Settings = field(default_factory=list)
    """Any other settings, such as ppo.learning_rate=1e-4."""


def config_of(options: Options, output: Path | None = None) -> Config:
    """Every setting of a run; with `resume`, those of the run in folder `output`."""
    config = _config_of_run(options, output) if options.resume and output else config_of_new_run(options)
    config = replace_given(config, iterations=options.iterations, devices=options.devices)
    config = override(config, itertools.chain(*options.set))
    return on_engine(config, options.physics)


def config_of_new_run(options: Options) -> Config:
    """The base's settings, or the preset's, as the method and the flags change them."""
    from forgetmimic_jax.tracking.setup import default_targets
    from forgetmimic_jax.training import checkpoint
    from forgetmimic_jax.training.start import base_folder
    from forgetmimic_jax.unlearning.registry import find_method, unlearning_config

    info = checkpoint.read_info(options.base or base_folder(options.robot))
    config = _on_preset(info.config, options.preset) if options.preset else info.config
    config = dataclasses.replace(config, base=None, evaluate_every=0, devices=1, pretrain=PretrainConfig())
    base = info.path if options.base else None  # a run's folder stands for another policy once the run continues
    config = replace_given(config, robot=options.robot, seed=options.seed, library=options.library, base=base)
    targets = default_targets(config) if options.targets is None else comma_separated(options.targets)
    settings = {} if options.penalty is None else {"penalty": options.penalty}
    config = unlearning_config(config, UnlearnConfig(targets, options.method, settings))
    method = find_method(options.method)
    ppo = dataclasses.replace(config.ppo, **method.pace.ppo.get(config.preset, {}))
    return dataclasses.replace(
        config,
        iterations=_iterations(options, info, method.pace, ppo),
        ppo=ppo,
        sampling=_sampling(options, config, method.pace),
        wrench=_wrench(config, info) if options.wrench else config.wrench,
        unlearn=dataclasses.replace(config.unlearn, stop_every=0 if options.no_stop else method.stop_every),
    )


def _iterations(options: Options, info: CheckpointInfo, pace: Pace, ppo: PPOConfig) -> int:
    """The method's, or without such a number as many steps as the base was trained for."""
    if pace.iterations:
        return pace.iterations[options.preset or "cpu"]
    if not info.environment_steps and not options.iterations:
        raise InputError(f"--iterations: {info.path} does not say how long it was trained; say how long to retrain")
    return max(1, round(info.environment_steps / (ppo.num_envs * ppo.num_steps)))


def _sampling(options: Options, config: Config, pace: Pace) -> SamplingConfig:
    """The flags' sampler and clips; the method's shares of the starts, unless the sampler has shares of its own."""
    sampling = replace_given(config.sampling, rule=options.sampler, clips=options.clips)
    if (sampling.rule, sampling.clips) != ("uniform_clips", "all"):
        return sampling
    share = pace.target_share.get(config.preset, 0.0)
    return dataclasses.replace(sampling, target_share=share, first_frame=pace.first_frame)


def _wrench(config: Config, info: CheckpointInfo) -> WrenchConfig:
    """As strong as the base's training had it, or where that had none, as strong as the paper's."""
    return dataclasses.replace(config.wrench, max_gain=info.config.wrench.max_gain or WrenchConfig.max_gain)


def _on_preset(base: Config, name: str) -> Config:
    """A preset's settings with what the base's policy brings: its interface, network, bins and clips."""
    config = with_interface(dataclasses.replace(preset(name), robot=base.robot), base)
    return dataclasses.replace(
        config,
        library=base.library,
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
    check_same(options, {"targets": ",".join(unlearn.targets), "method": unlearn.method})
    check_same(options, {"penalty": unlearn.settings.get("penalty")})
    check_same(options, {"sampler": sampling.rule, "clips": sampling.clips, "wrench": config.wrench.max_gain > 0})
    return (
        dataclasses.replace(config, unlearn=dataclasses.replace(unlearn, stop_every=0)) if options.no_stop else config
    )
