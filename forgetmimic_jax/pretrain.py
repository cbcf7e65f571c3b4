"""Train a base policy in phases, unattended: `forgetmimic pretrain --robot g1`."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from forgetmimic_jax import train
from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.settings.config import Config, UnlearnConfig
from forgetmimic_jax.settings.options import (
    Settings,
    at_least,
    check_same,
    comma_separated,
    flags_of,
    on_engine,
    override,
    parse,
    replace_given,
)

if TYPE_CHECKING:
    from forgetmimic_jax.tracking.setup import Setup

# What differs from the preset: how long, how often the curriculum looks, at how many episodes, and that it looks at a
# policy that does not scatter between iterations. A base has to survive pushes and wrong sensors, and its robot cannot
# reach through itself.
DIFFERENCES: dict[str, tuple[str, ...]] = {
    "cpu": (
        *("iterations=7200", "evaluate_every=100", "pretrain.average=75"),
        *("noise.enabled=true", "physics.self_collision=true"),
    ),
    "paper": ("iterations=30000", "evaluate_every=500", "pretrain.average=75"),
}
EPISODES = 20  # a clip in an evaluation


@dataclass
class Options(train.Options):
    """Train one policy on every clip of a library, in phases.

    First it trains on all clips, then mostly on those that lag. A clip that is stuck gets a specialist, and all
    policies are distilled into one. Rules decide when a phase ends. You may stop or kill it at any time. --resume
    continues, and the policy is the same to the last bit.
    """

    iterations: int | None = None
    """PPO iterations at most; cpu: 7200 (88 million steps), paper: 30000."""
    base: Path | None = None
    """Checkpoint whose policy to start from, another robot's too; none: a random policy. By default the shipped base
    for a library of your own, and a random policy for the shipped library."""
    output: Path | None = None
    """Folder of the run; runs/pretrain-ROBOT by default, or with --without runs/pretrain-ROBOT-control."""
    set: Settings = field(default_factory=list)
    """Any other settings, such as pretrain.patience=5."""
    without: str | None = None
    """Clips to leave out, comma-separated: no episode starts from them, and the policy starts from a random one or
    from another robot's that left them out too. The result is the retrained control of a run that forgets them
    (evidence and the studies: --control)."""
    episodes: int = 100
    """Episodes a clip of the evaluation at the end."""
    seeds: int | None = None
    """Train so many policies, with the seeds SEED, SEED + 1, ..., each in the folder OUTPUT-ITS_SEED. The same command
    continues those that were stopped."""
    jobs: int | None = None
    """With --seeds, trainings at a time on this machine, which share its cores evenly; by default one on each GPU, or 1
    without a GPU."""
    cluster: str | None = None
    """With --seeds, address of a dask scheduler, such as tcp://host:8786, whose workers train (docs/cluster.md)."""


def main(options: Options) -> None:
    """Pretrain, evaluate, and say where the policy is."""
    from forgetmimic_jax.basics.console import closing, command_line
    from forgetmimic_jax.evaluation.evaluate import evaluate, show_and_write
    from forgetmimic_jax.tracking.setup import make_setup
    from forgetmimic_jax.training.checkpoint import load_policy, read_info
    from forgetmimic_jax.training.comparison import subject
    from forgetmimic_jax.training.devices import join, own_folder
    from forgetmimic_jax.training.folder import BEST, prepare_folder
    from forgetmimic_jax.training.pretraining import Pretraining
    from forgetmimic_jax.training.run import run

    output = options.output or Path("runs") / f"pretrain-{options.robot}{'-control' if options.without else ''}"
    at_least(1, "--episodes", options.episodes)
    if options.seeds is not None:
        return _several(options, output)
    check_alone(options)
    prepare_folder(output, resume=options.resume)
    config = config_of(options, output)
    join(config)
    output = own_folder(output)
    setup = make_setup(config)
    if not options.resume:
        warn_of_infeasible(setup)
    path, _ = run(setup, output, description=f"pretrain {config.robot}", resume=options.resume, make_course=Pretraining)
    best = output / BEST if (output / BEST).is_dir() else path
    info, targets = read_info(best), config.unlearn.targets
    evaluated = {"retrained" if targets else "base": subject(load_policy(info, setup.robot), info)}
    document = evaluate(
        setup, evaluated, checkpoint=str(best), targets=targets, episodes=options.episodes, seed=config.seed
    )
    files = {"policy": best, **show_and_write(output, document)}
    files |= {"clips over time": output / "evaluations.png", "curves": output / "metrics.jsonl"}
    closing(files | {"TensorBoard": output / "events"}, command_line("play", robot=config.robot, checkpoint=best))


def _several(options: Options, output: Path) -> None:
    """A training of each seed, in a process of its own."""
    from forgetmimic_jax.basics.console import command_line
    from forgetmimic_jax.basics.provenance import gpus
    from forgetmimic_jax.studies.executor import at_a_time, run_together
    from forgetmimic_jax.studies.task import Task
    from forgetmimic_jax.training.folder import check_writable, config_there

    assert options.seeds is not None
    at_least(1, "--seeds", options.seeds)
    jobs = at_a_time(options.jobs, options.cluster)
    if options.resume:
        raise InputError("--resume: found with --seeds; leave it out: the same command continues what was stopped")
    if (options.devices or 1) > 1 and not options.cluster and gpus():
        raise InputError(
            f"--devices: found {options.devices} with --seeds; accepted: 1, since each training has one GPU"
        )
    check_writable(output)
    alone = dataclasses.replace(options, seeds=None, jobs=None, cluster=None, output=None)
    first, tasks = options.seed or 0, []
    for seed in range(first, first + options.seeds):
        one, folder = dataclasses.replace(alone, seed=seed), output.with_name(f"{output.name}-{seed}")
        config = config_of(one, folder)
        if folder.is_dir() and any(folder.iterdir()):
            config_there(folder, config)
        if config.base and options.base:
            one = dataclasses.replace(one, base=Path(config.base))  # the checkpoint that a run's folder stands for
        tasks.append(Task(folder, "pretrain", flags_of(one), config.iterations))
    following = command_line("evaluate", robot=options.robot, checkpoint=tasks[0].folder)
    what = f"pretrain {options.robot}"
    run_together(tasks, following, description=what, jobs=jobs, cluster=options.cluster)


def check_alone(options: Options) -> None:
    """InputError for a flag that only several trainings have."""
    for name in ("jobs", "cluster"):
        if getattr(options, name) != getattr(Options, name):
            raise InputError(f"--{name}: found {getattr(options, name)}; accepted: only with --seeds")


def config_of(options: Options, output: Path) -> Config:
    """Every setting of the run; with `resume`, of the run in folder `output`.

    Raises:
        InputError: a flag that contradicts the run to resume, or settings that the phases cannot work with.
    """
    from forgetmimic_jax.attacks.control import check_never_rolled_out
    from forgetmimic_jax.settings.config import load_config, preset
    from forgetmimic_jax.training.checkpoint import read_info
    from forgetmimic_jax.training.start import shipped_base, with_interface_of_base
    from forgetmimic_jax.unlearning.registry import unlearning_config

    without = comma_separated(options.without or "")
    options = dataclasses.replace(options, without=",".join(without) or None)
    if options.resume:
        config = load_config(output / "config.yaml")
        check_same(options, {name: getattr(config, name) for name in ("robot", "preset", "seed", "library")})
        check_same(options, {"base": config.base or "none"})
        check_same(options, {"without": ",".join(config.unlearn.targets)})
    else:
        base = options.base or (shipped_base(options.robot) if options.library and not without else None)
        base = None if str(base) == "none" else base
        if base and without:
            check_never_rolled_out(read_info(Path(base)), without)
        config = override(preset(options.preset), DIFFERENCES[options.preset])
        config = dataclasses.replace(config, evaluate_episodes=EPISODES)
        config = replace_given(config, robot=options.robot, seed=options.seed, library=options.library, base=base)
        config = with_interface_of_base(config)
        if without:
            config = unlearning_config(config, UnlearnConfig(without, "retrain"))
    config = replace_given(config, iterations=options.iterations, devices=options.devices)
    config = override(config, itertools.chain(*options.set))
    every, save = config.evaluate_every, config.checkpoint_every
    if not every or every % save:
        raise InputError(
            f"evaluate_every: found {every}; accepted: a multiple of checkpoint_every = {save}, from it on"
        )
    if not config.ppo.schedule.startswith("adaptive"):
        raise InputError(f"ppo.schedule: found {config.ppo.schedule}; accepted: adaptive, adaptive_iteration")
    return on_engine(config, options.physics)


def warn_of_infeasible(setup: Setup) -> None:
    """Name the clips that no policy may be able to follow, and why, on the terminal."""
    from forgetmimic_jax.basics.console import warn
    from forgetmimic_jax.motion.library import read_library
    from forgetmimic_jax.motion.quality import measure
    from forgetmimic_jax.tracking.setup import library_folder

    for clip in read_library(setup.robot, library_folder(setup.config)):
        for reason in measure(setup.robot, clip).infeasibilities():
            warn(f"{clip.name} may be infeasible: {reason}")


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "pretrain")))
