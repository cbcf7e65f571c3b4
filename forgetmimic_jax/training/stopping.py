"""The stop rule of unlearning: a run ends when the targets' skill is at the zero-action baseline.

Every `unlearn.stop_every` iterations the targets are evaluated on a few episodes. From the second evaluation in a row
whose skill is at the baseline the run settles: over SETTLE iterations the step size falls to 0 and the KL to the base
holds the kept clips more strongly. Then it ends. More training would push the targets below the baseline, which is
over-unlearning (Shi et al. 2024, "MUSE"). What the rule has seen is in every checkpoint, so a run that is resumed ends
where it would have.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from rich.console import Console

from forgetmimic_jax.basics.console import say
from forgetmimic_jax.evaluation import metrics
from forgetmimic_jax.evaluation.rollout import Evaluator
from forgetmimic_jax.evaluation.skill import mean_retained
from forgetmimic_jax.motion.library import only_clips
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.tracking.env import Environment, make_assets
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.training.checkpoint import CheckpointInfo
from forgetmimic_jax.training.course import Plain, Position
from forgetmimic_jax.training.devices import agreed

AT_BASELINE = 0.1  # skill up to which the targets are at the zero-action baseline
IN_A_ROW = 2
SETTLE = 100  # iterations
KEEP = 6.0  # factor on the weight of the KL to the base while a run settles, so that the kept clips recover
EPISODES = 10  # a target clip


def settles_from(skills: Sequence[tuple[int, float]]) -> int | None:
    """The iteration after which a run settles: that of the second skill in a row at the baseline; None before.

    Args:
        skills: iteration and skill of the targets, one evaluation after the other.
    """
    in_a_row = 0
    for iteration, skill in skills:
        in_a_row = in_a_row + 1 if skill <= AT_BASELINE else 0
        if in_a_row == IN_A_ROW:
            return iteration
    return None


def retained(policy: np.ndarray, base: np.ndarray, zero_action: np.ndarray) -> float:
    """Skill that is left, as a mean over the target clips; a negative skill counts as 0, so it pays for no other clip.

    NaN where the base is hardly better than the zero action on every clip.

    Args:
        policy, base, zero_action: f[clip] survival-weighted tracking.
    """
    defined = base - zero_action >= metrics.MINIMUM_SKILL_RANGE
    skill = metrics.skill(policy[defined], base[defined], zero_action[defined])
    return mean_retained(skill.tolist()) if defined.any() else float("nan")


class Targets:
    """The targets' skill on a few episodes, the same each time; base and zero action are rolled out once."""

    def __init__(self, setup: Setup):
        config = setup.config
        library = only_clips(setup.library, config.unlearn.targets)
        self._evaluator = Evaluator(dataclasses.replace(setup, library=library), episodes=EPISODES, seed=config.seed)
        self._base, self._zero = self._tracking(setup.base), self._tracking(None)

    def skill(self, policy: Policy) -> float:
        """See `retained`."""
        return retained(self._tracking(policy), self._base, self._zero)

    def _tracking(self, policy: Policy | None) -> np.ndarray:
        """Mean survival-weighted tracking f[clip]."""
        rollout = self._evaluator.rollout(policy)
        tracked = metrics.episode_metrics(rollout)["survival_weighted_tracking"]
        return np.array([tracked[rollout.clip == clip].mean() for clip in np.unique(rollout.clip)])


class Stopping(Plain):
    """Plain training that ends by the stop rule, at the run's last iteration at the latest."""

    def __init__(
        self, setup: Setup, env: Environment, directory: Path, console: Console, resumed: CheckpointInfo | None
    ):
        super().__init__(setup, env, directory, console, resumed)
        self._skills: list[tuple[int, float]] = []
        if resumed is not None and resumed.curriculum is not None:
            self._skills = [(int(iteration), float(skill)) for iteration, skill in resumed.curriculum["skills"]]
        self._targets: Targets | None = None
        self._base_kl = make_assets(setup).focus.base_kl
        self._iteration = 0

    @property
    def finished(self) -> bool:
        start = settles_from(self._skills)
        return start is not None and self._iteration >= start + SETTLE

    @property
    def curriculum(self) -> Mapping[str, Any]:
        return {"skills": self._skills}

    @property
    def note(self) -> Mapping[str, Any]:
        return {"target_skill": self._skills[-1][1]} if self._skills else {}

    def begin(self, position: Position) -> Position:
        return self._settling(super().begin(position))

    def after(self, position: Position) -> Position:
        position, settling = super().after(position), settles_from(self._skills) is not None
        if not settling and position.iteration % self._setup.config.unlearn.stop_every == 0:
            self._targets = self._targets or Targets(self._setup)
            self._skills.append((position.iteration, agreed(self._targets.skill(position.state.policy))))
            if settles_from(self._skills) is not None:
                say(
                    f"iteration {position.iteration}: the targets' skill is at the zero-action baseline "
                    f"({self._skills[-1][1]:.0%}); {SETTLE} more iterations with a falling step size",
                    self._console,
                )
        return self._settling(position)

    def _settling(self, position: Position) -> Position:
        """With the share of the step size and the KL to the base that the next iteration takes."""
        self._iteration, start = position.iteration, settles_from(self._skills)
        share = 1.0 if start is None else 1.0 - (position.iteration - start) / SETTLE
        base_kl = self._base_kl if self._base_kl is None or start is None else KEEP * self._base_kl
        focus = dataclasses.replace(position.assets.focus, settle=jnp.float32(share), base_kl=base_kl)
        return dataclasses.replace(position, assets=dataclasses.replace(position.assets, focus=focus))
