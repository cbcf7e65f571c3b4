"""Every method at the same budget, and arft with every sampler, with and without the wrench (paper, table 1)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from experiments.validity import PLAIN
from forgetmimic_jax.evaluation import paper, statistics
from forgetmimic_jax.evaluation.tables import markdown_table, number
from forgetmimic_jax.evaluation.variants import paired, variant_bars, variant_table
from forgetmimic_jax.studies.study import Lab, Study, main
from forgetmimic_jax.sweep import ablation
from forgetmimic_jax.unlearning.distill import PACE as DISTILL_PACE
from forgetmimic_jax.unlearning.method import SHORT

CONTROL = "fine-tuned, all clips"
PAPERS = ("random_reward", "negated_reward", "decremental", "trajdeleter")  # baselines that the paper has claims about
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
    if "decremental" in variants and asked["budget"] == "cpu":
        parts.append(
            "*decremental* and *policy edit* have losses of their own, without the anchor and the clips' weights; of "
            "the cpu budget's pace they have the starts, and *plain PPO* takes those away.\n"
        )
    if "distill" in variants and asked["budget"] == "cpu":
        steps = {
            name: of["minibatches"] * of["epochs"]
            for name, of in (("distill", DISTILL_PACE.ppo["cpu"]), ("the others", SHORT))
        }
        told = ", ".join(f"{name} {count}" for name, count in steps.items())
        parts.append(f"Gradient steps an iteration: {told}.\n")
    if CONTROL in variants:
        header = ["", "kept success - base's, points", "- the control's", "kept tracking / base's", "/ the control's"]
        rows = [[label, *against_base_and_control(variants, label)] for label in variants]
        parts.append(f"**Kept clips against the base and against the control ({CONTROL})**\n")
        parts.append(markdown_table(header, rows))
    return "\n".join(parts)


def against_base_and_control(variants: Mapping[str, Any], label: str) -> list[str]:
    """Points of success that kept clips gained on the base's and the control's of the same seed; retained tracking."""
    kinds: list[tuple[str, Callable[[float, float], float], int]] = [
        ("success_rate", lambda mine, theirs: 100.0 * (mine - theirs), 1),
        ("survival_weighted_tracking", lambda mine, theirs: mine / theirs, 3),
    ]
    cells = []
    for metric, against, digits in kinds:
        for other in (None, CONTROL):
            pairs = paired(variants, label, other, "kept", metric)
            values = [against(*pair) for seed, pair in pairs.items() if seed in variants[CONTROL]["seeds"]]
            cells.append(number(statistics.over_seeds(values), digits) if values else "")
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
