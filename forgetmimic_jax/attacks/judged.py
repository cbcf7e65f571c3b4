"""Judging the judge: the verdict on each fake, and what caught it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import msgspec

from forgetmimic_jax.attacks.case import Case
from forgetmimic_jax.attacks.document import EvidenceDocument
from forgetmimic_jax.attacks.gather import conditions, gather
from forgetmimic_jax.attacks.parts import Parts
from forgetmimic_jax.attacks.verdict import FAILED, judge
from forgetmimic_jax.evaluation.metrics import UNLEARNED
from forgetmimic_jax.evaluation.rollout import Acting
from forgetmimic_jax.policy.policy import Policy

FILE = "fakes.json"


class Judged(msgspec.Struct):
    """The verdict on one policy."""

    phrase: str
    reasons: tuple[str, ...]


def judged(case: Case, parts: Parts, name: str, policy: Acting, evidence: EvidenceDocument) -> Judged:
    """The verdict on a policy in the place of the unlearned one.

    The attacks that only roll out come first; those that train follow where no other has found it out.

    Args:
        case: of the run whose base, control and clips it is judged with.
        parts: of that run; those of the fake have a folder of their own in its folder.
        name: of the policy.
        policy: any.
        evidence: on the run.
    """
    case = dataclasses.replace(case, policies={**case.policies, UNLEARNED: policy})
    hashes = {**evidence.policy_hashes, UNLEARNED: name}
    own = Parts(parts.folder / "fakes" / _file_name(name), case.setup, conditions(case, hashes))
    verdict = None
    for train in (False, True) if isinstance(policy, Policy) else (False,):
        document = gather(
            case, own, method=name, control_method=evidence.control_method, policy_hashes=hashes, train=train
        )
        verdict = judge(document)
        if verdict.phrase == FAILED:
            break
    assert verdict is not None
    return Judged(verdict.phrase, verdict.reasons)


def read_judged(path: Path) -> dict[str, Judged]:
    """The verdicts in a file; none without one."""
    return msgspec.json.decode(path.read_bytes(), type=dict[str, Judged]) if path.is_file() else {}


def _file_name(name: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in name).strip("-")
