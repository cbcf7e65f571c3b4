"""Skills with their intervals, as rules compare them: by the ends of the intervals, never by the means.

A clip on which the base is hardly better than the zero-action baseline has no defined skill
(`metrics.MINIMUM_SKILL_RANGE`): there is nothing to forget or to keep, so rules leave it out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from typing import NamedTuple

from forgetmimic_jax.evaluation.document import Estimate, PolicyResult
from forgetmimic_jax.evaluation.tables import percent


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
        return percent(self.estimate) + (" (too few episodes for an interval)" if self.high == inf else "")


def as_skill(estimate: Estimate | None) -> Skill | None:
    """An estimate as rules compare it; None where it is undefined."""
    if estimate is None or estimate.mean is None:
        return None
    low, high = estimate.low, estimate.high
    return Skill(estimate.mean, -inf if low is None else low, inf if high is None else high)


def skills(policy: PolicyResult, *, target: bool) -> dict[str, Skill]:
    """The defined skills, signed, of a policy's targets or of its kept clips."""
    found = {name: clip.skill for name, clip in policy.clips.items() if clip.target == target}
    return {name: skill for name, estimate in found.items() if (skill := as_skill(estimate))}


def retained(skill: Mapping[str, Skill]) -> Skill:
    """Skill that a group of clips retains: the mean over its clips, where a negative skill counts as 0.

    So a clip that was sabotaged never pays for one that is still known. The interval takes the low ends of all clips
    together, then the high ends: it is wider than a 95 % interval of the mean, so in doubt a rule does not decide.
    """
    return Skill(*(mean_retained(ends) for ends in zip(*skill.values(), strict=True)))


def mean_retained(skills: Sequence[float]) -> float:
    """The mean of the clips' skills, where a negative one counts as 0."""
    return sum(max(0.0, skill) for skill in skills) / len(skills)


def by_clip(skill: Mapping[str, Skill]) -> str:
    """Each clip with its skill, in words."""
    return ", ".join(f"{clip} {of}" for clip, of in skill.items())
