"""Relearning on the first half of each target alone: does the second half, which is never shown, come back with it?"""

from __future__ import annotations

from forgetmimic_jax.attacks.case import Case
from forgetmimic_jax.attacks.document import CONTROL, Recovery
from forgetmimic_jax.attacks.fine_tuning import shares
from forgetmimic_jax.attacks.near_duplicates import first_half, second_half
from forgetmimic_jax.attacks.recovery import Plan, Workshop, before_and_after
from forgetmimic_jax.evaluation.metrics import UNLEARNED
from forgetmimic_jax.motion.clip import Clip


def shown(case: Case) -> list[Clip]:
    """The first halves of the targets."""
    return [first_half(clip) for clip in case.chosen(case.targets)]


def attack(case: Case, workshop: Workshop) -> Recovery:
    """Unlearned policy and control on the second halves, before and after; half of the starts are on first halves."""
    stage = case.stage([second_half(clip) for clip in case.chosen(case.targets)], case.scale.target_episodes)
    starts = shares([clip.name for clip in shown(case)], case.kept)
    plan = Plan("held-out", (UNLEARNED, CONTROL), starts, case.scale.held_out_iterations)
    return before_and_after(case, workshop, plan, stage, stage.perform(case.everyone))
