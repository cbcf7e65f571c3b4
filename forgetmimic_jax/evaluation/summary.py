"""From the rollouts of several policies to the numbers of evaluation.json, each with its interval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from forgetmimic_jax.evaluation import metrics, statistics
from forgetmimic_jax.evaluation.document import PolicyResult, policy_result
from forgetmimic_jax.evaluation.metrics import BASE, ZERO_ACTION, Rollout
from forgetmimic_jax.evaluation.statistics import PlainEstimate


def evaluate_policies(
    rollouts: Mapping[str, Rollout],
    names: Sequence[str],
    targets: Sequence[str],
    *,
    seed: int,
) -> dict[str, PolicyResult]:
    """The `policies` part of evaluation.json.

    Args:
        rollouts: policy name (base, unlearned, zero_action, ...) to its rollout; all on the same episodes.
        names: clip names of the library, which `Rollout.clip` indexes.
        targets: clips to forget; without any, everything is kept.
        seed: of the bootstrap.

    Raises:
        ValueError: rollouts whose episodes differ.
    """
    common = metrics.common_length(rollouts.values())
    per_policy = {
        policy: metrics.episode_metrics(rollout, common if len(rollouts) > 1 else None)
        for policy, rollout in rollouts.items()
    }
    first = next(iter(rollouts.values()))
    clip, from_frame_0 = first.clip, first.start_frame == 0
    weights = statistics.resampling_weights(clip, seed=seed)
    is_target = np.isin(clip, [names.index(target) for target in targets])
    return {
        policy: policy_result(
            _policy_summary(policy, per_policy, clip, is_target, from_frame_0, names, weights)
            | {"nan_resets": int(rollout.nan_resets)}
            | {"ended_by": {bound: int(episodes.sum()) for bound, episodes in rollout.ended_by.items()}}
        )
        for policy, rollout in rollouts.items()
    }


def _policy_summary(
    policy: str,
    per_policy: Mapping[str, Mapping[str, np.ndarray]],
    clip: np.ndarray,
    is_target: np.ndarray,
    from_frame_0: np.ndarray,
    names: Sequence[str],
    weights: np.ndarray,
) -> dict[str, Any]:
    clips = {}
    for index in np.unique(clip):
        members = clip == index
        target = bool(is_target[members][0])
        numbers = _episodes_summary(policy, per_policy, members, from_frame_0, weights)
        clips[names[index]] = {"target": target, **numbers}
    summary: dict[str, Any] = {"clips": clips}
    if is_target.any():
        summary["target"] = _episodes_summary(policy, per_policy, is_target, from_frame_0, weights)
    if not is_target.all():
        summary["kept"] = _episodes_summary(policy, per_policy, ~is_target, from_frame_0, weights)
    if is_target.any() and not is_target.all():
        for name, metric in (
            ("degradation_ratio", "tracking_reward"),  # the paper's
            ("survival_weighted_degradation_ratio", "survival_weighted_tracking"),
        ):
            values = per_policy[policy][metric]
            target_and_kept = [(values[members], weights[:, members]) for members in (is_target, ~is_target)]
            summary[name] = statistics.bootstrap_of_means(metrics.ratio, *target_and_kept, n=len(values))
    return summary


def _episodes_summary(
    policy: str,
    per_policy: Mapping[str, Mapping[str, np.ndarray]],
    members: np.ndarray,
    from_frame_0: np.ndarray,
    weights: np.ndarray,
) -> dict[str, PlainEstimate]:
    """Every metric of one policy over the episodes bool[E] of whole clips."""
    weights = weights[:, members]
    summary = {
        name: statistics.bootstrap_mean(values[members], weights)
        for name, values in per_policy[policy].items()
        if name != "success_rate"
    }
    success = per_policy[policy]["success_rate"][members]
    summary["success_rate"] = statistics.rate(int(success.sum()), len(success))
    if (members & from_frame_0).any():
        first = success[from_frame_0[members]]
        summary["success_rate_from_frame_0"] = statistics.rate(int(first.sum()), len(first))
    if policy in (BASE, ZERO_ACTION) or BASE not in per_policy:
        return summary

    def tracking(name: str) -> tuple[np.ndarray, np.ndarray]:
        return per_policy[name]["survival_weighted_tracking"][members], weights

    n = len(success)
    if ZERO_ACTION in per_policy:
        base, zero = np.mean(tracking(BASE)[0]), np.mean(tracking(ZERO_ACTION)[0])
        if base - zero >= metrics.MINIMUM_SKILL_RANGE:
            against = (tracking(policy), tracking(BASE), tracking(ZERO_ACTION))
            summary["skill"] = statistics.bootstrap_of_means(metrics.skill, *against, n=n)
    summary["retention"] = statistics.bootstrap_of_means(metrics.ratio, tracking(policy), tracking(BASE), n=n)
    return summary
