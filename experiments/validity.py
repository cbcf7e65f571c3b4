"""Does anti-reward fine-tuning make the policy forget the targets and keep the other clips? (paper, fig. 2)"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from forgetmimic_jax.evaluation.metrics import ZERO_ACTION
from forgetmimic_jax.evaluation.repeats import over_repeats
from forgetmimic_jax.evaluation.tables import number, percent
from forgetmimic_jax.studies import paper
from forgetmimic_jax.studies.claim import Finding, finding
from forgetmimic_jax.studies.conduct import main
from forgetmimic_jax.studies.findings import SUCCESS, kept_stay, no_success, skill_gone
from forgetmimic_jax.studies.lab import Lab
from forgetmimic_jax.studies.study import Document, variants_study
from forgetmimic_jax.studies.variants import DEVIATION, TRACKING, estimates, mean_gained, variant_table, within
from forgetmimic_jax.unlearning.method import FINE_TUNING

LENGTH, RATIO = "episode_length", "survival_weighted_degradation_ratio"
BOUND_RATIO = 0.1  # of tracking, target over kept
SOONER = 1.0  # steps by which an episode may end before the zero-action baseline's
NO_FURTHER_OFF = "until it falls it is no further off a target than the zero-action baseline"
CONTROL = "fine-tuned, all clips"
# The paper's loss and starts, at our step size and length.
PLAIN = {"set": ["ppo.base_kl=0.0", "ppo.equal_clips=false", "sampling.target_share=0.0"]}
WHOLE = FINE_TUNING.iterations  # of `make unlearn`, by preset


def variants(lab: Lab) -> dict[str, dict[str, Any]]:
    """The paper's two penalties at a study's length, and λ = 16 with its control at that of `make unlearn`."""
    result: dict[str, dict[str, Any]] = {
        "λ = 16, plain PPO": PLAIN,
        "λ = 8": {"penalty": 8.0},
        "λ = 16": {"penalty": 16.0},
    }
    whole = WHOLE[lab.options.preset]
    if lab.options.iterations is None and whole > lab.iterations:
        control = {"method": "finetune", "clips": "all", "iterations": whole}
        result |= {at_length("λ = 16"): {"iterations": whole}, at_length(CONTROL): control}
    return result


def at_length(label: str) -> str:
    """A row as long as `make unlearn` on a laptop."""
    return f"{label}, {WHOLE['cpu']} iterations"


def main_row(variants: Mapping[str, Any]) -> str:
    """The row that answers the claim: λ = 16 at the length of `make unlearn`, if there is one."""
    return next((label for label in (at_length("λ = 16"), "λ = 16") if label in variants), next(iter(variants)))


def body(document: Document) -> str:
    """The table, and what a ratio of tracking can be at all."""
    variants = document["results"]["variants"]
    label = main_row(variants)
    of = estimates(variants[label])
    kept, baseline = of["policy"]["kept"][TRACKING], of[ZERO_ACTION]["target"][TRACKING]
    note = (
        f"A ratio of tracking of {BOUND_RATIO} would need {BOUND_RATIO * kept['mean']:.2f} on the targets beside the "
        f"{number(kept, 2)} that {label} keeps. The zero-action baseline gets {number(baseline, 2)} there, because the "
        "robot takes a while to fall. A policy below that does not only lack a skill: it ends its episodes sooner than "
        "doing nothing would.\n\nThe paper's rows are of its text, which for both penalties also has 3-4 steps on the "
        "targets, a kept tracking of 0.85-0.86 and a kept success above 85 %; its table of methods says 68 and 72 %.\n"
    )
    return f"{variant_table(variants, paper.VALIDITY)}\n{note}"


def findings(document: Document) -> Iterator[Finding]:
    """Forgotten and kept; at the length of `make unlearn` also against the control, and forgotten or sabotaged."""
    variants = document["results"]["variants"]
    for label in variants:
        if label != at_length(CONTROL):
            main = label == main_row(variants)
            yield no_success(variants, label, f"{label}: the targets are no longer completed", main=main)
            yield from skill_gone(variants, label, f"{label}: the skill on the targets is gone", main=main)
            yield from kept_stay(variants, label, None, f"{label}: the kept clips stay as they were", main=main)
    label = at_length("λ = 16")
    if label in variants:
        claim = f"{label}: the kept clips are as after fine-tuning alone"
        yield from kept_stay(variants, label, at_length(CONTROL), claim)
        yield from against_zero_action(variants, label)


def answer(document: Document) -> str:
    """Forgotten and kept, in one sentence."""
    variants = document["results"]["variants"]
    label = main_row(variants)
    target = estimates(variants[label])["policy"]["target"]
    change = mean_gained(variants, label, None, "kept", SUCCESS)
    below = " (below 0: worse than with zero actions)" if target.get("skill", {}).get("high", 0.0) < 0.0 else ""
    return (
        f"With {label}, {percent(within(target[SUCCESS], 0.0, 1.0))} of the target episodes succeed, "
        f"{percent(target.get('skill'))} of the skill is retained{below}, and the success rate on the other clips "
        f"changes by {percent(change)} against the base."
    )


def against_zero_action(variants: Mapping[str, Any], label: str) -> Iterator[Finding]:
    """Whether a policy lacks the skill, or ends its episodes on purpose."""
    ratio = estimates(variants[label])["policy"][RATIO]
    evidence = f"target over kept tracking {number(within(ratio, 0.0, np.inf), 3)}; bound {BOUND_RATIO:g}"
    yield finding(f"{label}: the targets' tracking is under a tenth of the kept clips'", ratio, BOUND_RATIO, evidence)
    runs = {at: (run["policy"]["target"], run[ZERO_ACTION]["target"]) for at, run in variants[label]["runs"].items()}
    later = over_repeats({at: policy[LENGTH] - baseline[LENGTH] for at, (policy, baseline) in runs.items()})
    evidence = f"length of target episodes minus the zero-action baseline's {number(later, 1)} steps; bound {-SOONER:g}"
    claim = f"{label}: the policy lacks the skill and does not end episodes on purpose"
    yield finding(claim, later, -SOONER, evidence, below=False)
    off = {at: (one[DEVIATION], other[DEVIATION]) for at, (one, other) in runs.items() if DEVIATION in one}
    if off:
        further = over_repeats({at: policy - baseline for at, (policy, baseline) in off.items()})
        mean = np.mean([baseline for _, baseline in off.values()])
        evidence = (
            f"largest key body error minus the zero-action baseline's {number(further, 3)} m, of {mean:.3f} m, on the "
            "steps that both and the base survive; bound 0"
        )
        yield finding(f"{label}: {NO_FURTHER_OFF}", further, 0.0, evidence)


STUDY = variants_study(
    "validity",
    "Are the targets forgotten and the other clips kept?",
    "With λ = 16 the targets are forgotten and the other clips are kept.",
    variants,
    papers=paper.VALIDITY,
    theirs="0 % of the target episodes succeed; kept success from 74 to 68 % in its table, above 85 % in its text",
    conditions=lambda lab: {"values": list(variants(lab))},
    body=body,
    findings=findings,
    answer=answer,
)

if __name__ == "__main__":
    main(STUDY)
