"""When a policy has learned the targets again: the one rule of the relearning study, the claims and the evidence."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

LEVELS = (0.5, 0.8, 0.95)  # of the base's tracking on the targets
DECISIVE = 0.8  # the level that verdicts and claims compare


class Lasted(NamedTuple):
    """How long a run took to a level, or to its end where it never reached the level."""

    iterations: float
    target_steps: float
    there: bool


def crossing(curve: Mapping[str, list[float]], level: float) -> tuple[float, float] | None:
    """Iterations and target steps at the first of two evaluations in a row that are not below `level`."""
    above = [tracking >= level for tracking in curve["tracking"]]
    for iteration, steps, now, then in zip(curve["iterations"], curve["target_steps"], above, above[1:], strict=False):
        if now and then:
            return iteration, steps
    return None


def lasted(results: Mapping[str, Any], start: str, share: float) -> dict[str, Lasted]:
    """By repeat: how long until a start reached a share of the base's tracking on the same episodes.

    A run that never reached it counts with its end, and needs longer than that.

    Args:
        results: of the study's JSON.
        start: unlearned, distilled, retrained or fresh.
        share: of the base's survival-weighted tracking on the targets.
    """
    result = {}
    for repeat, curve in results["starts"][start].items():
        found = crossing(curve, share * results["base"][repeat])
        iterations, steps = found or (curve["iterations"][-1], curve["target_steps"][-1])
        result[repeat] = Lasted(iterations, steps, found is not None)
    return result


def at_first(results: Mapping[str, Any], start: str) -> dict[str, float]:
    """By repeat: tracking of a start on the targets before it relearns, as a share of the base's.

    Repeats whose start was not evaluated are absent, as those of a fresh policy.
    """
    curves = results["starts"][start]
    before = {repeat: curve["tracking"][0] for repeat, curve in curves.items() if curve["iterations"][0] == 0}
    return {repeat: tracking / results["base"][repeat] for repeat, tracking in before.items()}
