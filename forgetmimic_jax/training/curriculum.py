"""The phases of pretraining: a pure function from what an evaluation found to the settings of the next iterations.

broad    All clips, more steps for those that fail. Ends when the mean tracking makes no progress.
lagging  Most of the steps for the clips that are new or learning; on the clips that the best policy has mastered, a KL
         to it. Ends when every clip is mastered or stuck.
stuck    A specialist for every clip that is not mastered, one after the other: training on that clip alone from the
         best policy. Ends when each has mastered its clip or makes no progress.
distil   The specialists and the best policy become one. No iterations. Then `lagging` again, or where it is too late
         for that, another specialist for every clip that is not mastered.
settle   All clips, with a step size that falls and a KL to the best policy.

Every phase starts from the best policy, which is the one with the highest mean tracking (survival-weighted), and has a
latest end in iterations. Everything here is plain values, so that a curriculum can be written as JSON.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from forgetmimic_jax.settings.config import Config, PretrainConfig

Phase = Literal["broad", "lagging", "stuck", "distil", "settle", "done"]
ClipState = Literal["new", "learning", "mastered", "stuck"]


@dataclass(frozen=True)
class Measured:
    """What an evaluation says of a clip."""

    success: float = 0.0
    tracking: float = 0.0  # survival-weighted
    steps: float = 1.0  # control steps of a mean episode


@dataclass(frozen=True)
class ClipProgress:
    """How far a clip has come in this phase."""

    last: Measured = Measured()
    record: float = 0.0  # the highest tracking
    stalled: int = 0  # evaluations since the record rose by `gain`
    completed: bool = False  # an evaluation's episode has completed it, in this phase or before

    def state(self, config: PretrainConfig) -> ClipState:
        """new: no episode has completed it; mastered; stuck: not mastered and no progress; learning: else."""
        if self.last.success >= config.mastered:
            return "mastered"
        if self.stalled >= config.patience:
            return "stuck"
        return "learning" if self.completed else "new"

    def after(self, config: PretrainConfig, found: Measured) -> ClipProgress:
        """With one more evaluation."""
        progress = found.tracking >= self.record + config.gain
        return ClipProgress(
            last=found,
            record=found.tracking if progress else self.record,
            stalled=0 if progress else self.stalled + 1,
            completed=self.completed or found.success > 0.0,
        )


@dataclass(frozen=True)
class Kept:
    """A policy that is kept, by the number of the evaluation that measured it."""

    number: int
    clips: dict[str, Measured]

    @property
    def tracking(self) -> float:
        """Mean tracking over the clips."""
        return sum(clip.tracking for clip in self.clips.values()) / len(self.clips)


@dataclass(frozen=True)
class Curriculum:
    """How far pretraining has come."""

    clips: dict[str, ClipProgress]
    phase: Phase = "broad"
    stage: int = 0  # counts the times that training started again from a kept policy
    evaluations: int = 0  # in this stage
    longest: int = 0  # evaluations that this specialist may have
    number: int = 0  # evaluations of the run
    record: float = 0.0  # highest mean tracking of this stage
    stalled: int = 0  # evaluations since it rose by `gain`
    specialists: tuple[str, ...] = ()  # clips that still need one; the first one's is being trained
    experts: dict[str, Kept] = field(default_factory=dict)  # by clip, specialists that track it better than the best
    best: Kept | None = None

    @property
    def specialist(self) -> str | None:
        """The clip that a specialist is trained on, if any."""
        return self.specialists[0] if self.phase == "stuck" else None

    def states(self, config: PretrainConfig) -> dict[str, ClipState]:
        """The state of every clip."""
        return {name: clip.state(config) for name, clip in self.clips.items()}

    def unmastered(self, config: PretrainConfig) -> list[str]:
        """The clips that the best policy has not mastered, the nearest to it first."""
        assert self.best is not None
        clips = self.best.clips
        missing = [name for name, clip in clips.items() if clip.success < config.mastered]
        return sorted(missing, key=lambda name: (-clips[name].success, -clips[name].tracking))


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
    best = kept if curriculum.best is None or kept.tracking > curriculum.best.tracking else curriculum.best
    progress = kept.tracking >= curriculum.record + rules.gain
    seen = dataclasses.replace(
        curriculum,
        clips={
            name: clip.after(rules, found[name]) if curriculum.specialist in (None, name) else clip
            for name, clip in curriculum.clips.items()
        },
        evaluations=curriculum.evaluations + 1,
        number=kept.number,
        record=kept.tracking if progress else curriculum.record,
        stalled=0 if progress else curriculum.stalled + 1,
        best=best,
    )
    match seen.phase:
        case "broad":
            ended = seen.stalled >= rules.patience or done >= rules.broad_until
            return _after_broad(config, seen, done) if ended else seen
        case "lagging":
            moving = any(state in ("new", "learning") for state in seen.states(rules).values())
            return seen if moving and done < rules.lagging_until else _after_lagging(config, seen, done)
        case "stuck":
            return _after_specialist(config, seen, kept, done)
        case "distil":
            return _after_broad(config, dataclasses.replace(seen, experts={}), done)
        case "settle":
            ended = seen.evaluations >= settle_evaluations(config) or done >= 1.0
            return dataclasses.replace(seen, phase="done") if ended else seen
    return seen


def _after_broad(config: Config, seen: Curriculum, done: float) -> Curriculum:
    """The clips that lag; where it is too late for that, specialists; where none lags, the end."""
    if seen.unmastered(config.pretrain) and done < config.pretrain.lagging_until:
        return _begin(seen, "lagging")
    return _after_lagging(config, seen, done)


def _after_lagging(config: Config, seen: Curriculum, done: float) -> Curriculum:
    """A specialist for every clip that is not mastered."""
    return _next_specialist(config, seen, tuple(seen.unmastered(config.pretrain)), done)


def _after_specialist(config: Config, seen: Curriculum, kept: Kept, done: float) -> Curriculum:
    """An expert is the specialist that tracks its clip best, and clearly better than the best policy."""
    rules, clip = config.pretrain, seen.specialists[0]
    assert seen.best is not None
    best = seen.best.clips
    if clip not in seen.experts or kept.clips[clip].tracking > seen.experts[clip].clips[clip].tracking:
        seen = dataclasses.replace(seen, experts={**seen.experts, clip: kept})
    experts = {
        name: expert
        for name, expert in seen.experts.items()
        if expert.clips[name].tracking >= best[name].tracking + rules.gain
    }
    seen = dataclasses.replace(seen, experts=experts)
    moving = seen.clips[clip].state(rules) in ("new", "learning") and seen.evaluations < seen.longest
    return seen if moving else _next_specialist(config, seen, seen.specialists[1:], done)


def _next_specialist(config: Config, seen: Curriculum, clips: tuple[str, ...], done: float) -> Curriculum:
    """The first of the clips, with its part of the time that is left; without clips or time, distillation."""
    evaluations = int((config.pretrain.stuck_until - done) * config.iterations / config.evaluate_every)
    if not clips or evaluations < 1:
        return _begin(seen, "distil" if seen.experts else "settle")
    longest = min(config.pretrain.specialist_evaluations, max(1, evaluations // len(clips)))
    return _begin(seen, "stuck", specialists=clips, longest=longest)


def _begin(seen: Curriculum, phase: Phase, specialists: tuple[str, ...] = (), longest: int = 0) -> Curriculum:
    """The best policy starts a phase, or a specialist; progress is counted from what it can do.

    A clip that waits for its specialist, or had it, stays as it was.
    """
    assert seen.best is not None
    best = seen.best.clips
    clips = {
        name: ClipProgress(best[name], best[name].tracking, 0, clip.completed or best[name].success > 0.0)
        if name in specialists[:1] or phase not in ("stuck", "distil")
        else clip
        for name, clip in seen.clips.items()
    }
    return dataclasses.replace(
        seen,
        clips=clips,
        phase=phase,
        stage=seen.stage + 1,
        evaluations=0,
        longest=longest,
        record=seen.best.tracking,
        stalled=0,
        specialists=specialists,
    )


def settings_of(config: Config, curriculum: Curriculum) -> Settings:
    """What the next iterations train on."""
    rules, best = config.pretrain, curriculum.best
    first = curriculum.phase == "broad"
    target_kl = config.ppo.target_kl if first else rules.target_kl
    best_kl = {name: 0.0 for name in curriculum.clips}
    if curriculum.phase == "lagging" and best is not None:
        best_kl = {name: rules.best_kl * (clip.success >= rules.mastered) for name, clip in best.clips.items()}
    if curriculum.phase == "settle":  # the KL of an iteration goes with the square of the step size, which falls evenly
        length = settle_evaluations(config)
        best_kl = dict.fromkeys(best_kl, rules.best_kl)
        target_kl *= (max(1, length - curriculum.evaluations) / length) ** 2
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


def settle_evaluations(config: Config) -> int:
    """Evaluations of the last phase."""
    return max(1, round((1.0 - config.pretrain.stuck_until) * config.iterations / config.evaluate_every))
