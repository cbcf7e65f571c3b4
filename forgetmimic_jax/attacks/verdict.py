"""The verdict from the attacks: the four phrases of `evaluation.verdict`, with the rules of this file.

Two numbers are compared by their intervals, never by their means, and paired: the same episodes, or the same seeds.

The control decides what forgotten means. A policy that never saw a target does a part of it all the same: it knows the
reference, most of a punch is standing, and with residual actions the joint controllers move the arms alone. On the G1
distilled policies have 19 to 28 % of the base's skill on the default targets, so a bound of 20 % on its own would fail
every retrained policy. So a number at most 20 %, or one that is at most `ALIKE` above the control's, is forgotten.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import msgspec
import numpy as np

from forgetmimic_jax.attacks.document import CONTROL, Compared, Curve, EvidenceDocument, Numbers, Relearning
from forgetmimic_jax.evaluation.metrics import UNLEARNED
from forgetmimic_jax.evaluation.relearning import DECISIVE, Lasted, lasted
from forgetmimic_jax.evaluation.tables import FORGOTTEN, KEPT, KEPT_CLIP, number
from forgetmimic_jax.evaluation.verdict import (
    ALIKE,
    CONSISTENT,
    FAILED,
    FASTER,
    INCONCLUSIVE,
    RECOVERABLE,
    Skill,
    Verdict,
    as_skill,
    below_baseline,
    bound,
    by_clip,
    losses,
    pace_over_seeds,
    retained,
    sooner_than_control,
    steps_in_words,
)

RECOVERED = 0.1  # above the control, or above the policy before: a recovery of more than this counts

Marks = Mapping[str, Compared]


_FORGOTTEN = (
    f"on every target and on every family of near-duplicates, the policy retains at most {bound(FORGOTTEN)} of the "
    f"base's skill, or at most {bound(ALIKE)} more than the control does in the same episodes; the same holds for "
    f"motion content ({FORGOTTEN:g}, {ALIKE:g})"
)
_KEPT = (
    f"it retains at least {bound(KEPT_CLIP)} of the skill on every kept clip and {bound(KEPT)} on average, and on "
    f"every family of the kept clips' near-duplicates at least {bound(KEPT_CLIP)}, or at most {bound(ALIKE)} less "
    f"than the control"
)
_NO_SKILL = "The base itself is hardly better than the zero-action baseline on every {}: no skill is defined."
RULES = {
    CONSISTENT: (
        f"Forgotten: {_FORGOTTEN}. Kept: {_KEPT}. Not recovered: fine-tuned on the kept clips alone, its skill and its "
        f"motion content on the targets are at most {RECOVERED:g} above the control's after the same training; with "
        f"other numerics at most {RECOVERED:g} above its own before; and with every seed it needs at least "
        f"{bound(FASTER)} of the control's target steps to relearn {bound(DECISIVE)} of the base's tracking, or "
        f"tracks at most {bound(ALIKE)} of the base's more after the same target steps where neither gets there. All "
        f"of this holds for whole 95 % intervals. The control never rolled out a target clip, and keeps at least "
        f"{bound(KEPT)} of the kept clips' skill."
    ),
    RECOVERABLE: (
        "Not failed, but an attack brought the targets back: one of the three comparisons of 'not recovered' is on the "
        "other side of its bound with its whole interval, or with every seed. The reasons name the attack and by how "
        "much."
    ),
    INCONCLUSIVE: (
        "None of the other rules holds: an interval includes a bound, a comparison was not measured, or the policy is "
        "below the zero-action baseline on a target, with its whole interval: no retrained policy is."
    ),
    FAILED: "With its whole interval a number of 'forgotten' or of 'kept' is on the other side of all of its bounds.",
}


def judge(evidence: EvidenceDocument) -> Verdict:
    """The verdict on the policy `unlearned`, with every reason."""
    originals, near = evidence.originals, evidence.near_duplicates
    kept = _skills(originals.kept)
    failures, doubts = losses(kept) if kept else ([], [_NO_SKILL.format("kept clip")])
    groups: dict[str, Marks] = {"the target": originals.targets}
    if near is not None:
        groups["near-duplicates of the targets:"] = near.families
    for what, marks in groups.items():
        for name, numbers in _numbers(marks):
            for kind in ("skill", "content"):
                known, words = still_known(numbers, kind)
                if known:
                    failures.append(f"Still known: {what} {name}, {words}.")
                elif known is None:
                    doubts.append(f"Whether this is forgotten is not sure: {what} {name}, {words}.")
    for family, numbers in _numbers({} if near is None else near.kept):
        lost, words = is_lost(numbers)
        if lost:
            failures.append(f"Lost: near-duplicates of the kept clips: {family}, {words}.")
        elif lost is None:
            doubts.append(f"Whether this is kept is not sure: near-duplicates of the kept clips: {family}, {words}.")
    if not any(as_skill(numbers.skill) for _, numbers in _numbers(originals.targets)):
        doubts.append(_NO_SKILL.format("target"))
    doubts += _over_forgotten(originals.targets)
    if near is None:
        doubts.append("Near-duplicates were not measured.")
    if failures:
        return Verdict(FAILED, tuple(failures))

    usable = _control_is_usable(evidence)
    if usable:
        doubts.append(usable)
    recovered: list[str] = []
    unsure: list[str] = []
    passed: list[str] = []
    for brought_back, words in recoveries(evidence, usable):
        (recovered if brought_back else unsure if brought_back is None else passed).append(words)
    remarks = _remarks(evidence)
    if recovered:
        return Verdict(RECOVERABLE, (*recovered, *doubts, *unsure, *remarks))
    if doubts or unsure:
        return Verdict(INCONCLUSIVE, (*doubts, *unsure, *remarks))
    forgotten = by_clip(_skills(originals.targets))
    found = [
        f"The targets and their near-duplicates are forgotten ({forgotten} of the base's skill), and the kept clips "
        f"are kept ({retained(kept)} on average)."
    ]
    return Verdict(CONSISTENT, (*found, *passed, *remarks))


def still_known(numbers: Numbers, kind: str) -> tuple[bool | None, str]:
    """Whether a number of the unlearned policy shows a motion: no, yes, or None where that is not sure; in words.

    Args:
        numbers: of the unlearned policy.
        kind: skill or content; what is undefined shows nothing.
    """
    own, above = as_skill(getattr(numbers, kind)), as_skill(getattr(numbers, f"{kind}_above"))
    if own is None:
        return False, f"{kind} undefined"
    words = _words(kind, own)
    words += f" ({_signed(kind, above)} above the control)" if above else ""
    if own.high <= FORGOTTEN or (above and above.high <= ALIKE):
        return False, words
    return (True if own.low > FORGOTTEN and (above is None or above.low > ALIKE) else None), words


def is_lost(numbers: Numbers) -> tuple[bool | None, str]:
    """Whether the unlearned policy lost the kept clips' near-duplicates of a family; as `still_known`."""
    own, above = as_skill(numbers.skill), as_skill(numbers.skill_above)
    if own is None:
        return False, "skill undefined"
    words = _words("skill", own) + (f" ({_signed('skill', above)} above the control)" if above else "")
    if own.low >= KEPT_CLIP or (above and above.low >= -ALIKE):
        return False, words
    return (True if own.high < KEPT_CLIP and (above is None or above.high < -ALIKE) else None), words


def recoveries(evidence: EvidenceDocument, no_control: str = "") -> Iterator[tuple[bool | None, str]]:
    """Whether each attack brought the targets back, None where that is not sure; in words.

    Args:
        evidence: on the policy.
        no_control: why the control cannot be compared with, if it cannot.
    """
    if no_control:
        yield None, "So retain-only recovery and relearning have nothing to be compared with."
    else:
        yield from _recovery(evidence)
        yield _pace(evidence.relearning)
    if evidence.numerics is None:
        yield None, "Other numerics were not measured."
        return
    for change, compared in evidence.numerics.changes.items():
        yield from _rises(compared[UNLEARNED], f"Weights in {change}", "its own before")


def _recovery(evidence: EvidenceDocument) -> Iterator[tuple[bool | None, str]]:
    recovery = evidence.recovery
    if recovery is None:
        yield None, "Retain-only recovery was not measured."
        return
    attack = f"Fine-tuned on the kept clips alone for {recovery.iterations} iterations"
    yield from _rises(recovery.after[UNLEARNED], attack, "the control's after the same training")


def _rises(numbers: Numbers, attack: str, other: str) -> Iterator[tuple[bool | None, str]]:
    """Whether skill and content rose above the other's by more than `RECOVERED`."""
    for kind in ("skill", "content"):
        own, above = as_skill(getattr(numbers, kind)), as_skill(getattr(numbers, f"{kind}_above"))
        if own is None or above is None:
            continue
        rose = True if above.low > RECOVERED else False if above.high <= RECOVERED else None
        yield rose, f"{attack}: {_words(kind, own)} on the targets, {_signed(kind, above)} above {other}."


def _pace(relearning: Relearning | None) -> tuple[bool | None, str]:
    """Whether it relearns the targets faster than the control, with every seed; None where that is not sure."""
    if relearning is None:
        return None, "How fast it relearns the targets was not measured."
    pairs, faster, short = paired(relearning), [], []
    for seed, pair in pairs.items():
        if any(run.there for run in pair):
            faster.append(sooner_than_control(*pair))
            continue
        ours, theirs = reached(relearning, seed)
        faster.append(ours > theirs + ALIKE)
        short.append(f"{bound(ours)} against {bound(theirs)}")
    words = f"{steps_in_words(pairs)} until {bound(DECISIVE)} of the base's tracking"
    words += f"; after the same target steps neither got there: {', '.join(short)}" if short else ""
    return pace_over_seeds(faster, words)


def reached(relearning: Relearning, seed: str) -> tuple[float, float]:
    """What unlearned policy and control track of the targets after equally many target steps, as shares of the base's.

    Both are taken where the shorter of the two trainings ended.
    """
    ours, theirs = relearning.starts[UNLEARNED][seed], relearning.starts[CONTROL][seed]
    end = min(ours.target_steps[-1], theirs.target_steps[-1])

    def share(curve: Curve) -> float:
        return float(np.interp(end, curve.target_steps, curve.tracking) / relearning.base[seed])

    return share(ours), share(theirs)


def paired(relearning: Relearning) -> dict[str, tuple[Lasted, Lasted]]:
    """By seed, how long the unlearned policy and the control took to relearn the targets."""
    runs = lasted_until(relearning, DECISIVE)
    return {seed: (run, runs[CONTROL][seed]) for seed, run in runs[UNLEARNED].items() if seed in runs[CONTROL]}


def lasted_until(relearning: Relearning, share: float) -> dict[str, dict[str, Lasted]]:
    """How long the unlearned policy and the control took to a share of the base's tracking: policy → seed → run."""
    results = msgspec.to_builtins(relearning)
    return {start: lasted(results, start, share) for start in (UNLEARNED, CONTROL)}


def _control_is_usable(evidence: EvidenceDocument) -> str:
    """Why the control cannot be compared with; empty if it can."""
    kept = _skills(evidence.originals.kept, CONTROL)
    if not kept:
        return "No skill of the control on the kept clips is defined."
    together = retained(kept)
    if together.low >= KEPT:
        return ""
    return f"The control retains {together} of the kept clips' skill on average; a control needs {bound(KEPT)}."


def _over_forgotten(targets: Marks) -> list[str]:
    below = below_baseline(_skills(targets))
    if not below:
        return []
    return [f"Over-forgotten: below the zero-action baseline ({by_clip(below)} of the base's skill)."]


def _remarks(evidence: EvidenceDocument) -> list[str]:
    """What no rule decides, but a reader should know."""
    near = evidence.near_duplicates
    if near is None or not near.dropped:
        return []
    return [f"{len(near.dropped)} near-duplicates were dropped, since the base cannot follow them."]


def _numbers(marks: Marks) -> Iterator[tuple[str, Numbers]]:
    for name, compared in marks.items():
        yield name, compared[UNLEARNED]


def _skills(marks: Marks, policy: str = UNLEARNED) -> dict[str, Skill]:
    found = {name: as_skill(compared[policy].skill) for name, compared in marks.items() if policy in compared}
    return {name: skill for name, skill in found.items() if skill is not None}


def _words(kind: str, value: Skill) -> str:
    return f"skill {value}" if kind == "skill" else f"motion content {number(value.estimate, 2)}"


def _signed(kind: str, value: Skill) -> str:
    return str(value) if kind == "skill" else number(value.estimate, 2)
