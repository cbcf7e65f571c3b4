"""Variants of an unlearning run over their repeats: from their evaluation.json to one table and one figure.

`results["variants"]` of a study: {label: {"options", "trials": {repeat: name}, "runs": {repeat: summary}}}.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.evaluation.document import FILE, Estimate, GroupResult, UnboundedNumbers, read_evaluation
from forgetmimic_jax.evaluation.metrics import BASE, COMMON, LOWEST_CONTENT, ZERO_ACTION
from forgetmimic_jax.evaluation.plots import bars, new_figure
from forgetmimic_jax.evaluation.repeats import (
    difference_over_repeats,
    over_repeats,
    rate_over_repeats,
    units,
)
from forgetmimic_jax.evaluation.statistics import PlainEstimate
from forgetmimic_jax.evaluation.tables import markdown_table, number, percent

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRACKING = "survival_weighted_tracking"
DEVIATION = f"max_key_body_position_error{COMMON}"  # m
METRICS = ("success_rate", TRACKING, "tracking_reward", "episode_length", "skill", "retention", DEVIATION)
UNBOUNDED = ("upright_rate", "impact_rate", "motion_content")  # of targets, in episodes that no termination ends
EPISODES = "episodes"  # of the group, behind its rates
RATES = (
    "success_rate",
    "upright_rate",
    "impact_rate",
    "tpr_at_5_percent_fpr",
    "marked_at_5_percent_fpr",
)  # shares of episodes
DEGRADATION = ("degradation_ratio", "survival_weighted_degradation_ratio")

HEADER = ("n", "success", "tracking", "while alive", "steps", "skill retained")
UNBOUNDED_HEADER = ("upright", "impact", "content")
NOTES = (
    "tracking: mean tracking reward over the horizon, 0 after a fall (survival-weighted); while alive: the paper's "
    "mean, over the steps before the fall.",
    "base and zero action: on the episodes of every run. Zero action is the robot with zero actions, "
    "the baseline of a policy that does nothing.",
    "skill retained: share of the base's tracking above the zero-action baseline; ratio: target over kept, of tracking "
    "while alive (the paper's) and of tracking.",
    "upright, impact, content: of episodes that no termination ends, to the clip's end and 3 s longer, with "
    "self-collision. Upright: share of episodes without a fall; impact: share with a force of the floor above one body "
    "weight on a body that is no foot; content: share of the clip's own movement that is reproduced, 0 for a robot "
    "that stands. An empty cell: not measured.",
)
THEIRS = "Rows of the paper: another library of clips, another base and another budget."


def summary(folder: Path) -> dict[str, Any]:
    """The means of a finished trial's evaluation.

    {"base", "policy", "zero_action": {"target": {metric: mean}, "kept": {...}, "clips": {clip: tracking}, ratio: mean}}
    with `lambda_crit`, the threshold on target steps in the first iteration, whose steps are the base's own, and
    `target_step_share`, the share of all training steps that were on targets.
    """
    result: dict[str, Any] = {}
    for name, policy in read_evaluation(folder / FILE).policies.items():
        groups = {"target": policy.target, "kept": policy.kept}
        result[name if name in (BASE, ZERO_ACTION) else "policy"] = {
            **{group: _numbers(numbers) for group, numbers in groups.items() if numbers},
            "clips": {clip: numbers.survival_weighted_tracking.mean for clip, numbers in policy.clips.items()},
            **_means({ratio: getattr(policy, ratio) for ratio in DEGRADATION}),
        }
    rows = read_rows(folder / "metrics.jsonl")
    if rows and "target/lambda_crit" in rows[0]:
        result["lambda_crit"] = rows[0]["target/lambda_crit"]
    if rows and "target/step_share" in rows[0]:
        steps = np.diff([0, *(row["environment_steps"] for row in rows)])
        result["target_step_share"] = float(np.average([row["target/step_share"] for row in rows], weights=steps))
    return result


def estimates(variant: Mapping[str, Any]) -> dict[str, Any]:
    """A variant's `summary` with an estimate over its repeats in the place of each number."""
    return estimates_of(variant["runs"])


def gained(variants: Mapping[str, Any], label: str, other: str | None, group: str, metric: str) -> dict[str, float]:
    """By repeat: a variant's number minus another's; see `paired`."""
    return {repeat: mine - theirs for repeat, (mine, theirs) in paired(variants, label, other, group, metric).items()}


def paired(
    variants: Mapping[str, Any], label: str, other: str | None, group: str, metric: str
) -> dict[str, tuple[float, float]]:
    """By repeat: a variant's number and another's of the same repeat, or the base's; of the repeats that have both.

    Args:
        variants: of a study's results.
        label: of the variant.
        other: of what it is compared with; None is the base.
        group: target or kept.
        metric: of the group.
    """
    if label not in variants or (other and other not in variants):
        return {}
    mine = {repeat: run["policy"][group][metric] for repeat, run in variants[label]["runs"].items()}
    if other:
        theirs = {repeat: run["policy"][group][metric] for repeat, run in variants[other]["runs"].items()}
    else:
        theirs = {repeat: run["base"][group][metric] for repeat, run in variants[label]["runs"].items()}
    return {repeat: (mine[repeat], theirs[repeat]) for repeat in mine if repeat in theirs}


def mean_gained(
    variants: Mapping[str, Any], label: str, other: str | None, group: str, metric: str
) -> PlainEstimate | None:
    """A variant's number minus another's of the same repeat, or minus the base's; None where none has both."""
    pairs = paired(variants, label, other, group, metric)
    return difference(variants[label]["runs"], pairs, group, metric) if pairs else None


def difference(
    runs: Mapping[str, Any], pairs: Mapping[str, tuple[float, float]], group: str, metric: str
) -> PlainEstimate:
    """The mean difference of the pairs of a metric, by repeat; for RATES over the episodes of the runs' group."""
    if metric not in RATES:
        return over_repeats({repeat: one - other for repeat, (one, other) in pairs.items()})
    counted = {repeat: run["policy"][group] for repeat, run in runs.items()}
    episodes = {repeat: of[EPISODES] for repeat, of in counted.items() if EPISODES in of}
    return difference_over_repeats(pairs, episodes)


def _numbers(group: GroupResult) -> dict[str, float]:
    unbounded = group.unbounded.all_starts if group.unbounded else UnboundedNumbers()
    found = {name: group.metric(name) for name in METRICS} | {name: getattr(unbounded, name) for name in UNBOUNDED}
    return {**_means(found), EPISODES: group.success_rate.n}


def _means(numbers: Mapping[str, Estimate | None]) -> dict[str, float]:
    return {name: of.mean for name, of in numbers.items() if of is not None and of.mean is not None}


def estimates_of(runs: Mapping[str, Any]) -> Any:
    """Nested numbers, one tree a repeat, as one tree of estimates; a number that only some runs have is over those.

    A number of RATES beside a number of episodes is a rate over so many.
    """
    if not isinstance(next(iter(runs.values())), Mapping):
        return over_repeats(runs)
    names = dict.fromkeys(name for run in runs.values() for name in run)
    by_name = {name: {repeat: run[name] for repeat, run in runs.items() if name in run} for name in names}
    episodes = by_name.get(EPISODES, {})
    return {
        name: rate_over_repeats(of, episodes) if name in RATES else estimates_of(of) for name, of in by_name.items()
    }


def variant_table(variants: Mapping[str, Any], theirs: Mapping[str, Any]) -> str:
    """Targets, then kept clips: base, zero action and every variant, and the paper's own numbers.

    Where variants have targets of their own, each has its own base beside it.
    """
    targets = {variant["options"].get("targets") for variant in variants.values()}
    policies: dict[str, Any] = {}
    for place, (label, variant) in enumerate(variants.items()):
        of = estimates(variant)
        if len(targets) > 1 or place == 0:
            whose = f" ({label})" if len(targets) > 1 else ""
            policies |= {f"{name.replace('_', ' ')}{whose}": of[name] for name in (BASE, ZERO_ACTION)}
        policies[label] = of["policy"]
    policies |= {f"*paper: {label}*": _exact(numbers) for label, numbers in theirs.items()}
    target = [
        [label, *_cells(policy.get("target", {})), *_unbounded_cells(policy.get("target", {}))]
        for label, policy in policies.items()
    ]
    kept = [
        [
            label,
            *_cells(policy.get("kept", {})),
            *(number(within(policy.get(ratio), 0.0, np.inf), 2) for ratio in DEGRADATION),
        ]
        for label, policy in policies.items()
    ]
    tables = [
        f"**Targets**\n\n{markdown_table(['', *HEADER, *UNBOUNDED_HEADER], target)}",
        f"**Kept clips**\n\n{markdown_table(['', *HEADER, 'ratio while alive', 'ratio of tracking'], kept)}",
    ]
    notes = [*NOTES, THEIRS] if theirs else NOTES
    return "\n".join([*tables, *(f"- {note}" for note in notes), ""])


def _cells(group: Mapping[str, Any]) -> list[str]:
    success, tracking, alive = (within(group.get(metric), 0.0, 1.0) for metric in METRICS[:3])
    n = next((units(estimate) for estimate in group.values() if estimate["n"]), "")
    steps = number(within(group.get("episode_length"), 0.0, np.inf), 0)
    return [n, percent(success), number(tracking, 2), number(alive, 2), steps, percent(group.get("skill"))]


def _unbounded_cells(group: Mapping[str, Any]) -> list[str]:
    upright, impact, content = (group.get(name) for name in UNBOUNDED)
    rates = [percent(within(rate, 0.0, 1.0)) for rate in (upright, impact)]
    return [*rates, number(within(content, LOWEST_CONTENT, 1.0), 2)]


def within(estimate: Mapping[str, Any] | None, low: float, high: float) -> Any:
    """An estimate whose interval does not leave what the number can be."""
    if estimate is None or "low" not in estimate:
        return estimate
    return {**estimate, "low": max(low, estimate["low"]), "high": min(high, estimate["high"])}


def _exact(numbers: Any) -> Any:
    """Numbers of the paper, which has no interval for them, as estimates."""
    if isinstance(numbers, Mapping):
        return {name: _exact(value) for name, value in numbers.items()}
    return {"mean": numbers, "n": 0}


def variant_bars(variants: Mapping[str, Any]) -> Figure:
    """Success, tracking, tracking while alive and steps of targets and kept clips, base and variants."""
    over = {label: estimates(variant) for label, variant in variants.items()}
    policies = {"base": next(iter(over.values()))[BASE]} | {label: of["policy"] for label, of in over.items()}
    figure = new_figure(width=2.0 + 0.8 * len(policies), height=9.0)
    for place, metric in enumerate(METRICS[:4]):
        axes = figure.add_subplot(4, 1, place + 1)
        of = {group: [policy.get(group, {}) for policy in policies.values()] for group in ("target", "kept")}
        series = {group: [metrics.get(metric, {}) for metrics in of[group]] for group in of}
        bars(axes, list(policies), series)
        axes.set_ylim(0.0, None if metric == "episode_length" else 1.02)
        axes.set_ylabel(metric.replace("_", " "))
    figure.axes[0].legend(ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    return figure
