"""Several unlearning runs that differ in one thing: `forgetmimic sweep lambda`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from forgetmimic_jax.basics.errors import run_command
from forgetmimic_jax.settings.options import parse
from forgetmimic_jax.studies import options as study_options


@dataclass(kw_only=True)
class Options(study_options.Options):
    """Run the missing trials of a sweep, then write its JSON, its page and its figure."""

    kind: Annotated[Literal["lambda", "targets", "sampler", "seeds"], tyro.conf.Positional]
    """What the runs differ in: the penalty λ, the targets, sampler and wrench, or only the seed."""
    bases: str | None = None
    """Checkpoints that the runs start from, comma-separated; the shipped data/ROBOT/base by default."""
    values: list[str] = field(default_factory=list)
    """Penalties (by default 0.5 1 4 6 7 8 9 12 16), groups of targets (punch,kick dance_a,dance_b run) or samplers."""
    output: Path | None = None
    """Folder for the JSON, the page and the figure; runs/sweep-ROBOT-KIND by default."""


def main(options: Options) -> None:
    """Run the sweep."""
    from forgetmimic_jax.studies.conduct import conduct
    from forgetmimic_jax.studies.penalty import penalty_study
    from forgetmimic_jax.studies.samplers import sampler_study
    from forgetmimic_jax.studies.seeds import seeds_study
    from forgetmimic_jax.studies.study import Study
    from forgetmimic_jax.studies.targets import targets_study
    from forgetmimic_jax.training.start import base_folder

    studies: dict[str, Callable[..., Study]] = {
        "lambda": penalty_study,
        "targets": targets_study,
        "sampler": sampler_study,
        "seeds": seeds_study,
    }
    if not options.draw:
        options.bases = options.bases or str(base_folder(options.robot))
    options.output = options.output or Path("runs") / f"sweep-{options.robot}-{options.kind}"
    make = studies[options.kind]
    conduct(make(tuple(options.values)) if options.values else make(), options, "make experiments")


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "sweep")))
