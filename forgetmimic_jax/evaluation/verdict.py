"""What an evaluation allows to say of an unlearned policy: one of four phrases, each with its rule.

The rules read each clip's skill with its 95 % interval: a group's mean can hide a clip that was lost or still known.
Two numbers are compared by the ends of their intervals, never by their means: what too few episodes cannot separate is
inconclusive. A clip on which the base is hardly better than the zero-action baseline has no defined skill
(`metrics.MINIMUM_SKILL_RANGE`): there is nothing to forget or to keep, so the rules leave it out and the reasons name
it. Where that leaves no target or no kept clip, the verdict is inconclusive.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from forgetmimic_jax.evaluation.metrics import UNLEARNED
from forgetmimic_jax.evaluation.relearning import Lasted
from forgetmimic_jax.evaluation.statistics import Estimate
from forgetmimic_jax.evaluation.tables import FORGOTTEN, KEPT, percent

CONSISTENT, RECOVERABLE = "consistent with retraining", "suppressed but recoverable"
INCONCLUSIVE, FAILED = "inconclusive", "failed"

# One clip varies more from training to training than the mean of all: on the G1 three distilled policies retain 90 % of
# the kept clips' skill on average, and 68 to 83 % of their weakest clip's. Below a half a clip counts as lost.
KEPT_CLIP = 0.5
# Closer than this share of (base − zero action) on a target, two policies do the same there: as for `FORGOTTEN`, so
# little skill counts as none. Distilled policies of three seeds differ by up to 0.09 from each other, and the intervals
# of 20 episodes add some 0.1, so a smaller share would tell retrained policies apart from each other. A share, since
# an absolute difference of tracking means little on an easy clip and all of the skill on a hard one.
ALIKE = 0.2
FASTER = 0.5  # relearning within this share of the control's target steps means that some skill was only hidden


def _bound(share: float) -> str:
    return percent({"mean": share})


RULES = {
    CONSISTENT: (
        f"Forgotten: on every target the policy retains at most {_bound(FORGOTTEN)} of the base's skill, and it is not "
        f"below the zero-action baseline. Kept: it retains at least {_bound(KEPT_CLIP)} of the skill on every kept "
        f"clip and at least {_bound(KEPT)} on average, a negative skill counting as 0. Like the control: on every "
        f"target its skill is within {_bound(ALIKE)} of the base's from the control's. All of this holds for whole "
        f"95 % intervals. Not faster to relearn: to reach 80 % of the base's tracking on the targets, it needs at "
        f"least {_bound(FASTER)} of the target steps that the control needs, with every seed. The control is a policy "
        f"that never rolled out a target clip: retrained or distilled on the kept clips alone."
    ),
    RECOVERABLE: (
        f"Forgotten (at most {_bound(FORGOTTEN)} on every target) and kept as above, but with every seed the policy "
        f"relearns the targets with less than {_bound(FASTER)} of the target steps that the control of that seed needs "
        f"or is trained for."
    ),
    INCONCLUSIVE: (
        "None of the other rules holds: an interval includes a bound, a comparison was not measured, or the policy "
        "differs from the control or is below the zero-action baseline (over-forgotten)."
    ),
    FAILED: (
        f"With its whole 95 % interval, a target's retained skill is above {_bound(FORGOTTEN)}, a kept clip's is below "
        f"{_bound(KEPT_CLIP)}, or the kept clips' average is below {_bound(KEPT)}."
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


NO_CONTROL = NotMeasured("It was not compared with a control that never rolled out a target clip.")
NO_RELEARNING = NotMeasured("How fast it relearns the targets was not measured.")


def judge(
    policies: Mapping[str, Any],
    *,
    control: Mapping[str, Any] | NotMeasured = NO_CONTROL,
    relearning: Mapping[str, tuple[Lasted, Lasted]] | NotMeasured = NO_RELEARNING,
) -> Verdict:
    """The verdict on the policy `unlearned` of an evaluation.

    Args:
        policies: the `policies` of its evaluation.json, with base, unlearned and zero_action.
        control: the result, on the same episodes, of a policy that never rolled out the targets.
        relearning: by seed, how long the unlearned policy and the control took until 80 % of the base's tracking on the
            targets.
    """
    clips = policies[UNLEARNED]["clips"]
    target, kept = (skills(clips, target=is_target) for is_target in (True, False))
    for what, skill in (("targets", target), ("kept clips", kept)):
        if not skill:
            none = f"The base itself is hardly better than the zero-action baseline on the {what}: no skill is defined."
            return Verdict(INCONCLUSIVE, (none,))
    without = [clip for skill in (target, kept) for clip, of in skill.items() if not {"low", "high"} <= of.keys()]
    if without:
        few = f"Too few episodes for an interval: {', '.join(without)}."
        return Verdict(INCONCLUSIVE, (few,))
    failures, doubts = _forgotten_and_kept(target, kept)
    if failures or doubts:
        return Verdict(FAILED if failures else INCONCLUSIVE, tuple(failures or doubts))

    found = [
        f"On these episodes the targets are forgotten ({_by_clip(target)} of the base's skill retained) and the kept "
        f"clips are kept ({percent(retained(kept))} on average)."
    ]
    undefined = [clip for clip in clips if clip not in target and clip not in kept]
    if undefined:
        found.append(
            f"Not judged, since the base itself is hardly better than the zero-action baseline: {', '.join(undefined)}."
        )
    below = {clip: skill for clip, skill in target.items() if skill["high"] < 0.0}
    over = [f"It is below the zero-action baseline: over-forgotten ({_by_clip(below)} of the base's skill)."]
    found += over if below else []

    sooner: list[bool | None] = []
    if not isinstance(relearning, NotMeasured):
        sooner = [_sooner(*pair) for pair in relearning.values()]
        if sooner and all(sooner):
            return Verdict(
                RECOVERABLE, (*found, f"It relearns the targets faster than the control: {_steps(relearning)}.")
            )
    missing = []
    if isinstance(control, NotMeasured):
        missing.append(control.reason)
    else:
        theirs = skills(control["clips"], target=True)
        unlike = [clip for clip in target if clip not in theirs or _furthest(target[clip], theirs[clip]) > ALIKE]
        if unlike:
            pairs = "; ".join(f"{clip}: {percent(target[clip])} against {percent(theirs.get(clip))}" for clip in unlike)
            missing.append(f"Its skill may differ by more than {_bound(ALIKE)} from the control's: {pairs}.")
    if isinstance(relearning, NotMeasured):
        missing.append(relearning.reason)
    elif any(sooner):
        missing.append(f"With some seeds it relearns the targets faster than the control: {_steps(relearning)}.")
    elif None in sooner or not sooner:
        missing.append(f"Relearning was stopped too early to compare: {_steps(relearning)}.")
    if missing or below:
        return Verdict(INCONCLUSIVE, (*found, *missing))
    assert not isinstance(relearning, NotMeasured)
    found.append(f"On every target its skill is within {_bound(ALIKE)} of the control's.")
    return Verdict(
        CONSISTENT, (*found, f"It does not relearn the targets faster than the control: {_steps(relearning)}.")
    )


def skills(clips: Mapping[str, Any], *, target: bool) -> dict[str, Estimate]:
    """The defined skills, signed, of a policy's targets or of its kept clips."""
    return {clip: of["skill"] for clip, of in clips.items() if of["target"] == target and "mean" in of.get("skill", {})}


def retained(skill: Mapping[str, Estimate]) -> Estimate:
    """Skill that a group of clips retains: the mean over its clips, where a negative skill counts as 0.

    So a clip that was sabotaged never pays for one that is still known. The interval takes the low ends of all clips
    together, then the high ends: it is wider than a 95 % interval of the mean, so in doubt the verdict is inconclusive.
    """
    count = len(skill)
    mean, low, high = (
        sum(max(0.0, of[end]) for of in skill.values()) / count  # type: ignore[literal-required]
        for end in ("mean", "low", "high")
    )
    return Estimate(mean=mean, low=low, high=high, n=count)


def _forgotten_and_kept(target: Mapping[str, Estimate], kept: Mapping[str, Estimate]) -> tuple[list[str], list[str]]:
    """What failed, and what an interval leaves in doubt."""
    failures, doubts = [], []
    for clip, skill in target.items():
        if skill["low"] > FORGOTTEN:
            failures.append(f"The target {clip} is still known: {percent(skill)} of the base's skill retained.")
        elif skill["high"] > FORGOTTEN:
            doubts.append(f"Whether the target {clip} is forgotten is not sure: {percent(skill)} of the base's skill.")
    for clip, skill in kept.items():
        if skill["high"] < KEPT_CLIP:
            failures.append(f"The kept clip {clip} was lost: {percent(skill)} of the base's skill retained.")
        elif skill["low"] < KEPT_CLIP:
            doubts.append(f"Whether the kept clip {clip} was lost is not sure: {percent(skill)} of the base's skill.")
    together = retained(kept)
    if together["high"] < KEPT:
        failures.append(f"The kept clips were not kept: {percent(together)} of the base's skill on average.")
    elif together["low"] < KEPT:
        doubts.append(
            f"Whether the kept clips are kept is not sure: {percent(together)} of the base's skill on average."
        )
    return failures, doubts


def _by_clip(skill: Mapping[str, Estimate]) -> str:
    return ", ".join(f"{clip} {percent(of)}" for clip, of in skill.items())


def _sooner(unlearned: Lasted, control: Lasted) -> bool | None:
    """Whether the unlearned policy was faster; None where a run ended before that could be seen."""
    if unlearned.target_steps < FASTER * control.target_steps:
        return True if unlearned.there else None
    return False if control.there else None


def _furthest(one: Estimate, other: Estimate) -> float:
    """The largest difference that the two intervals allow; infinite without an interval."""
    if not {"low", "high"} <= other.keys():
        return float("inf")
    return max(one["high"] - other["low"], other["high"] - one["low"])


def _steps(relearning: Mapping[str, tuple[Lasted, Lasted]]) -> str:
    def needed(run: Lasted) -> str:
        return f"{'' if run.there else 'more than '}{run.target_steps:,.0f}"

    seeds = "; ".join(f"{needed(unlearned)} against {needed(control)}" for unlearned, control in relearning.values())
    return f"unlearned policy against control, seed by seed, {seeds or 'none'} target steps"
