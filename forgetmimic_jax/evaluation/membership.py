"""Membership inference: does a policy's behaviour show that it was trained on a clip?

Tier 1: a clip against its mirror image, which is as hard and was never trained on. The attacker learns from the kept
clips and their mirror images what a trained clip looks like, and then classifies the targets and their mirror images.
The features are the paper's: tracking reward, success and episode length. What the attack finds is evidence; what it
does not find may still be there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from forgetmimic_jax.evaluation.metrics import Rollout, episode_metrics

FALSE_POSITIVES = 0.05


@dataclass(frozen=True)
class Attack:
    """How well members are separated from their mirror images; guessing has 0.5, 0.5 and, with many images, 0.05.

    Args:
        tpr_at_5_percent_fpr: members that look more trained than 95 % of the images.
        marked_at_5_percent_fpr: members that look less trained than 95 % of the images, as they do who were forgotten.
    """

    accuracy: float
    auc: float
    tpr_at_5_percent_fpr: float
    marked_at_5_percent_fpr: float


def features(member: Rollout, twin: Rollout) -> tuple[np.ndarray, np.ndarray]:
    """Features f[E, 3] of both, z-scored clip by clip over a clip's and its twin's episodes together.

    Args:
        member: of the clips.
        twin: of their mirror images, in the same order, with as many episodes each.
    """
    both = []
    for rollout in (member, twin):
        metrics = episode_metrics(rollout)
        share = metrics["episode_length"] / rollout.horizon
        both.append(np.stack([metrics["tracking_reward"], metrics["success_rate"], share], axis=-1))
    for clip in np.unique(member.clip):
        pair = np.concatenate([values[member.clip == clip] for values in both])
        mean, std = pair.mean(0), pair.std(0)
        for values in both:
            values[member.clip == clip] = (values[member.clip == clip] - mean) / np.where(std > 0, std, 1.0)
    return both[0], both[1]


def discriminant(members: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, float]:
    """Fisher's linear discriminant: direction f[feature] and the score half-way between the two means."""
    within = np.cov(members, rowvar=False) + np.cov(others, rowvar=False)
    direction = np.linalg.solve(within + 1e-3 * np.eye(len(within)), members.mean(0) - others.mean(0))
    return direction, float(direction @ (members.mean(0) + others.mean(0)) / 2.0)


def attack_targets(member: Rollout, twin: Rollout, is_target: np.ndarray) -> Attack:
    """Learn from the kept clips and their mirror images, and classify the targets and theirs.

    Args:
        member: of the clips.
        twin: of their mirror images; see `features`.
        is_target: bool[E] the episodes of targets.
    """
    clips, images = features(member, twin)
    return attack((clips[~is_target], images[~is_target]), (clips[is_target], images[is_target]))


def attack(known: tuple[np.ndarray, np.ndarray], unknown: tuple[np.ndarray, np.ndarray]) -> Attack:
    """Learn from `known` (members, others), each f[E, feature], and classify the `unknown`."""
    direction, threshold = discriminant(*known)
    members, others = unknown[0] @ direction, unknown[1] @ direction
    accuracy = 0.5 * ((members > threshold).mean() + (others <= threshold).mean())
    ranked, few = np.sort(others), int(FALSE_POSITIVES * len(others))
    above, below = (members > ranked[-1 - few]).mean(), (members < ranked[few]).mean()
    return Attack(float(accuracy), auc(members, others), float(above), float(below))


def auc(members: np.ndarray, others: np.ndarray) -> float:
    """Chance that a member scores above another, a tie counting half (Mann-Whitney U over its largest value)."""
    return float(stats.mannwhitneyu(members, others).statistic / (len(members) * len(others)))
