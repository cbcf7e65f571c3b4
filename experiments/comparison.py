"""Every method at the same budget, and arft with every sampler, with and without the wrench (paper, table 1)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from experiments.validity import PLAIN
from forgetmimic_jax.evaluation import paper, statistics
from forgetmimic_jax.evaluation.tables import markdown_table, number
from forgetmimic_jax.evaluation.variants import gained, variant_bars, variant_table
from forgetmimic_jax.study import Lab, Study, main
from forgetmimic_jax.sweep import ablation

CONTROL = "fine-tuned, all clips"
PAPERS = ("random_reward", "decremental", "trajdeleter")  # baselines that the paper has claims about
METHODS: dict[str, dict[str, Any]] = {
    "fine-tuned, kept clips": {"method": "finetune"},
    CONTROL: {"method": "finetune", "clips": "all"},
    "fine-tuned, all clips, plain PPO": {"method": "finetune", "clips": "all", **PLAIN},
    **{
        name.replace("_", " "): {"method": name}
        for name in (
            *("random_reward", "decremental", "poisoning", "trajdeleter"),
            *("negated_reward", "gradient_ascent", "policy_edit", "distill"),
        )
    },
    "arft": {},
    "arft, λ = 8": {"penalty": 8.0},
    "arft, plain PPO": PLAIN,
    **{f"{name.replace('_', ' ')}, plain PPO": {"method": name, **PLAIN} for name in PAPERS},
}


def measure(lab: Lab) -> dict[str, Any]:
    """Every method and the ablation; a retrained policy as often as the budget allows."""
    retrain = {"retrained": {"method": "retrain", "iterations": lab.control_iterations}}
    arft = {f"arft, {label}": variant for label, variant in ablation().items()}
    return lab.over_seeds({**METHODS, **arft, **retrain}, "comparison", seeds={"retrained": lab.control_seeds})


def tell(document: Mapping[str, Any]) -> str:
    """The table, and the differences from base and fine-tuned control, seed by seed."""
    variants, asked = document["results"]["variants"], document["asked"]
    parts = [variant_table(variants, paper.COMPARISON)]
    if "retrained" in variants:
        parts.append(
            f"*retrained*: {asked['control_iterations']:,} iterations from scratch with the base's own settings, which "
            f"took {asked['base_environment_steps']:,} environment steps to make the base. *arft* is λ = 16; the rows "
            "by sampler are too, each at the shares of the starts that its rule gives.\n"
        )
    if CONTROL in variants:
        header = ["", "kept success - base's, points", "- the control's", "kept tracking - base's", "- the control's"]
        rows = [[label, *differences(variants, label)] for label in variants]
        parts.append(f"**Kept clips against the base and against the control ({CONTROL})**\n")
        parts.append(markdown_table(header, rows))
    return "\n".join(parts)


def differences(variants: Mapping[str, Any], label: str) -> list[str]:
    """What a variant's kept clips gained on the base's and on the control's of the same seed, over the seeds."""
    cells = []
    for metric, scale, digits in (("success_rate", 100.0, 1), ("survival_weighted_tracking", 1.0, 3)):
        for other in (None, CONTROL):
            found = gained(variants, label, other, "kept", metric)
            pairs = [scale * value for seed, value in found.items() if seed in variants[CONTROL]["seeds"]]
            cells.append(number(statistics.over_seeds(pairs), digits) if pairs else "")
    return cells


STUDY = Study(
    name="comparison",
    title="Every method at the same budget",
    retrains=True,
    measure=measure,
    tell=tell,
    draw=lambda document: variant_bars(document["results"]["variants"]),
    asks=[*METHODS, *ablation()],
)

if __name__ == "__main__":
    main(STUDY)
