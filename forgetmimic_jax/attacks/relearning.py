"""Relearning: how many target steps until the unlearned policy, and one that never knew them, does the targets?"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import msgspec
import numpy as np

from forgetmimic_jax.attacks.case import Case
from forgetmimic_jax.attacks.document import CONTROL, Curve, Relearning
from forgetmimic_jax.attacks.fine_tuning import shares
from forgetmimic_jax.attacks.pace import FASTER
from forgetmimic_jax.attacks.recovery import Workshop
from forgetmimic_jax.evaluation.metrics import BASE, UNLEARNED
from forgetmimic_jax.evaluation.relearning import DECISIVE, LEVELS, crossing
from forgetmimic_jax.policy.policy import Policy

FoundOrMade = Callable[[str, Callable[[], Curve]], Curve]  # a curve by name, made where it is not there yet


def attack(case: Case, workshop: Workshop, part: FoundOrMade, *, to_the_end: bool) -> Relearning:
    """The curves of the unlearned policy and of the control, with half of the starts on the targets.

    A training ends at the last level, or unless `to_the_end` once the decisive level is settled.

    Args:
        case: the policies.
        workshop: to train with.
        part: finds a curve that was made before, or makes it.
        to_the_end: until the last level, or the last iteration.
    """
    goal = _tracked(case.on_targets.tracked(BASE))
    starts: dict[str, dict[str, Curve]] = {UNLEARNED: {}, CONTROL: {}}
    for seed in range(case.scale.seeds):
        steps_to_beat = np.inf
        for name, curves in starts.items():

            def make(name: str = name, seed: int = seed, steps_to_beat: float = steps_to_beat) -> Curve:
                return _curve(case, workshop, name, seed, goal, None if to_the_end else steps_to_beat)

            curves[str(seed)] = curve = part(f"relearning-{name}-{seed}", make)
            found = crossing(as_mapping(curve), DECISIVE * goal)
            steps_to_beat = np.inf if found is None else found[1] / FASTER
    return Relearning(base={str(seed): goal for seed in range(case.scale.seeds)}, starts=starts)


def settled(curve: Curve, goal: float, steps_to_beat: float | None) -> bool:
    """Whether a training may end.

    Args:
        curve: so far.
        goal: the base's tracking.
        steps_to_beat: target steps after which it is certain that the other policy was faster; None: only the last
            level ends a training.
    """
    if crossing(as_mapping(curve), LEVELS[-1] * goal):
        return True
    if steps_to_beat is None:
        return False
    return crossing(as_mapping(curve), DECISIVE * goal) is not None or curve.target_steps[-1] > steps_to_beat


def as_mapping(curve: Curve) -> Mapping[str, list[float]]:
    """The curve as `evaluation.relearning` reads it."""
    content: Mapping[str, list[float]] = msgspec.to_builtins(curve)
    return content


def _curve(case: Case, workshop: Workshop, name: str, seed: int, goal: float, steps_to_beat: float | None) -> Curve:
    """One policy's tracking on the targets while it learns them."""
    start, total = case.policies[name], case.scale.relearning_iterations
    assert isinstance(start, Policy)
    curve = Curve([0.0], [_tracked(case.on_targets.tracked(name))], [0.0])
    steps = 0.0

    def after(done: int, policy: Policy, simulated: Mapping[str, float]) -> bool:
        nonlocal steps
        workshop.tick()
        steps += sum(simulated[target] for target in case.targets)
        if done % case.scale.watch_every and done < total:
            return False
        seen = case.target_stage.perform({name: policy})
        curve.iterations.append(float(done))
        curve.tracking.append(_tracked(seen.tracked(name)))
        curve.target_steps.append(steps)
        return settled(curve, goal, steps_to_beat)

    starts = shares(case.targets, case.kept)
    workshop.training.train(start, starts, iterations=total, seed=seed, after=after)
    return curve


def _tracked(tracking: np.ndarray) -> float:
    return float(tracking.mean())
