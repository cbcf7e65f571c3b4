"""The case: an unlearned policy with what it is compared with, and rollouts that several attacks use."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from forgetmimic_jax.attacks.document import CONTROL, Compared, Originals
from forgetmimic_jax.attacks.performance import Performance, by_clip, compare
from forgetmimic_jax.attacks.rollouts import Stage
from forgetmimic_jax.attacks.warping import distances
from forgetmimic_jax.evaluation.metrics import BASE, UNLEARNED, ZERO_ACTION
from forgetmimic_jax.evaluation.rollout import Acting
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.tracking.setup import Setup

TRAINED = (UNLEARNED, CONTROL, BASE)


@dataclass(frozen=True)
class Scale:
    """How much is simulated and trained."""

    episodes: int = 20  # of a clip
    target_episodes: int = 50  # of a target, on which most comparisons rest
    variant_episodes: int = 20  # of a near-duplicate of a target, and of a splice
    kept_variant_episodes: int = 4  # of a near-duplicate of a kept clip, of which there are many
    hosts: int = 2  # kept clips with which each target is spliced
    recovery_iterations: int = 100
    relearning_iterations: int = 200  # at most
    watch_every: int = 10  # iterations between two looks at a policy that relearns
    held_out_iterations: int = 40
    seeds: int = 1  # trainings of each kind


@dataclass(frozen=True)
class Case:
    """Policies that are attacked side by side.

    Args:
        setup: robot, clips and settings of the unlearned policy.
        clips: the library's at the control rate, in its order.
        targets: names of clips.
        policies: base, unlearned and control.
        scale: how much is simulated and trained.
        seed: of every start, noise and bootstrap.
    """

    setup: Setup
    clips: Mapping[str, Clip]
    targets: tuple[str, ...]
    policies: Mapping[str, Acting]
    scale: Scale
    seed: int = 0

    @property
    def everyone(self) -> dict[str, Acting | None]:
        """The policies and the zero action."""
        return {**self.policies, ZERO_ACTION: None}

    @property
    def against(self) -> dict[str, str]:
        """By policy, the one whose numbers are subtracted."""
        return {UNLEARNED: CONTROL} if CONTROL in self.policies else {}

    @property
    def kept(self) -> tuple[str, ...]:
        """Names of the clips that are no targets."""
        return tuple(name for name in self.clips if name not in self.targets)

    def chosen(self, names: tuple[str, ...]) -> list[Clip]:
        """Clips by name."""
        return [self.clips[name] for name in names]

    def stage(self, clips: list[Clip], episodes: int, *, from_start: bool = False) -> Stage:
        """Episodes of some clips."""
        return Stage(self.setup, clips, episodes=episodes, seed=self.seed, from_start=from_start)

    def compare(self, performance: Performance, clips: tuple[str, ...] | list[str]) -> Compared:
        """The numbers of every policy over the episodes of some clips."""
        return compare(performance, performance.of(clips), against=self.against, seed=self.seed)

    def by_clip(self, performance: Performance, clips: Sequence[str]) -> dict[str, Compared]:
        """The numbers of every policy, clip by clip."""
        return by_clip(performance, clips, against=self.against, seed=self.seed)

    @functools.cached_property
    def on_library(self) -> Performance:
        """Everyone on every clip."""
        return self.stage(list(self.clips.values()), self.scale.episodes).perform(self.everyone)

    @functools.cached_property
    def target_stage(self) -> Stage:
        """Many episodes of the targets."""
        return self.stage(self.chosen(self.targets), self.scale.target_episodes)

    @functools.cached_property
    def on_targets(self) -> Performance:
        """Everyone there."""
        return self.target_stage.perform(self.everyone)

    @functools.cached_property
    def nearest(self) -> dict[str, list[str]]:
        """By target, the kept clips by their segment that looks most like it, the nearest first."""
        order = {}
        for target in self.targets:
            found = distances(self.chosen(self.kept), [self.clips[target]])
            of_clip = {name: min(far for of, far in found.items() if of.clip == name) for name in self.kept}
            order[target] = sorted(of_clip, key=lambda name: of_clip[name])
        return order


def originals(case: Case) -> Originals:
    """The clips as they are."""
    return Originals(targets=case.by_clip(case.on_targets, case.targets), kept=case.by_clip(case.on_library, case.kept))
