"""Forget chosen clips: `forgetmimic unlearn --robot g1 --targets punch,kick`."""

from __future__ import annotations

import dataclasses

from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.settings.options import at_least, parse
from forgetmimic_jax.training.unlearning_run import Options, config_of


def main(options: Options) -> None:
    """Unlearn, evaluate base, new policy and zero action, and print what was forgotten and what was kept."""
    from forgetmimic_jax.basics.console import closing, command_line, warn
    from forgetmimic_jax.basics.provenance import provenance
    from forgetmimic_jax.evaluation.evaluate import evaluate, show_and_write
    from forgetmimic_jax.tracking.setup import make_setup
    from forgetmimic_jax.tracking.stand import STAND
    from forgetmimic_jax.training import checkpoint
    from forgetmimic_jax.training.comparison import completes_nothing, subject
    from forgetmimic_jax.training.course import Plain
    from forgetmimic_jax.training.devices import join, own_folder
    from forgetmimic_jax.training.folder import default_folder, prepare_folder
    from forgetmimic_jax.training.run import interrupted, run
    from forgetmimic_jax.training.standing import standing_teacher
    from forgetmimic_jax.training.start import base_checkpoint, base_policy
    from forgetmimic_jax.training.stopping import Stopping
    from forgetmimic_jax.unlearning.registry import method_of

    at_least(1, "--episodes", options.episodes)
    provenance()  # of the code that is loaded now; a checkout may change while the run trains
    output = options.output or default_folder(f"unlearn-{options.robot}", resume=options.resume)
    prepare_folder(output, resume=options.resume)
    config = config_of(options, output)
    if not config.unlearn.targets:
        raise InputError("--targets: no clip named; name at least one to forget, such as --targets punch,kick")
    join(config)
    output = own_folder(output)
    setup = make_setup(config)
    base = base_policy(setup)
    setup = dataclasses.replace(setup, base=base)
    info = checkpoint.read_info(base_checkpoint(config))
    method = method_of(config)
    if method.result == "fine_tuned" and config.sampling.clips == "all":
        description = "fine-tune on all clips"  # which is no forgetting
    else:
        description = f"forget {', '.join(config.unlearn.targets)} by {config.unlearn.method}"
    if not options.resume and completes_nothing(setup, base):
        warn(f"the base completes no episode of any clip ({info.path}): there is nothing to forget")
    if config.unlearn.instead == STAND:
        setup = dataclasses.replace(setup, teacher=standing_teacher(setup, output))
    elif config.unlearn.instead is not None:
        setup = dataclasses.replace(setup, teacher=base)
    course = Stopping if config.unlearn.stop_every else Plain
    path, state = run(setup, output, description=description, resume=options.resume, make_course=course)
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
        raise interrupted(config, output, "unlearn") from None
    name = f"{method.result.replace('_', '-')} policy"
    files = {name: path, **show_and_write(output, document), "curves": output / "metrics.jsonl"}
    closing(files, command_line("evaluate", robot=config.robot, checkpoint=path, episodes=100))


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "unlearn")))
