"""What an evaluation allows to say of an unlearned policy: one of four phrases, each with its rule.

The rules read each clip's skill with its 95 % interval: a group's mean can hide a clip that was lost or still known.
Two numbers are compared by the ends of their intervals, never by their means: what too few episodes cannot separate is
inconclusive. A clip on which the base is hardly better than the zero-action baseline has no defined skill
(`metrics.MINIMUM_SKILL_RANGE`): there is nothing to forget or to keep, so the rules leave it out and the reasons name
it. Where that leaves no target or no kept clip, the verdict is inconclusive.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import NamedTuple

from forgetmimic_jax.evaluation.document import Estimate, PolicyResult
from forgetmimic_jax.evaluation.metrics import UNLEARNED
from forgetmimic_jax.evaluation.relearning import Lasted
from forgetmimic_jax.evaluation.tables import FORGOTTEN, KEPT, KEPT_CLIP, percent

CONSISTENT, RECOVERABLE = "consistent with retraining", "suppressed but recoverable"
INCONCLUSIVE, FAILED = "inconclusive", "failed"

# Closer than this share of (base − zero action) on a target, two policies do the same there: as for `FORGOTTEN`, so
# little skill counts as none. On the G1 distilled policies of three seeds differ by up to 0.09 on a target, and their
# intervals come on top, so that a smaller share would separate retrained policies from each other. It is a share, since
# a difference in tracking that is little on an easy clip is all of the skill on a hard one.
ALIKE = 0.2
BELOW = -0.005  # a skill that is less than 0 %, also when it is rounded: below the zero-action baseline
FASTER = 0.5  # relearning within this share of the control's target steps means that some skill was only hidden


def bound(share: float) -> str:
    """A bound on a share, in words."""
    return percent(Estimate(mean=share))


RULES = {
    CONSISTENT: (
        f"Forgotten: on every target the policy retains at most {bound(FORGOTTEN)} of the base's skill, and it is not "
        f"below the zero-action baseline. Kept: it retains at least {bound(KEPT_CLIP)} of the skill on every kept "
        f"clip and at least {bound(KEPT)} on average, a negative skill counting as 0. Like the control: on every "
        f"target its skill is within {bound(ALIKE)} of the base's from the control's. All of this holds for whole "
        f"95 % intervals. Not faster to relearn: to reach 80 % of the base's tracking on the targets, it needs at "
        f"least {bound(FASTER)} of the target steps that the control needs, with every seed. The control is a policy "
        f"that never rolled out a target clip: retrained or distilled on the kept clips alone."
    ),
    RECOVERABLE: (
        f"Forgotten (at most {bound(FORGOTTEN)} on every target) and kept as above, but with every seed the policy "
        f"relearns the targets with less than {bound(FASTER)} of the target steps that the control of that seed needs "
        f"or is trained for."
    ),
    INCONCLUSIVE: (
        "None of the other rules holds: an interval includes a bound, a comparison was not measured, or the policy "
        "differs from the control or is below the zero-action baseline (over-forgotten)."
    ),
    FAILED: (
        f"With its whole 95 % interval, a target's retained skill is above {bound(FORGOTTEN)}, a kept clip's is below "
        f"{bound(KEPT_CLIP)}, or the kept clips' average is below {bound(KEPT)}."
    ),
}


@dataclass(frozen=True)
class Verdict:
    """One of the four phrases, and why."""

    phrase: str
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class NotMeasured:
    """A comparison that the verdict lacks, and why."""

    reason: str


class Skill(NamedTuple):
    """A defined skill and its interval, which is infinite where too few episodes were measured for one."""

    mean: float
    low: float
    high: float

    @property
    def estimate(self) -> Estimate:
        """The same, without an infinite interval."""
        return Estimate(self.mean) if self.high == inf else Estimate(*self)

    def __str__(self) -> str:
        return percent(self.estimate)


NO_CONTROL = NotMeasured("It was not compared with a control that never rolled out a target clip.")
NO_RELEARNING = NotMeasured("How fast it relearns the targets was not measured.")


def judge(
    policies: Mapping[str, PolicyResult],
    *,
    control: PolicyResult | NotMeasured = NO_CONTROL,
    relearning: Mapping[str, tuple[Lasted, Lasted]] | NotMeasured = NO_RELEARNING,
) -> Verdict:
    """The verdict on the policy `unlearned` of an evaluation.

    Args:
        policies: the `policies` of its evaluation.json, with base, unlearned and zero_action.
        control: the result, on the same episodes, of a policy that never rolled out the targets.
        relearning: by seed, how long the unlearned policy and the control took until 80 % of the base's tracking on the
            targets.
    """
    target = skills(policies[UNLEARNED], target=True)
    kept = skills(policies[UNLEARNED], target=False)
    for what, skill in (("targets", target), ("kept clips", kept)):
        if not skill:
            none = f"The base itself is hardly better than the zero-action baseline on the {what}: no skill is defined."
            return Verdict(INCONCLUSIVE, (none,))
    without = [clip for clip, skill in (target | kept).items() if skill.high == inf]
    if without:
        return Verdict(INCONCLUSIVE, (f"Too few episodes for an interval: {', '.join(without)}.",))
    known, perhaps_known = _forgotten(target)
    lost, perhaps_lost = losses(kept)
    failures, doubts = known + lost, perhaps_known + perhaps_lost
    if failures or doubts:
        return Verdict(FAILED if failures else INCONCLUSIVE, tuple(failures or doubts))

    found = [
        f"On these episodes the targets are forgotten ({by_clip(target)} of the base's skill retained) and the kept "
        f"clips are kept ({retained(kept)} on average)."
    ]
    undefined = [clip for clip in policies[UNLEARNED].clips if clip not in target | kept]
    if undefined:
        found.append(
            f"Not judged, since the base itself is hardly better than the zero-action baseline: {', '.join(undefined)}."
        )
    below = below_baseline(target)
    if below:
        found.append(f"It is below the zero-action baseline: over-forgotten ({by_clip(below)} of the base's skill).")

    faster, pace = _relearning_pace(relearning)
    if faster:
        return Verdict(RECOVERABLE, (*found, pace))
    unlike = _unlike(target, control)
    alike = f"On every target its skill is within {bound(ALIKE)} of the control's."
    phrase = INCONCLUSIVE if unlike or below or faster is None else CONSISTENT
    return Verdict(phrase, (*found, unlike or alike, pace))


def skills(policy: PolicyResult, *, target: bool) -> dict[str, Skill]:
    """The defined skills, signed, of a policy's targets or of its kept clips."""
    found = {name: clip.skill for name, clip in policy.clips.items() if clip.target == target}
    return {name: skill for name, estimate in found.items() if (skill := as_skill(estimate))}


def as_skill(estimate: Estimate | None) -> Skill | None:
    """An estimate as the rules compare it; None where it is undefined."""
    if estimate is None or estimate.mean is None:
        return None
    low, high = estimate.low, estimate.high
    return Skill(estimate.mean, -inf if low is None else low, inf if high is None else high)


def retained(skill: Mapping[str, Skill]) -> Skill:
    """Skill that a group of clips retains: the mean over its clips, where a negative skill counts as 0.

    So a clip that was sabotaged never pays for one that is still known. The interval takes the low ends of all clips
    together, then the high ends: it is wider than a 95 % interval of the mean, so in doubt the verdict is inconclusive.
    """
    mean, low, high = (sum(max(0.0, end) for end in ends) / len(skill) for ends in zip(*skill.values(), strict=True))
    return Skill(mean, low, high)


def _forgotten(target: Mapping[str, Skill]) -> tuple[list[str], list[str]]:
    """Which targets are still known, and which an interval leaves in doubt."""
    failures, doubts = [], []
    for clip, skill in target.items():
        if skill.low > FORGOTTEN:
            failures.append(f"The target {clip} is still known: {skill} of the base's skill retained.")
        elif skill.high > FORGOTTEN:
            doubts.append(f"Whether the target {clip} is forgotten is not sure: {skill} of the base's skill.")
    return failures, doubts


def losses(kept: Mapping[str, Skill]) -> tuple[list[str], list[str]]:
    """Which kept clips were lost, one by one and on average, and which an interval leaves in doubt."""
    failures, doubts = [], []
    for clip, skill in kept.items():
        if skill.high < KEPT_CLIP:
            failures.append(f"The kept clip {clip} was lost: {skill} of the base's skill retained.")
        elif skill.low < KEPT_CLIP:
            doubts.append(f"Whether the kept clip {clip} was lost is not sure: {skill} of the base's skill.")
    together = retained(kept)
    if together.high < KEPT:
        failures.append(f"The kept clips were not kept: {together} of the base's skill on average.")
    elif together.low < KEPT:
        doubts.append(f"Whether the kept clips are kept is not sure: {together} of the base's skill on average.")
    return failures, doubts


def below_baseline(target: Mapping[str, Skill]) -> dict[str, Skill]:
    """The targets on which a policy is worse than the zero-action baseline: no retrained policy is."""
    return {clip: skill for clip, skill in target.items() if skill.high < BELOW}


def by_clip(skill: Mapping[str, Skill]) -> str:
    """Each clip with its skill, in words."""
    return ", ".join(f"{clip} {of}" for clip, of in skill.items())


def _unlike(target: Mapping[str, Skill], control: PolicyResult | NotMeasured) -> str:
    """Why it is not sure that the policy does on the targets what the control does; empty if it is."""
    if isinstance(control, NotMeasured):
        return control.reason
    theirs = skills(control, target=True)
    unlike = [clip for clip in target if clip not in theirs or _furthest(target[clip], theirs[clip]) > ALIKE]
    pairs = "; ".join(f"{clip}: {target[clip]} against {theirs.get(clip, 'none')}" for clip in unlike)
    return f"Its skill may differ by more than {bound(ALIKE)} from the control's: {pairs}." if unlike else ""


def _furthest(one: Skill, other: Skill) -> float:
    """The largest difference that the two intervals allow."""
    return max(one.high - other.low, other.high - one.low)


def _relearning_pace(relearning: Mapping[str, tuple[Lasted, Lasted]] | NotMeasured) -> tuple[bool | None, str]:
    """Whether the policy relearns the targets faster than the control, None where that is not sure; in words."""
    if isinstance(relearning, NotMeasured):
        return None, relearning.reason
    return pace_over_seeds([sooner_than_control(*pair) for pair in relearning.values()], steps_in_words(relearning))


def pace_over_seeds(faster: Sequence[bool | None], numbers: str) -> tuple[bool | None, str]:
    """Whether the policy relearns the targets faster than the control, with every seed; None where that is not sure.

    Args:
        faster: of each seed; None where a run ended before that could be seen.
        numbers: what was measured, for the sentence.
    """
    if faster and all(faster):
        return True, f"It relearns the targets faster than the control: {numbers}."
    if any(faster):
        return None, f"With some seeds it relearns the targets faster than the control: {numbers}."
    if None in faster or not faster:
        return None, f"Relearning was stopped too early to compare: {numbers}."
    return False, f"It does not relearn the targets faster than the control: {numbers}."


def sooner_than_control(unlearned: Lasted, control: Lasted) -> bool | None:
    """Whether the unlearned policy was faster; None where a run ended before that could be seen."""
    if unlearned.target_steps < FASTER * control.target_steps:
        return True if unlearned.there else None
    return False if control.there else None


def steps_in_words(relearning: Mapping[str, tuple[Lasted, Lasted]]) -> str:
    """The target steps of both, seed by seed."""

    def needed(run: Lasted) -> str:
        return f"{'' if run.there else 'more than '}{run.target_steps:,.0f}"

    seeds = "; ".join(f"{needed(unlearned)} against {needed(control)}" for unlearned, control in relearning.values())
    return f"unlearned policy against control, seed by seed, {seeds or 'none'} target steps"
