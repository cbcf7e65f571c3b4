"""A study: trials, what is measured of them, one page with its tables and claims, and one figure.

Every study takes the same options and finds the finished trials of the others. A study whose JSON answers the question
already runs nothing.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from rich.console import Console
from rich.markdown import Markdown

from forgetmimic_jax.basics.console import closing
from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.basics.files import write_atomically
from forgetmimic_jax.evaluation.plots import save
from forgetmimic_jax.studies.claim import Finding
from forgetmimic_jax.studies.document import SCHEMA, check_same_code, known_trials, read_document, write_document
from forgetmimic_jax.studies.lab import Lab, Options
from forgetmimic_jax.studies.page import page
from forgetmimic_jax.studies.variants import variant_bars, variant_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Of a trial: enough to tell variants apart. `make unlearn` trains longer on a laptop; the studies of one variant at
# that length say so.
ITERATIONS = {"cpu": 200, "paper": 1000}
RESULTS = Path(__file__).resolve().parents[2] / "experiments" / "results"

Document = Mapping[str, Any]


@dataclass(frozen=True)
class Study:
    """What makes a study.

    Args:
        name: of its files.
        title: its question, in a few words.
        claim: what the paper says, in one sentence.
        measure: runs the trials; returns the JSON's `results`.
        body: (document) → the page's tables and what a reader must know of them, in Markdown.
        draw: (document) → its figure.
        findings: (document) → what the numbers say of the paper's claims; the main ones answer `claim`.
        answer: (document) → what was measured of `claim`, in one sentence with its numbers.
        iterations: of each trial, by preset.
        asked: (lab) → what the results depend on beside the options, such as the values of a sweep.
        watches: whether it reads the evaluations during training, which have `watched_episodes`.
    """

    name: str
    title: str
    claim: str
    measure: Callable[[Lab], dict[str, Any]]
    body: Callable[[Document], str]
    draw: Callable[[Document], Figure]
    findings: Callable[[Document], Iterable[Finding]]
    answer: Callable[[Document], str]
    iterations: Mapping[str, int] = field(default_factory=lambda: ITERATIONS)
    asked: Callable[[Lab], Mapping[str, Any]] = lambda lab: {}
    watches: bool = False


def variants_study(
    name: str,
    title: str,
    claim: str,
    variants: Callable[[Lab], Mapping[str, Mapping[str, Any]]],
    *,
    theirs: Mapping[str, Any],
    **others: Any,
) -> Study:
    """A study of the usual kind: variants over seeds, a row of the table and a pair of bars each.

    Args:
        name: see `Study`.
        title: see `Study`.
        claim: see `Study`.
        variants: by label, the options of `forgetmimic_jax.unlearn` that a lab is to try.
        theirs: the paper's numbers.
        others: the rest of `Study`; `body` and `draw` are the table and the bars by default.
    """
    usual: dict[str, Any] = {
        "measure": lambda lab: lab.over_seeds(variants(lab), name),
        "body": lambda document: variant_table(document["results"]["variants"], theirs),
        "draw": lambda document: variant_bars(document["results"]["variants"]),
    }
    return Study(name=name, title=title, claim=claim, **{**usual, **others})


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
        lab = Lab(options, iterations, known_trials(folder))
        asked = {**lab.asked(), **study.asked(lab)}
        if document is None or document["asked"] != asked or document["failed"]:
            if document is not None:
                check_same_code(path, document, mix=options.mix_commits)
            results, stopped = study.measure(lab), lab.stopped
            made = {"asked": asked, "made_by": lab.made_by(), "failed": lab.failed, "results": results}
            write_document(path, {"schema": SCHEMA, "study": study.name, **made})
            document = read_document(path)
    if document is None:
        raise InputError(f"{path}: not measured yet; leave --draw out")
    text, picture = path.with_suffix(".md"), path.with_suffix(".png")
    write_atomically(text, page(study, document).encode())
    save(study.draw(document), picture)
    console = Console()
    console.print(Markdown(study.body(document)))
    closing({"numbers": path, "page": text, "figure": picture}, next_command, console=console)
    if stopped:
        raise stopped
    if document["failed"]:
        print(f"{len(document['failed'])} trials failed; the same command tries them again", file=sys.stderr)
        sys.exit(1)


def main(study: Study, options: type[Options] = Options, arguments: Iterable[str] | None = None) -> None:
    """The command of a study's file."""
    program = f"python -m experiments.{study.name}"
    given = tyro.cli(
        options,
        prog=program,
        description=f"{study.title}{'' if study.title.endswith('?') else '.'} {Options.__doc__}",
        args=None if arguments is None else list(arguments),
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    run_command(lambda: conduct(study, given, "make experiments"))


def measured_page(measure: Callable[[], Any], page: Callable[[Any], str], result: Path, path: Path) -> None:
    """The command of a measurement without trials: its numbers, unless `--draw` is given, and from them its page."""
    if "--draw" not in sys.argv[1:]:
        write_atomically(result, (json.dumps(measure(), indent=1) + "\n").encode())
    write_atomically(path, page(json.loads(result.read_text())).encode())
    print(f"numbers  {result}\npage     {path}")


def named_policy() -> Path:
    """The checkpoint on a measurement's command line, or the shipped base of the G1."""
    from forgetmimic_jax.training.start import base_folder

    return Path(sys.argv[1]) if sys.argv[1:] else base_folder("g1")
