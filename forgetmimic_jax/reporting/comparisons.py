"""What a run is compared with: a control, and how fast it and the control relearn the targets.

A comparison must belong to the run. One of another base, library, method and so on is refused: it is the wrong file.
One that does not say what it is of, or whose control is too poor to compare with, counts as not measured, and the
verdict and the page give the reason.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from forgetmimic_jax.attacks.control import check_never_rolled_out
from forgetmimic_jax.attacks.document import FILE as EVIDENCE
from forgetmimic_jax.attacks.document import EvidenceDocument, read_evidence
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.evaluation.document import FILE, PolicyResult, read_evaluation
from forgetmimic_jax.evaluation.metrics import BASE, UNLEARNED
from forgetmimic_jax.evaluation.relearning import DECISIVE, Lasted, Origins, comparable_settings, lasted
from forgetmimic_jax.evaluation.repeats import base_of
from forgetmimic_jax.evaluation.tables import KEPT, percent
from forgetmimic_jax.evaluation.verdict import NO_CONTROL, NO_RELEARNING, NotMeasured, retained, skills
from forgetmimic_jax.reporting.subject import Subject
from forgetmimic_jax.settings.config import load_config
from forgetmimic_jax.training.checkpoint import policy_hash
from forgetmimic_jax.unlearning.registry import find_method, method_of

# Settings whose difference is named before another's.
FIRST = ("robot", "unlearn.method", "unlearn.targets", "unlearn.settings.penalty", "iterations", "preset")
COMPETENT = f"a control needs at least {100 * KEPT:.0f} % of it, with its whole interval"


def read_own_evidence(subject: Subject) -> EvidenceDocument | None:
    """The evidence in the run's folder, if there is any.

    Raises:
        InputError: it is of another policy.
    """
    path = subject.run / EVIDENCE
    if not path.is_file():
        return None
    evidence = read_evidence(path)
    for name, info in ((UNLEARNED, subject.info), (BASE, subject.base)):
        _same(f"{path}: policy_hashes.{name}", evidence.policy_hashes.get(name), policy_hash(info))
    return evidence


def check_alone(control: Path | None, relearning: Path | None, subject: Subject) -> None:
    """InputError where a comparison is named for a run whose evidence has its own."""
    for flag, path in (("--control", control), ("--relearning", relearning)):
        if path is not None:
            raise InputError(f"{flag}: found {path}; accepted: none, since {subject.run / EVIDENCE} has its own")


def read_control(run: Path | None, subject: Subject) -> PolicyResult | NotMeasured:
    """The policy of a run that never rolled out a target, measured on the same episodes.

    It is a control if it started from a fresh policy (distilled or retrained) on the kept clips alone, with the same
    base and targets, and retains the skill of the kept clips; without the last, it is like a policy that fell.

    Raises:
        InputError: the run is no control of this subject.
    """
    if run is None:
        return NO_CONTROL
    config, path = load_config(run / "config.yaml"), run / FILE
    method = method_of(config)
    check_never_rolled_out(f"{run}/config.yaml", comparable_settings(config), subject.document.targets)
    document, ours = read_evaluation(path), subject.document
    for field in ("robot", "library_hash", "seed", "episodes"):
        _same(f"{path}: {field}", getattr(document, field), getattr(ours, field))
    _same(f"{path}: targets", sorted(document.targets), sorted(ours.targets))
    if method.result not in document.policies:
        found = ", ".join(document.policies)
        raise InputError(f"{path}: policies: found {found}; accepted: an evaluation with the policy {method.result}")
    theirs, base = document.policy_hashes.get(BASE), ours.policy_hashes.get(BASE)
    for unknown in [file for file, known in ((path, theirs), (subject.run / FILE, base)) if known is None]:
        return NotMeasured(f"The control was not used: {unknown} does not say of which base it is; evaluate it again.")
    _same(f"{path}: policy_hashes.base", theirs, base)
    control = document.policies[method.result]
    kept = skills(control, target=False)
    if not kept or retained(kept).low < KEPT:
        of = retained(kept) if kept else "no defined share"
        return NotMeasured(f"The control {run} was not used: it retains {of} of the kept clips' skill; {COMPETENT}.")
    return control


def read_relearning(
    path: Path | None, subject: Subject, control: Path | None
) -> dict[str, tuple[Lasted, Lasted]] | NotMeasured:
    """How long unlearned policies and controls took until 80 % of the base's tracking, by the repeats that both have.

    Of a study on several bases, the runs of the subject's base count.

    Args:
        path: JSON of experiments/relearning.py.
        subject: the run; the study's unlearned policies must be trained as it was, but for the seed.
        control: the run that the subject is compared with, whose method the study's control must have; without one,
            the study's first competent kind of control is taken.

    Raises:
        InputError: no such study, or one of other policies.
    """
    if path is None:
        return NO_RELEARNING
    try:
        study = json.loads(path.read_text())
        conditions, results = study["conditions"], study["results"]
        unlearned = lasted(results, "unlearned", DECISIVE)
        theirs = {start: lasted(results, start, DECISIVE) for start in results["starts"]}
        origins = msgspec.convert(results.get("origins"), Origins | None)
    except FileNotFoundError:
        raise InputError(f"{path}: not found") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not a relearning study, or damaged: {type(error).__name__}: {error}") from None
    _same(f"{path}: conditions.library", conditions.get("library"), subject.document.library_hash)
    _same(f"{path}: conditions.targets", sorted(conditions.get("targets", [])), sorted(subject.document.targets))
    if origins is None:
        return NotMeasured(
            f"Relearning was not used: {path} does not say how its policies were trained; run that study again."
        )
    ours = policy_hash(subject.base)
    if ours not in origins.bases:
        found = ", ".join(origins.bases)
        raise InputError(f"{path}: results.origins.bases: found {found}; accepted: {ours}, as in the unlearned run")
    of_base = {repeat: run for repeat, run in unlearned.items() if origins.bases[base_of(repeat)] == ours}
    _check_trained_alike(path, origins, subject)
    return _against_control(path, origins, subject, control, of_base, theirs)


def _against_control(
    path: Path,
    origins: Origins,
    subject: Subject,
    control: Path | None,
    unlearned: Mapping[str, Lasted],
    theirs: Mapping[str, Mapping[str, Lasted]],
) -> dict[str, tuple[Lasted, Lasted]] | NotMeasured:
    """The study's control of the wanted kind, if it is one that can be compared with."""
    made_by = {start: str(of.settings.get("unlearn.method")) for start, of in origins.starts.items()}
    wanted = None if control is None else load_config(control / "config.yaml").unlearn.method
    starts = [
        start
        for start, method in made_by.items()
        if start in theirs and (method == wanted if wanted else find_method(method).start != "base")
    ]
    if not starts:
        kind = f"made by {wanted}, as the control is" if wanted else "that never rolled out a target"
        return NotMeasured(f"Relearning was not used: {path} has no policy {kind}.")
    poor = []
    for start in starts:
        origin = origins.starts[start]
        where = f"{path}: results.origins.starts.{start}"
        check_never_rolled_out(where, origin.settings, subject.document.targets)
        pairs = {at: (run, theirs[start][at]) for at, run in unlearned.items() if at in theirs[start]}
        kept = [origin.kept_skill.get(repeat) for repeat in pairs]
        if pairs and all(skill is not None and (skill.low or 0.0) >= KEPT for skill in kept):
            return pairs
        poor.append(f"the {start} policy retains {', '.join(percent(skill) or 'an unknown share' for skill in kept)}")
    return NotMeasured(
        f"Relearning was not used: in {path} {' and '.join(poor)} of the kept clips' skill; {COMPETENT}."
    )


def _check_trained_alike(path: Path, origins: Origins, subject: Subject) -> None:
    """InputError unless the study's unlearned policies were trained as the subject was, but for the seed."""
    if "unlearned" not in origins.starts:
        raise InputError(f"{path}: results.origins.starts: no unlearned")
    found = origins.starts["unlearned"].settings
    ours = comparable_settings(subject.info.config) | {"iterations": subject.info.iteration}
    for name in [*FIRST, *sorted(found.keys() | ours.keys())]:
        _same(f"{path}: results.origins.starts.unlearned.{name}", found.get(name), ours.get(name))


def _same(where: str, found: Any, ours: Any) -> None:
    if found != ours:
        raise InputError(f"{where}: found {found}; accepted: {ours}, as in the unlearned run")
