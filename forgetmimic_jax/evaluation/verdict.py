"""What an evaluation allows to say of an unlearned policy, in one of four phrases. Each has a rule, and no other word.

The rules read intervals, not means: what a few episodes cannot tell apart is inconclusive.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from forgetmimic_jax.evaluation.metrics import UNLEARNED
from forgetmimic_jax.evaluation.tables import FORGOTTEN, KEPT, percent

CONSISTENT, RECOVERABLE = "consistent with retraining", "suppressed but recoverable"
INCONCLUSIVE, FAILED = "inconclusive", "failed"
FASTER = 0.5  # relearning within this share of the control's target transitions means that something was left


def _bound(share: float) -> str:
    return percent({"mean": share})


RULES = {
    CONSISTENT: (
        f"The targets' skill left is at most {_bound(FORGOTTEN)} and the kept clips' at least {_bound(KEPT)}, both "
        f"with their whole 95 % intervals; on the targets the intervals of tracking of the unlearned policy and of the "
        f"control overlap; and to relearn the targets to 80 % of the base, the unlearned policy needs at least "
        f"{_bound(FASTER)} of the target transitions that the control needs. The control has never lived a target: it "
        f"was retrained without them, or learned the kept clips from the base."
    ),
    RECOVERABLE: (
        f"Forgotten and kept as above, but the unlearned policy relearns the targets with less than {_bound(FASTER)} "
        f"of the target transitions that the control needs, or is the only one of the two that does."
    ),
    INCONCLUSIVE: "None of the other rules holds: an interval spans a bound, or a comparison was not made.",
    FAILED: (
        f"The whole 95 % interval of the targets' skill left lies above {_bound(FORGOTTEN)}, or that of the kept "
        f"clips' below {_bound(KEPT)}."
    ),
}


@dataclass(frozen=True)
class Verdict:
    """One of the four phrases, and why."""

    word: str
    reasons: tuple[str, ...]


def judge(
    policies: Mapping[str, Any],
    *,
    control: Mapping[str, Any] | None = None,
    relearning: Mapping[str, float | None] | None = None,
) -> Verdict:
    """The verdict on the policy `unlearned` of an evaluation.

    Args:
        policies: the `policies` of its evaluation.json, with base, unlearned and zero_action.
        control: the entry of a policy that never lived the targets, retrained or distilled, on the same episodes.
        relearning: target transitions until 80 % of the base's tracking on the targets is regained, for `unlearned` and
            `control`; None where that was not reached.
    """
    unlearned = policies[UNLEARNED]
    left = {group: unlearned[group].get("skill", {}) for group in ("target", "kept")}
    for group, skill in left.items():
        if not {"mean", "low", "high"} <= skill.keys():
            what = {"target": "targets", "kept": "kept clips"}[group]
            return Verdict(
                INCONCLUSIVE,
                (f"The base itself is hardly better on the {what} than no policy, or too few episodes were measured.",),
            )
    target, kept = left["target"], left["kept"]
    failures = []
    if target["low"] > FORGOTTEN:
        failures.append(f"The targets are still known: {percent(target)} of the skill is left.")
    if kept["high"] < KEPT:
        failures.append(f"The kept clips were lost: {percent(kept)} of the skill is left.")
    if failures:
        return Verdict(FAILED, tuple(failures))
    doubts = []
    if target["high"] > FORGOTTEN:
        doubts.append(f"Whether the targets are forgotten is not sure: {percent(target)} of the skill is left.")
    if kept["low"] < KEPT:
        doubts.append(f"Whether the kept clips are kept is not sure: {percent(kept)} of the skill is left.")
    if doubts:
        return Verdict(INCONCLUSIVE, tuple(doubts))
    found = [
        f"On these episodes the targets are forgotten ({percent(target)} of the skill left) and the other clips kept "
        f"({percent(kept)})."
    ]
    if relearning is not None and _faster(relearning):
        found.append(f"It comes back sooner than it can be learned: {_transitions(relearning)}.")
        return Verdict(RECOVERABLE, tuple(found))
    missing = []
    if control is None:
        missing.append("It was not compared with a policy that never lived the targets.")
    elif not _overlap(unlearned["target"], control["target"]):
        missing.append("On the targets it tracks otherwise than the control: their intervals do not overlap.")
    if relearning is None:
        missing.append("How fast it relearns the targets was not measured.")
    elif None in relearning.values():
        missing.append(f"Relearning was not seen to its end: {_transitions(relearning)}.")
    if missing:
        return Verdict(INCONCLUSIVE, (*found, *missing))
    assert relearning is not None
    found.append("On the targets its tracking cannot be told from the control's.")
    return Verdict(CONSISTENT, (*found, f"It relearns them no sooner: {_transitions(relearning)}."))


def _faster(relearning: Mapping[str, float | None]) -> bool:
    unlearned, control = relearning["unlearned"], relearning["control"]
    if unlearned is None:
        return False
    return control is None or unlearned < FASTER * control


def _overlap(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    a, b = one["survival_weighted_tracking"], other["survival_weighted_tracking"]
    return a["low"] <= b["high"] and b["low"] <= a["high"]


def _transitions(relearning: Mapping[str, float | None]) -> str:
    said = {who: "never" if count is None else f"after {count:,.0f}" for who, count in relearning.items()}
    return f"unlearned {said['unlearned']}, control {said['control']} target transitions"
