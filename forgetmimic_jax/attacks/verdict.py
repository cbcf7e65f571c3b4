"""What may be said of an unlearned policy: one of four phrases, each with its rule.

Two numbers are compared by their intervals, never by their means, and paired: the same episodes, or the same seeds. The
rules read clip by clip: a group's mean can hide a clip that was lost or still known.

The control decides what forgotten means. A policy that never saw a target does a part of it all the same: it knows the
reference, most of a punch is standing, and with residual actions the joint controllers move the arms alone. On the G1
distilled policies have 19 to 28 % of the base's skill on the default targets, so a bound of 20 % on its own would fail
every retrained policy. So a number at most 20 %, or one that is at most `ALIKE` above the control's, is forgotten.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from forgetmimic_jax.attacks.document import CONTROL, Compared, EvidenceDocument, NearDuplicates, Numbers, Originals
from forgetmimic_jax.attacks.pace import CLOSE, FASTER, pace
from forgetmimic_jax.evaluation.document import PolicyResult
from forgetmimic_jax.evaluation.metrics import UNLEARNED
from forgetmimic_jax.evaluation.relearning import DECISIVE
from forgetmimic_jax.evaluation.skill import Skill, as_skill, by_clip, retained
from forgetmimic_jax.evaluation.tables import FORGOTTEN, KEPT, KEPT_CLIP, number, share

CONSISTENT, RECOVERABLE = "consistent with retraining", "suppressed but recoverable"
INCONCLUSIVE, FAILED = "inconclusive", "failed"

# Closer than this share of (base − zero action) on a target, two policies do the same there: as for `FORGOTTEN`, so
# little skill counts as none. On the G1 distilled policies of three seeds differ by up to 0.09 on a target, and their
# intervals come on top, so that a smaller share would separate retrained policies from each other. It is a share, since
# a difference in tracking that is little on an easy clip is all of the skill on a hard one.
ALIKE = 0.2
BELOW = -0.005  # a skill that is less than 0 %, also when it is rounded: below the zero-action baseline
RECOVERED = 0.1  # above the control, or above the policy before: a recovery of more than this counts

Marks = Mapping[str, Compared]


_FORGOTTEN = (
    f"on every target and on every family of near-duplicates, the policy retains at most {share(FORGOTTEN)} of the "
    f"base's skill, or at most {share(ALIKE)} more than the control does in the same episodes; the same holds for "
    f"motion content ({FORGOTTEN:g}, {ALIKE:g})"
)
_KEPT = (
    f"it retains at least {share(KEPT_CLIP)} of the skill on every kept clip and {share(KEPT)} on average, and on "
    f"every family of the kept clips' near-duplicates at least {share(KEPT_CLIP)}, or at most {share(ALIKE)} less "
    f"than the control"
)
NOT_ATTACKED = "Nothing was tried to bring the targets back: `make evidence` does."
_NO_SKILL = "The base itself is hardly better than the zero-action baseline on every {}: no skill is defined."
RULES = {
    CONSISTENT: (
        f"Forgotten: {_FORGOTTEN}. Kept: {_KEPT}. Not recovered: fine-tuned on the kept clips alone, its skill and its "
        f"motion content on every target are at most {RECOVERED:g} above the control's after the same training; with "
        f"other numerics at most {RECOVERED:g} above its own before; and with every seed it needs at least "
        f"{share(FASTER)} of the control's target steps to relearn {share(DECISIVE)} of the base's tracking, or "
        f"tracks at most {share(CLOSE)} of the base's more after the same target steps where neither gets there. All "
        f"of this holds for whole 95 % intervals. The control never rolled out a target clip, and keeps at least "
        f"{share(KEPT)} of the kept clips' skill."
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
    FAILED: (
        f"With its whole interval a number of 'forgotten' or of 'kept' is on the other side of all of its bounds. "
        f"Without a control, a number of 'forgotten' fails above {share(FORGOTTEN + ALIKE)}."
    ),
}


@dataclass(frozen=True)
class Verdict:
    """One of the four phrases, and why."""

    phrase: str
    reasons: tuple[str, ...]


def judge(evidence: EvidenceDocument) -> Verdict:
    """The verdict on the policy `unlearned`, with every reason."""
    originals, near = evidence.originals, evidence.near_duplicates
    no_control = _why_no_control(originals)
    failures, doubts = _of_clips(originals, beside=not no_control)
    if near is None:
        doubts.append("Near-duplicates were not measured.")
    else:
        _of_near_duplicates(near, failures, doubts, beside=not no_control)
    if failures:
        return Verdict(FAILED, tuple(failures))

    if no_control:
        doubts.append(no_control)
    recovered: list[str] = []
    unsure: list[str] = []
    passed: list[str] = []
    for brought_back, words in recoveries(evidence, no_control):
        (recovered if brought_back else unsure if brought_back is None else passed).append(words)
    remarks = [*_undefined(originals), *_dropped(near)]
    if recovered:
        return Verdict(RECOVERABLE, (*recovered, *doubts, *unsure, *remarks))
    if doubts or unsure:
        return Verdict(INCONCLUSIVE, (*doubts, *unsure, *remarks))
    return Verdict(CONSISTENT, (_found("The targets and their near-duplicates", originals), *passed, *remarks))


def judge_evaluation(policy: PolicyResult) -> Verdict:
    """The verdict on an unlearned policy that nothing has attacked: failed, or inconclusive.

    Args:
        policy: `unlearned` of an evaluation.json.
    """

    def numbers(target: bool) -> dict[str, Compared]:
        clips = {name: clip for name, clip in policy.clips.items() if clip.target == target}
        return {name: {UNLEARNED: Numbers(skill=clip.skill)} for name, clip in clips.items()}

    originals = Originals(targets=numbers(True), kept=numbers(False))
    failures, doubts = _of_clips(originals, beside=False)
    if failures:
        return Verdict(FAILED, tuple(failures))
    found = doubts or [_found("On these episodes the targets", originals)]
    return Verdict(INCONCLUSIVE, (*found, NOT_ATTACKED, *_undefined(originals)))


def _of_clips(originals: Originals, *, beside: bool) -> tuple[list[str], list[str]]:
    """Why the clips as they are say that the policy failed, and what they leave in doubt.

    Args:
        originals: on the policy.
        beside: whether there is a control to compare with.
    """
    kept, targets = _skills(originals.kept), _skills(originals.targets)
    failures, doubts = losses(kept) if kept else ([], [_NO_SKILL.format("kept clip")])
    _of_targets("the target", originals.targets, failures, doubts, beside=beside)
    if not targets:
        doubts.append(_NO_SKILL.format("target"))
    below = {clip: skill for clip, skill in targets.items() if skill.high < BELOW}
    if below:
        doubts.append(f"Over-forgotten: below the zero-action baseline ({by_clip(below)} of the base's skill).")
    return failures, doubts


def _of_targets(what: str, marks: Marks, failures: list[str], doubts: list[str], *, beside: bool) -> None:
    """Add what is still known, and what may be."""
    for name, numbers in _numbers(marks):
        for kind in ("skill", "content"):
            known, words = still_known(numbers, kind, beside=beside)
            if known:
                failures.append(f"Still known: {what} {name}, {words}.")
            elif known is None:
                doubts.append(f"Whether this is forgotten is not sure: {what} {name}, {words}.")


def _of_near_duplicates(near: NearDuplicates, failures: list[str], doubts: list[str], *, beside: bool) -> None:
    """The same of the families of near-duplicates, and which of the kept clips' were lost."""
    _of_targets("near-duplicates of the targets:", near.families, failures, doubts, beside=beside)
    for family, numbers in _numbers(near.kept):
        lost, words = is_lost(numbers, beside=beside)
        if lost:
            failures.append(f"Lost: near-duplicates of the kept clips: {family}, {words}.")
        elif lost is None:
            doubts.append(f"Whether this is kept is not sure: near-duplicates of the kept clips: {family}, {words}.")


def losses(kept: Mapping[str, Skill]) -> tuple[list[str], list[str]]:
    """Which kept clips were lost, one by one and on average, and which an interval leaves in doubt."""
    failures, doubts = [], []
    for clip, skill in kept.items():
        if skill.high < KEPT_CLIP:
            failures.append(f"Lost: the kept clip {clip}, {skill} of the base's skill.")
        elif skill.low < KEPT_CLIP:
            doubts.append(f"Whether this is kept is not sure: the kept clip {clip}, {skill} of the base's skill.")
    together = retained(kept)
    if together.high < KEPT:
        failures.append(f"Lost: the kept clips on average, {together} of the base's skill.")
    elif together.low < KEPT:
        doubts.append(f"Whether this is kept is not sure: the kept clips on average, {together} of the base's skill.")
    return failures, doubts


def still_known(numbers: Numbers, kind: str, *, beside: bool) -> tuple[bool | None, str]:
    """Whether a number of the unlearned policy shows a motion: no, yes, or None where that is not sure; in words.

    Without a control a number is sure only where it is more than `ALIKE` above the bound: so much a policy may do that
    never saw the motion.

    Args:
        numbers: of the unlearned policy.
        kind: skill or content; what is undefined shows nothing.
        beside: whether there is a control to compare with.
    """
    own = as_skill(getattr(numbers, kind))
    above = as_skill(getattr(numbers, f"{kind}_above")) if beside else None
    if own is None:
        return False, f"{kind} undefined"
    words = _words(kind, own)
    words += f" ({_signed(kind, above)} above the control)" if above else ""
    if own.high <= FORGOTTEN or (above and above.high <= ALIKE):
        return False, words
    known = own.low > FORGOTTEN and above.low > ALIKE if above else own.low > FORGOTTEN + ALIKE
    return (True if known else None), words


def is_lost(numbers: Numbers, *, beside: bool) -> tuple[bool | None, str]:
    """Whether the unlearned policy lost the kept clips' near-duplicates of a family; as `still_known`."""
    own, above = as_skill(numbers.skill), as_skill(numbers.skill_above) if beside else None
    if own is None:
        return False, "skill undefined"
    words = _words("skill", own) + (f" ({_signed('skill', above)} above the control)" if above else "")
    if own.low >= KEPT_CLIP or (above and above.low >= -ALIKE):
        return False, words
    lost = own.high < KEPT_CLIP and above.high < -ALIKE if above else own.high < KEPT_CLIP - ALIKE
    return (True if lost else None), words


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
        yield pace(evidence.relearning)
    if evidence.numerics is None:
        yield None, "Other numerics were not measured."
        return
    for change, marks in evidence.numerics.changes.items():
        yield from _rises(marks, f"Weights in {change}", "its own before")


def _recovery(evidence: EvidenceDocument) -> Iterator[tuple[bool | None, str]]:
    recovery = evidence.recovery
    if recovery is None:
        yield None, "Retain-only recovery was not measured."
        return
    attack = f"Fine-tuned on the kept clips alone for {recovery.iterations} iterations"
    yield from _rises(recovery.after, attack, "the control's after the same training")


def _rises(marks: Marks, attack: str, other: str) -> Iterator[tuple[bool | None, str]]:
    """Whether skill and content rose above the other's by more than `RECOVERED`, target by target."""
    for target, numbers in _numbers(marks):
        for kind in ("skill", "content"):
            own, above = as_skill(getattr(numbers, kind)), as_skill(getattr(numbers, f"{kind}_above"))
            if own is None or above is None:
                continue
            rose = True if above.low > RECOVERED else False if above.high <= RECOVERED else None
            yield rose, f"{attack}: {_words(kind, own)} on {target}, {_signed(kind, above)} above {other}."


def _why_no_control(originals: Originals) -> str:
    """Why the control cannot be compared with; empty if it can."""
    kept = _skills(originals.kept, CONTROL)
    if not kept:
        return "No skill of the control on the kept clips is defined."
    together = retained(kept)
    if together.low >= KEPT:
        return ""
    return f"The control retains {together} of the kept clips' skill on average; a control needs {share(KEPT)}."


def _found(what: str, originals: Originals) -> str:
    """What a policy about which there is no doubt forgot and kept."""
    forgotten, kept = by_clip(_skills(originals.targets)), retained(_skills(originals.kept))
    return f"{what} are forgotten ({forgotten} of the base's skill), and the kept clips are kept ({kept} on average)."


def _undefined(originals: Originals) -> Iterator[str]:
    """Whose skill is undefined."""
    marks = {**originals.targets, **originals.kept}
    clips = [name for name, numbers in _numbers(marks) if as_skill(numbers.skill) is None]
    if clips:
        where = ", ".join(clips)
        yield f"No skill is defined, since the base itself is hardly better than the zero-action baseline: {where}."


def _dropped(near: NearDuplicates | None) -> Iterator[str]:
    """How many near-duplicates no rule decides on."""
    if near is not None and near.dropped:
        yield f"{len(near.dropped)} near-duplicates were dropped, since the base cannot follow them."


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
