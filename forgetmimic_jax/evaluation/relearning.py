"""When a policy has learned the targets again: the one rule of the relearning study, the claims and the report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple


class Lasted(NamedTuple):
    """How long a run took until a level, or until its end where it never got there."""

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


def crossings(results: Mapping[str, Any], start: str, share: float) -> list[tuple[float, float] | None]:
    """Of every seed of a start: when it was back at a share of the base's tracking on the same episodes.

    Args:
        results: of the study's JSON.
        start: unlearned, distilled, retrained or fresh.
        share: of the base's survival-weighted tracking on the targets.
    """
    return [crossing(curve, share * results["base"][seed]) for seed, curve in results["starts"][start].items()]


def lasted(results: Mapping[str, Any], start: str, share: float) -> dict[str, Lasted]:
    """By seed: when it crossed, as `crossings`; a run that never did counts with its end, which is too early."""
    result = {}
    runs = results["starts"][start].items()
    for (seed, curve), found in zip(runs, crossings(results, start, share), strict=True):
        iterations, steps = found or (curve["iterations"][-1], curve["target_steps"][-1])
        result[seed] = Lasted(iterations, steps, found is not None)
    return result
