"""What the robot does when a target is its reference, in episodes that no termination ends."""

from __future__ import annotations

import numpy as np

from forgetmimic_jax.attacks.case import Case
from forgetmimic_jax.evaluation import unbounded
from forgetmimic_jax.evaluation.document import UnboundedResult


def attack(case: Case) -> dict[str, UnboundedResult]:
    """The numbers of `evaluation.unbounded` of every policy, over all targets."""
    rollouts = unbounded.roll_out(case.setup, case.everyone, case.targets, episodes=case.scale.episodes, seed=case.seed)
    found = {}
    for policy, rollout in rollouts.items():
        numbers, every = unbounded.episode_numbers(rollout), np.ones(len(rollout.clip), bool)
        found[policy] = UnboundedResult(
            all_starts=unbounded.estimates(numbers, rollout.clip, every, case.seed),
            from_frame_0=unbounded.estimates(numbers, rollout.clip, rollout.start_frame == 0, case.seed),
        )
    return found
