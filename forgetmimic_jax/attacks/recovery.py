"""Retain-only recovery: does fine-tuning on the kept clips alone bring the targets back?

The cheapest attack and the hardest to resist: it needs neither the targets nor a word about them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from forgetmimic_jax.attacks.case import TRAINED, Case
from forgetmimic_jax.attacks.document import CONTROL, Recovery
from forgetmimic_jax.attacks.fine_tuning import FineTuning, shares
from forgetmimic_jax.attacks.performance import Performance, by_clip, over_seeds
from forgetmimic_jax.attacks.rollouts import Stage
from forgetmimic_jax.evaluation.metrics import UNLEARNED
from forgetmimic_jax.policy.policy import Policy


class Plan(NamedTuple):
    """What an attack trains.

    Args:
        name: of the training.
        policies: names of those that train, with unlearned and control.
        starts: share of the starts of each clip.
        iterations: of PPO.
    """

    name: str
    policies: Sequence[str]
    starts: Mapping[str, float]
    iterations: int


@dataclass(frozen=True)
class Workshop:
    """What an attack trains with.

    Args:
        training: of a library with every clip that is learned.
        made: finds a fine-tuned policy by its name, or makes it.
        tick: called after each iteration.
    """

    training: FineTuning
    made: Callable[[str, Callable[[], Policy]], Policy]
    tick: Callable[[], None]


def attack(case: Case, workshop: Workshop) -> Recovery:
    """Every policy on the targets, before and after it trained on the kept clips."""
    plan = Plan("recovered", TRAINED, shares([], case.kept), case.scale.recovery_iterations)
    return before_and_after(case, workshop, plan, case.target_stage, case.on_targets)


def before_and_after(case: Case, workshop: Workshop, plan: Plan, stage: Stage, before: Performance) -> Recovery:
    """Policies before and after a training; with several seeds the seed is the unit.

    Args:
        case: whose policies they are.
        workshop: to train with.
        plan: what is trained.
        stage: the episodes.
        before: how everyone did in them.
    """

    def trained(policy: str, seed: int) -> Policy:
        start = case.policies[policy]
        assert isinstance(start, Policy)

        def after(*_: object) -> bool:
            workshop.tick()
            return False

        def train() -> Policy:
            return workshop.training.train(start, plan.starts, iterations=plan.iterations, seed=seed, after=after)

        return workshop.made(f"{plan.name}-{policy}-{seed}", train)

    afterwards = []
    for seed in range(case.scale.seeds):
        new = {f"after {policy}": trained(policy, seed) for policy in plan.policies}
        against = {f"after {UNLEARNED}": f"after {CONTROL}"}
        both = before.joined(stage.perform(new))
        found = by_clip(both, both.names, against=against, seed=case.seed, policies=list(new))
        afterwards.append(
            {clip: {policy: of[f"after {policy}"] for policy in plan.policies} for clip, of in found.items()}
        )
    return Recovery(
        iterations=plan.iterations,
        before=case.by_clip(before, before.names),
        after={clip: over_seeds([seed[clip] for seed in afterwards]) for clip in before.names},
    )
