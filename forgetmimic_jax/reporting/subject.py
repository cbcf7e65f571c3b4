"""What a page is about: a run that unlearned, with its evaluation, its checkpoint, its base and its log."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from forgetmimic_jax.attacks.document import FILE as EVIDENCE
from forgetmimic_jax.attacks.document import EvidenceDocument, read_evidence
from forgetmimic_jax.basics.console import command_line
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.evaluation.document import FILE, EvaluationDocument, check_policies, read_evaluation
from forgetmimic_jax.evaluation.metrics import BASE, UNLEARNED, ZERO_ACTION
from forgetmimic_jax.training.checkpoint import CheckpointInfo, policy_hash, read_info
from forgetmimic_jax.training.start import base_checkpoint


@dataclass(frozen=True)
class Subject:
    """An unlearning run whose files belong together."""

    run: Path
    document: EvaluationDocument
    info: CheckpointInfo  # of the unlearned policy
    base: CheckpointInfo
    rows: list[dict[str, Any]]  # of the training's log; empty without one


def read_subject(run: Path, base: Path | None) -> Subject:
    """The run in a folder.

    Args:
        run: its folder, wherever it was moved to.
        base: the checkpoint that it started from; the one its settings name by default.

    Raises:
        InputError: a file is absent or damaged, or is of another policy or other targets.
    """
    path = run / FILE
    if not run.is_dir():
        raise InputError(f"{run}: no such run folder")
    if not path.is_file():
        first = command_line("evaluate", checkpoint=f"{run}/checkpoints/...")
        raise InputError(f"{path}: not found; make it first, with: {first}")
    document = read_evaluation(path)
    if not {BASE, UNLEARNED, ZERO_ACTION} <= document.policies.keys() or not document.targets:
        raise InputError(
            f"{path}: found {', '.join(sorted(document.policies))} and {len(document.targets)} targets; a report needs "
            f"base, unlearned, zero_action and a target"
        )
    # The run may have been moved since, so only the checkpoint's name counts.
    checkpoint = run / "checkpoints" / Path(document.checkpoint).name
    if not checkpoint.is_dir():
        raise InputError(f"{checkpoint}: not found, but {path} is its evaluation; evaluate a checkpoint that exists")
    info = read_info(checkpoint)
    base_info = read_info(base or base_checkpoint(info.config))
    policies = {BASE: base_info, UNLEARNED: info}
    check_policies(document, path, {name: (of.path, policy_hash(of)) for name, of in policies.items()})
    if set(document.targets) != set(info.config.unlearn.targets):
        raise InputError(
            f"{path}: targets: found {', '.join(document.targets)}; accepted: those that the run unlearned, "
            f"{', '.join(info.config.unlearn.targets)}"
        )
    rows = [row for row in read_rows(run / "metrics.jsonl") if "target/step_share" in row]
    return Subject(run, document, info, base_info, rows)


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
        found, ours = evidence.policy_hashes.get(name), policy_hash(info)
        if found != ours:
            raise InputError(f"{path}: policy_hashes.{name}: found {found}; accepted: {ours}, as in the unlearned run")
    return evidence
