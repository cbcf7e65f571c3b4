"""The phases of pretraining: a pure function from what an evaluation found to the settings of the next iterations.

broad    All clips, more steps for those that fail. Ends when the mean score makes no progress.
lagging  Most of the steps for the clips that are new or learning; on the clips that the best policy has mastered, a KL
         to it. Ends when the mean score makes no progress, or every clip is mastered or stuck.
distil   The best policy and the experts become one. No iterations.
stuck    A specialist for every clip that is not mastered, one after the other: training on that clip alone. Ends when
         each has mastered its clip or makes no progress. Then `distil` again, and so on.
done     The best policy has mastered every clip, no specialist helped, or no iterations are left.

The score of a clip is the mean of its success and its tracking (survival-weighted). Of all policies that were
evaluated, the best one has the highest mean score, and the expert of a clip has the highest score on it, if that is
clearly above the best policy's. A specialist starts from its clip's expert, if there is one; all else starts from the
best policy. Everything here is plain values, so that a curriculum can be written as JSON.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from forgetmimic_jax.settings.config import Config, PretrainConfig

Phase = Literal["broad", "lagging", "distil", "stuck", "done"]
ClipState = Literal["new", "learning", "mastered", "stuck"]


@dataclass(frozen=True)
class Measured:
    """What an evaluation says of a clip."""

    success: float = 0.0
    tracking: float = 0.0  # survival-weighted
    steps: float = 1.0  # control steps of a mean episode
    completed: bool = False  # an episode from the first frame reached the clip's end

    @property
    def score(self) -> float:
        """Mean of success and tracking: one may rise without the other."""
        return 0.5 * (self.success + self.tracking)


@dataclass(frozen=True)
class ClipProgress:
    """How far a clip has come in this phase."""

    last: Measured = Measured()
    record: float = 0.0  # the highest score
    stalled: int = 0  # evaluations since the record rose by `gain`
    completed: bool = False  # an episode from the first frame has completed it, in this phase or before

    def state(self, config: PretrainConfig) -> ClipState:
        """mastered; stuck: no progress; new: no episode from the first frame has completed it; learning: else."""
        if self.last.success >= config.mastered:
            return "mastered"
        if self.stalled >= config.patience:
            return "stuck"
        return "learning" if self.completed else "new"

    def after(self, config: PretrainConfig, found: Measured) -> ClipProgress:
        """With one more evaluation."""
        progress = found.score >= self.record + config.gain
        return ClipProgress(
            last=found,
            record=found.score if progress else self.record,
            stalled=0 if progress else self.stalled + 1,
            completed=self.completed or found.completed,
        )


@dataclass(frozen=True)
class Kept:
    """A policy that is kept, by the number of the evaluation that measured it."""

    number: int
    clips: dict[str, Measured]

    @property
    def score(self) -> float:
        """Mean score over the clips."""
        return sum(clip.score for clip in self.clips.values()) / len(self.clips)


@dataclass(frozen=True)
class Curriculum:
    """How far pretraining has come."""

    clips: dict[str, ClipProgress]
    phase: Phase = "broad"
    stage: int = 0  # counts the times that training started again from a kept policy
    evaluations: int = 0  # in this stage
    longest: int = 0  # evaluations that this specialist may have
    number: int = 0  # evaluations of the run
    record: float = 0.0  # highest mean score of this stage
    stalled: int = 0  # evaluations since it rose by `gain`
    specialists: tuple[str, ...] = ()  # clips that still need one; the first one's is being trained
    experts: dict[str, Kept] = field(default_factory=dict)  # by clip
    best: Kept | None = None

    @property
    def specialist(self) -> str | None:
        """The clip that a specialist is trained on, if any."""
        return self.specialists[0] if self.phase == "stuck" else None

    @property
    def start(self) -> Kept:
        """The policy that this stage starts from: the best one, or for a specialist its clip's expert."""
        assert self.best is not None
        return self.expert(self.specialist) if self.specialist else self.best

    def expert(self, clip: str) -> Kept:
        """The clip's expert, or without one the best policy."""
        assert self.best is not None
        return self.experts.get(clip, self.best)

    def states(self, config: PretrainConfig) -> dict[str, ClipState]:
        """The state of every clip."""
        return {name: clip.state(config) for name, clip in self.clips.items()}

    def unmastered(self, config: PretrainConfig) -> list[str]:
        """The clips that the best policy has not mastered, the nearest to it first."""
        assert self.best is not None
        clips = self.best.clips
        missing = [name for name, clip in clips.items() if clip.success < config.mastered]
        return sorted(missing, key=lambda name: -clips[name].score)


@dataclass(frozen=True)
class Settings:
    """What the iterations until the next evaluation train on; tuples are by clip."""

    starts: tuple[float, ...]  # shares of the starts
    best_kl: tuple[float, ...]  # weight of the KL to the best policy
    target_kl: float
    gae_lambda: float


def advance(config: Config, curriculum: Curriculum, found: Mapping[str, Measured], iteration: int) -> Curriculum:
    """The curriculum after an evaluation.

    Args:
        config: of the run.
        curriculum: before.
        found: of every clip, by the policy that this stage has trained so far or, in `distil`, by the distilled one.
        iteration: of the run.
    """
    rules, done = config.pretrain, iteration / config.iterations
    kept = Kept(curriculum.number + 1, dict(found))
    best = kept if curriculum.best is None or kept.score > curriculum.best.score else curriculum.best
    progress = kept.score >= curriculum.record + rules.gain
    seen = dataclasses.replace(
        curriculum,
        clips={
            name: clip.after(rules, found[name]) if curriculum.specialist in (None, name) else clip
            for name, clip in curriculum.clips.items()
        },
        evaluations=curriculum.evaluations + 1,
        number=kept.number,
        record=kept.score if progress else curriculum.record,
        stalled=0 if progress else curriculum.stalled + 1,
        best=best,
        experts=_experts(rules, best, curriculum, kept),
    )
    if not seen.unmastered(rules):
        return dataclasses.replace(seen, phase="done")
    stalled = seen.stalled >= rules.patience
    match seen.phase:
        case "broad":
            if not stalled and done < rules.broad_until:
                return seen
            return _begin(seen, "lagging") if done < rules.lagging_until else _after_lagging(config, seen, done)
        case "lagging":
            moving = any(state in ("new", "learning") for state in seen.states(rules).values())
            return seen if moving and not stalled and done < rules.lagging_until else _after_lagging(config, seen, done)
        case "stuck":
            moving = seen.clips[seen.specialists[0]].state(rules) in ("new", "learning")
            if moving and seen.evaluations < seen.longest and done < 1.0:
                return seen
            unmastered = seen.unmastered(rules)
            return _specialists(config, seen, [name for name in seen.specialists[1:] if name in unmastered], done)
        case "distil":
            return _specialists(config, seen, seen.unmastered(rules), done)
    return seen


def _experts(rules: PretrainConfig, best: Kept, before: Curriculum, new: Kept) -> dict[str, Kept]:
    """By clip, the policy with the highest score on it, where that is above the best policy's by `gain`.

    Also a policy that was the best one before: another one may be better in the mean and worse on a clip.
    """
    first = {
        clip: new if before.best is None else max(before.expert(clip), new, key=lambda kept: kept.clips[clip].score)
        for clip in best.clips
    }
    return {clip: kept for clip, kept in first.items() if kept.clips[clip].score >= best.clips[clip].score + rules.gain}


def _after_lagging(config: Config, seen: Curriculum, done: float) -> Curriculum:
    """Distillation of what single policies did best on the way, then specialists."""
    return (
        _begin(seen, "distil") if seen.experts else _specialists(config, seen, seen.unmastered(config.pretrain), done)
    )


def _specialists(config: Config, seen: Curriculum, clips: list[str], done: float) -> Curriculum:
    """A specialist for the first of the clips; without clips or time, distil or end.

    Its part of the time is that of the score that its clip lacks.
    """
    left = int((1.0 - done) * config.iterations / config.evaluate_every)
    if clips and left >= 1:
        lacking = [1.0 - seen.expert(clip).clips[clip].score for clip in clips]
        longest = min(config.pretrain.specialist_evaluations, max(1, round(left * lacking[0] / sum(lacking))))
        return _begin(seen, "stuck", specialists=tuple(clips), longest=longest)
    distil = seen.experts and seen.phase != "distil"
    return _begin(seen, "distil") if distil else dataclasses.replace(seen, phase="done")


def _begin(seen: Curriculum, phase: Phase, specialists: tuple[str, ...] = (), longest: int = 0) -> Curriculum:
    """A phase, or a specialist, begins; progress is counted from what its first policy can do.

    A clip that waits for its specialist, or had it, stays as it was.
    """
    new = dataclasses.replace(
        seen, phase=phase, stage=seen.stage + 1, evaluations=0, longest=longest, stalled=0, specialists=specialists
    )
    first = new.start.clips
    clips = {
        name: ClipProgress(first[name], first[name].score, 0, clip.completed or first[name].completed)
        if phase == "lagging" or name == new.specialist
        else clip
        for name, clip in seen.clips.items()
    }
    return dataclasses.replace(new, clips=clips, record=new.start.score)


def settings_of(config: Config, curriculum: Curriculum) -> Settings:
    """What the next iterations train on."""
    rules, best = config.pretrain, curriculum.best
    first = curriculum.phase == "broad"
    target_kl = config.ppo.target_kl if first else rules.target_kl
    best_kl = {name: 0.0 for name in curriculum.clips}
    if curriculum.phase == "lagging" and best is not None:
        best_kl = {name: rules.best_kl * (clip.success >= rules.mastered) for name, clip in best.clips.items()}
    shares = step_shares(config, curriculum)
    starts = {name: share / max(1.0, curriculum.clips[name].last.steps) for name, share in shares.items()}
    total = sum(starts.values())
    return Settings(
        starts=tuple(starts[name] / total for name in curriculum.clips),
        best_kl=tuple(best_kl[name] for name in curriculum.clips),
        target_kl=target_kl,
        gae_lambda=config.ppo.gae_lambda if first else rules.gae_lambda,
    )


def step_shares(config: Config, curriculum: Curriculum) -> dict[str, float]:
    """The share of the steps that every clip should have; episodes of a clip that fails are short."""
    rules, clips = config.pretrain, curriculum.clips
    if curriculum.specialist:
        return {name: float(name == curriculum.specialist) for name in clips}
    failure = {name: 1.0 - clip.last.tracking for name, clip in clips.items()}
    states = curriculum.states(rules)
    lagging = [name for name in clips if states[name] in ("new", "learning")]
    if curriculum.phase == "lagging" and 0 < len(lagging) < len(clips):
        wanted = {name: failure[name] * 0.5 ** clips[name].stalled for name in lagging}
        others = (1.0 - rules.lagging_share) / (len(clips) - len(lagging))
        total = sum(wanted.values())
        return {name: rules.lagging_share * wanted[name] / total if name in wanted else others for name in clips}
    even, total = config.sampling.uniform_ratio / len(clips), max(sum(failure.values()), 1e-9)
    return {name: even + (1.0 - config.sampling.uniform_ratio) * failure[name] / total for name in clips}
