"""A study from its options to its files: trials, one JSON, one page with its tables and claims, one figure.

Every study takes the same options and finds the finished trials of the others. A study whose JSON answers the question
already runs nothing.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

import tyro
from rich.console import Console
from rich.markdown import Markdown

from forgetmimic_jax.basics.console import closing
from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.basics.files import write_atomically
from forgetmimic_jax.evaluation.plots import save
from forgetmimic_jax.studies.document import (
    SCHEMA,
    check_same_code,
    known_trials,
    read_document,
    same_bases,
    write_document,
)
from forgetmimic_jax.studies.lab import Lab
from forgetmimic_jax.studies.options import Options
from forgetmimic_jax.studies.page import page, size
from forgetmimic_jax.studies.study import Study

RESULTS = Path(__file__).resolve().parents[2] / "experiments" / "results"


def conduct(study: Study, options: Options, next_command: str) -> None:
    """Measure what the JSON does not answer, then write page and figure; exit code 1 where a trial failed.

    Raises:
        Interrupted: stopped; the finished trials are written if the study can show a part.
        InputError: the runs of the JSON were made by other code, and new ones are needed beside them.
    """
    from forgetmimic_jax.training.folder import check_writable

    folder = options.output or RESULTS / options.robot
    check_writable(folder)
    path = folder / f"{study.name}.json"
    document, stopped = read_document(path), None
    if not options.draw:
        iterations = study.iterations[options.preset] if options.iterations is None else options.iterations
        lab = Lab(options, iterations, known_trials(folder), fresh=study.kind == "fresh")
        conditions = {**lab.conditions(), **study.conditions(lab)}
        if document is None or document["conditions"] != conditions or document["failed"]:
            if document is not None:
                if same_bases(document, conditions):
                    check_same_code(path, document, mix=options.mix_commits)
                else:
                    print(f"{path}: its runs are of other bases, so the new ones replace them")
            results, stopped = study.measure(lab), lab.stopped
            made = {"conditions": conditions, "made_by": lab.made_by(), "failed": lab.failed, "results": results}
            write_document(path, {"schema": SCHEMA, "study": study.name, **made})
            document = read_document(path)
    if document is None:
        raise InputError(f"{path}: not measured yet; leave --draw out")
    text, picture = path.with_suffix(".md"), path.with_suffix(".png")
    write_atomically(text, page(study, document).encode())
    figure = study.draw(document)
    figure.suptitle(size(study, document), fontsize="small")
    save(figure, picture)
    console = Console()
    console.print(Markdown(study.body(document)))
    closing({"numbers": path, "page": text, "figure": picture}, next_command, console=console)
    if stopped:
        raise stopped
    if document["failed"]:
        print(f"{len(document['failed'])} trials failed; the same command tries them again", file=sys.stderr)
        sys.exit(1)


def main(study: Study, options: type[Options] = Options, arguments: Iterable[str] | None = None) -> None:
    """The command of a study's file; it runs nothing where the named bases or controls are of another robot."""
    from forgetmimic_jax.studies.policies import named_of_other_robots

    def run() -> None:
        given = tyro.cli(
            options,
            prog=f"python -m experiments.{study.name}",
            description=f"{study.title}{'' if study.title.endswith('?') else '.'} {Options.__doc__}",
            args=None if arguments is None else list(arguments),
            config=(tyro.conf.FlagCreatePairsOff,),
        )
        others = [] if given.draw else named_of_other_robots(given)
        if others:
            print(f"{study.name}: skipped: it is of the {given.robot}, and {', '.join(others)}")
            return
        conduct(study, given, "make experiments")

    run_command(run)
