"""Does anti-reward fine-tuning make the policy forget the targets and keep the rest? (paper, fig. 2)"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from forgetmimic_jax.evaluation import paper
from forgetmimic_jax.evaluation.metrics import ZERO_ACTION
from forgetmimic_jax.evaluation.tables import number
from forgetmimic_jax.evaluation.variants import variant_table
from forgetmimic_jax.studies.study import Lab, main, variants_study
from forgetmimic_jax.unlearning.method import FINE_TUNING

ASKED_RATIO = 0.1  # of tracking, target over kept
CONTROL = "fine-tuned, all clips"
# The paper's loss and starts, at our step size and length.
PLAIN = {"set": ["ppo.base_kl=0.0", "ppo.equal_clips=false", "sampling.target_share=0.0"]}


def variants(lab: Lab) -> dict[str, dict[str, Any]]:
    """The paper's two penalties at a study's length, and λ = 16 with its control at that of `make unlearn`."""
    result: dict[str, dict[str, Any]] = {
        "λ = 16, plain PPO": PLAIN,
        "λ = 8": {"penalty": 8.0},
        "λ = 16": {"penalty": 16.0},
    }
    whole = FINE_TUNING.iterations[lab.options.budget]
    if lab.options.iterations is None and whole > lab.iterations:
        control = {"method": "finetune", "clips": "all", "iterations": whole}
        result |= {at_length("λ = 16"): {"iterations": whole}, at_length(CONTROL): control}
    return result


def at_length(label: str) -> str:
    """A row as long as `make unlearn` on a laptop."""
    return f"{label}, {FINE_TUNING.iterations['cpu']} iterations"


def tell(document: Mapping[str, Any]) -> str:
    """The table, and what a ratio of tracking can be at all."""
    variants = document["results"]["variants"]
    label = next(label for label in (at_length("λ = 16"), "λ = 16") if label in variants)
    of = variants[label]["over_seeds"]
    metric = "survival_weighted_tracking"
    kept, floor = of["policy"]["kept"][metric], of[ZERO_ACTION]["target"][metric]
    note = (
        f"A ratio of tracking of {ASKED_RATIO} would need {ASKED_RATIO * kept['mean']:.2f} on the targets beside the "
        f"{number(kept, 2)} that {label} keeps. The robot without a policy gets {number(floor, 2)} there, for it takes "
        "a while to fall: further down, a policy does not lack a skill but ends its episodes sooner than doing nothing "
        "would.\n\nThe paper's rows are of its text, which for both penalties also has 3-4 steps on the targets, a "
        "kept tracking of 0.85-0.86 and a kept success above 85 %; its table of methods says 68 and 72 %.\n"
    )
    return f"{variant_table(variants, paper.VALIDITY)}\n{note}"


STUDY = variants_study(
    "validity",
    "Are the targets forgotten and the other clips kept?",
    variants,
    paper.VALIDITY,
    asks=[at_length("λ = 16"), at_length(CONTROL)],
    tell=tell,
)

if __name__ == "__main__":
    main(STUDY)
