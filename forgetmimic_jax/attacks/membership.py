"""Does the policy show that it was trained on the targets? Each clip against its mirror image, as the study has it."""

from __future__ import annotations

import dataclasses

from forgetmimic_jax.attacks.case import Case
from forgetmimic_jax.attacks.document import Membership
from forgetmimic_jax.evaluation import membership
from forgetmimic_jax.motion.mirror import mirrored


def attack(case: Case) -> dict[str, Membership]:
    """The attack of `evaluation.membership` on every policy."""
    members = case.on_library
    images = [mirrored(case.setup.robot, clip) for clip in case.clips.values()]
    twins = case.stage(images, case.scale.episodes).perform(case.policies)
    is_target = members.of(case.targets)
    found = {}
    for policy in case.policies:
        result = membership.attack_targets(members.rollout(policy), twins.rollout(policy), is_target)
        found[policy] = Membership(**dataclasses.asdict(result))
    return found
