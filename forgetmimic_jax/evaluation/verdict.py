"""What an evaluation allows to say of an unlearned policy, in one of four phrases. Each has a rule, and no other word.

The rules read intervals, not means: what a few episodes cannot tell apart is inconclusive.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from forgetmimic_jax.evaluation.metrics import UNLEARNED
from forgetmimic_jax.evaluation.relearning import Lasted
from forgetmimic_jax.evaluation.tables import FORGOTTEN, KEPT, percent

CONSISTENT, RECOVERABLE = "consistent with retraining", "suppressed but recoverable"
INCONCLUSIVE, FAILED = "inconclusive", "failed"
ALIKE = 0.1  # of the tracking reward, which is at most 1: closer than this, two policies do the same on the targets
FASTER = 0.5  # relearning within this share of the control's target transitions means that something was left


def _bound(share: float) -> str:
    return percent({"mean": share})


RULES = {
    CONSISTENT: (
        f"The targets' skill left is at most {_bound(FORGOTTEN)} and the kept clips' at least {_bound(KEPT)}, both "
        f"with their whole 95 % intervals; on the targets the unlearned policy's tracking is within {ALIKE:g} of the "
        f"control's, whichever ends of their intervals are taken; and to relearn the targets to 80 % of the base, the "
        f"unlearned policy needs at least {_bound(FASTER)} of the target transitions that the control needs, with "
        f"every seed. The control has never lived a target: it was retrained without them, or learned the kept clips "
        f"from the base."
    ),
    RECOVERABLE: (
        f"Forgotten and kept as above, but with every seed the unlearned policy relearns the targets with less than "
        f"{_bound(FASTER)} of the target transitions that the control of that seed needs, or lives until its end."
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
    relearning: Mapping[str, tuple[Lasted, Lasted]] | None = None,
) -> Verdict:
    """The verdict on the policy `unlearned` of an evaluation.

    Args:
        policies: the `policies` of its evaluation.json, with base, unlearned and zero_action.
        control: the entry of a policy that never lived the targets, retrained or distilled, on the same episodes.
        relearning: by seed, how long the unlearned policy and the control took until 80 % of the base's tracking on the
            targets.
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
    sooner = [_sooner(*pair) for pair in relearning.values()] if relearning else [None]
    if relearning and all(sooner):
        found.append(f"It comes back sooner than it can be learned: {_transitions(relearning)}.")
        return Verdict(RECOVERABLE, tuple(found))
    missing = []
    if control is None:
        missing.append("It was not compared with a policy that never lived the targets.")
    elif _furthest(unlearned["target"], control["target"]) > ALIKE:
        missing.append(f"On the targets its tracking may lie further than {ALIKE:g} from the control's.")
    if not relearning:
        missing.append("How fast it relearns the targets was not measured.")
    elif any(sooner):
        missing.append(f"With some seeds it comes back sooner than it can be learned: {_transitions(relearning)}.")
    elif None in sooner:
        missing.append(f"Relearning was not seen to its end: {_transitions(relearning)}.")
    if missing:
        return Verdict(INCONCLUSIVE, (*found, *missing))
    assert relearning is not None
    found.append(f"On the targets its tracking is within {ALIKE:g} of the control's.")
    return Verdict(CONSISTENT, (*found, f"It relearns them no sooner: {_transitions(relearning)}."))


def _sooner(unlearned: Lasted, control: Lasted) -> bool | None:
    """Whether the unlearned policy was faster; None where a run ended before that could be told."""
    if unlearned.target_steps < FASTER * control.target_steps:
        return True if unlearned.there else None
    return False if control.there else None


def _furthest(one: Mapping[str, Any], other: Mapping[str, Any]) -> float:
    a, b = one["survival_weighted_tracking"], other["survival_weighted_tracking"]
    return max(a["high"] - b["low"], b["high"] - a["low"])


def _transitions(relearning: Mapping[str, tuple[Lasted, Lasted]]) -> str:
    def told(run: Lasted) -> str:
        return f"{'' if run.there else 'more than '}{run.target_steps:,.0f}"

    seeds = "; ".join(f"{told(unlearned)} against {told(control)}" for unlearned, control in relearning.values())
    return f"unlearned against control, seed by seed, {seeds} target transitions"
