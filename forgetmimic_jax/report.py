"""Write one HTML page about an unlearning run: `forgetmimic report --run runs/unlearn-g1-001`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.settings.options import at_least, parse

if TYPE_CHECKING:
    from forgetmimic_jax.reporting.subject import Subject


@dataclass
class Options:
    """Describe an unlearning run on one self-contained HTML page, with the same facts as JSON beside it.

    Every number comes from the run's own files. The verdict is one of four phrases, whose rules the page states: from
    evidence.json of `make evidence` if the run has one, else from the evaluation alone, which cannot show that the
    targets stay forgotten.
    """

    run: Path
    """Folder of the run, with its evaluation.json."""
    base: Path | None = None
    """Checkpoint that the run started from; the one its settings name by default."""
    films: int = 4
    """Clips to film for at most 4 s: the targets, then those the base does best; one in the run's videos/ is taken."""
    output: Path | None = None
    """HTML file to write, with a .json beside it; report.html in the run by default."""


def main(options: Options) -> None:
    """Read and check, judge, film and write."""
    from forgetmimic_jax.attacks.verdict import RULES, judge, judge_evaluation
    from forgetmimic_jax.basics.console import closing, command_line, say
    from forgetmimic_jax.basics.files import write_atomically, write_json
    from forgetmimic_jax.evaluation import tables
    from forgetmimic_jax.evaluation.document import to_dict
    from forgetmimic_jax.evaluation.metrics import UNLEARNED
    from forgetmimic_jax.reporting import facts
    from forgetmimic_jax.reporting.films import films
    from forgetmimic_jax.reporting.page import page
    from forgetmimic_jax.reporting.subject import read_own_evidence, read_subject
    from forgetmimic_jax.training.folder import check_writable

    at_least(0, "--films", options.films)
    output = options.output or options.run / "report.html"
    if output.suffix != ".html":
        raise InputError(f"--output: found {output}; accepted: an .html file")
    subject = read_subject(options.run, options.base)
    check_writable(output.parent)
    evidence = read_own_evidence(subject)
    verdict = judge(evidence) if evidence else judge_evaluation(subject.document.policies[UNLEARNED])
    found: dict[str, Any] = {
        "task": facts.task(subject),
        "done": facts.done(subject),
        "cards": facts.cards(subject),
        "threshold": facts.threshold(subject),
        "instead": facts.instead(subject),
        "notes": tables.notes(subject.document),
        "rules": RULES,
        "limits": facts.limits(subject, attacked=evidence is not None),
        "commands": _commands(options, subject),
        "identity": facts.identity(subject),
    }
    filmed = films(subject, options.films)
    content = page(subject, verdict, found, filmed)

    as_json = output.with_suffix(".json")
    facts_file = found | {"verdict": dataclasses.asdict(verdict), "evaluation": to_dict(subject.document)}
    output.parent.mkdir(parents=True, exist_ok=True)
    write_json(as_json, facts_file)
    write_atomically(output, content.encode())
    for line in (f"{verdict.phrase}: {' '.join(verdict.reasons)}", filmed[1]):
        if line:
            say(line)
    export = command_line("export", robot=subject.document.robot, checkpoint=subject.info.path)
    closing({"report": output, "facts": as_json}, export)


def _commands(options: Options, subject: Subject) -> list[str]:
    """What makes the run, and this page, again."""
    from forgetmimic_jax.reporting.reproduce import flags_of, settings_changed, words
    from forgetmimic_jax.training import unlearning_run

    flags = flags_of(subject, options.base)
    changed = settings_changed(subject.info.config, unlearning_run.config_of_new_run(unlearning_run.Options(**flags)))
    return [
        f"forgetmimic unlearn {words(flags, changed)} --output {options.run}",
        f"forgetmimic report {words({'run': options.run, 'base': options.base})}",
    ]


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "report")))
