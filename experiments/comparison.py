"""Every method at the same budget, and arft with every sampler, with and without the wrench (paper, table 1)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from experiments.validity import PLAIN
from forgetmimic_jax.evaluation.repeats import over_repeats
from forgetmimic_jax.evaluation.tables import markdown_table, number, percent
from forgetmimic_jax.studies import paper, samplers
from forgetmimic_jax.studies.claim import Finding, finding
from forgetmimic_jax.studies.conduct import main
from forgetmimic_jax.studies.findings import SUCCESS, kept_stay
from forgetmimic_jax.studies.lab import Lab
from forgetmimic_jax.studies.policies import retrained_in_words
from forgetmimic_jax.studies.study import Document, Study
from forgetmimic_jax.studies.variants import TRACKING, difference, mean_gained, paired, variant_bars, variant_table
from forgetmimic_jax.training.standing import longest
from forgetmimic_jax.unlearning import distill, stand
from forgetmimic_jax.unlearning.method import SHORT

ARFT, PLAIN_ARFT = "arft", "arft, plain PPO"
CONTROL = "fine-tuned, all clips"
PAPERS = ("random_reward", "negated_reward", "decremental", "trajdeleter")  # baselines that the paper has claims about
INCOMPLETE = ("random_reward", "trajdeleter")  # of them, those that the paper says forget less


def plain(method: str) -> str:
    """The row of a baseline at the paper's own loss."""
    return f"{method.replace('_', ' ')}, plain PPO"


STAND_TEACHER = longest(stand.METHOD.settings["stand_iterations"])  # at most, and before the run's own
STAND = f"stand (and up to {STAND_TEACHER} for its teacher)"
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
    STAND: {"method": "stand"},
    ARFT: {},
    "arft, λ = 8": {"penalty": 8.0},
    PLAIN_ARFT: PLAIN,
    **{plain(name): {"method": name, **PLAIN} for name in PAPERS},
}


def measure(lab: Lab) -> dict[str, Any]:
    """Every method and the ablation, and the retrained control."""
    arft = {f"{ARFT}, {label}": variant for label, variant in samplers.ablation().items()}
    return lab.over_repeats({**METHODS, **arft}, "comparison", others={"retrained": lab.retrained})


def body(document: Document) -> str:
    """The table, and the differences from base and fine-tuned control, run by run."""
    variants, conditions = document["results"]["variants"], document["conditions"]
    parts = [variant_table(variants, paper.COMPARISON)]
    if "retrained" in variants:
        parts.append(
            f"{retrained_in_words(conditions)} *arft* has λ = 16, also in the rows by sampler, where each sampler "
            "gives the targets its own share of the starts.\n"
        )
    if conditions["preset"] == "cpu":
        parts.append(
            "*decremental* and *policy edit* have losses of their own, without the KL to the base and the clips' "
            "weights; of the cpu preset they have the starts, and *plain PPO* has not. *stand* has a loss of its own "
            "with the clips' weights.\n"
        )
        steps = {"distill": distill.PACE.ppo["cpu"], STAND: stand.PACE.ppo["cpu"], "the others": SHORT}
        shown = {name: of for name, of in steps.items() if name in variants or name == "the others"}
        counts = ", ".join(f"{name} {of['minibatches'] * of['epochs']}" for name, of in shown.items())
        parts.append(f"Gradient steps an iteration: {counts}.\n")
    if STAND in variants:
        parts.append(
            f"Every row has the same number of iterations but *stand*: before it a teacher learns to stand, for up to "
            f"{STAND_TEACHER} iterations more.\n"
        )
    if CONTROL in variants:
        header = ["", "kept success - base's", "- the control's", "kept tracking / base's", "/ the control's"]
        rows = [[label, *against_base_and_control(variants, label)] for label in variants]
        parts.append(f"**Kept clips against the base and against the control ({CONTROL})**\n")
        parts.append(markdown_table(header, rows))
    return "\n".join(parts)


def against_base_and_control(variants: Mapping[str, Any], label: str) -> list[str]:
    """Points of success that kept clips gained on the base and on the control of the same repeat; retained tracking."""
    runs, cells = variants[label]["runs"], []
    for other in (None, CONTROL):
        pairs = _beside_control(variants, label, other, SUCCESS)
        cells.append(percent(difference(runs, pairs, "kept", SUCCESS)) if pairs else "")
    for other in (None, CONTROL):
        pairs = _beside_control(variants, label, other, TRACKING)
        cells.append(number(over_repeats({at: a / b for at, (a, b) in pairs.items()})) if pairs else "")
    return cells


def _beside_control(
    variants: Mapping[str, Any], label: str, other: str | None, metric: str
) -> dict[str, tuple[float, float]]:
    """See `paired`; of the repeats that the control has."""
    pairs = paired(variants, label, other, "kept", metric)
    return {at: pair for at, pair in pairs.items() if at in variants[CONTROL]["runs"]}


def findings(document: Document) -> Iterator[Finding]:
    """Against the paper's baselines, the control, and the ablation."""
    variants = document["results"]["variants"]
    for method in PAPERS:
        kept = mean_gained(variants, PLAIN_ARFT, plain(method), "kept", TRACKING)
        if kept:
            name = method.replace("_", " ")
            evidence = f"kept tracking of arft minus that of {name} {number(kept, 2)}; bound 0"
            claim = f"arft keeps the other clips better than {name} (both plain PPO)"
            yield finding(claim, kept, 0.0, evidence, below=False, main=True)
    for method in INCOMPLETE:
        target = mean_gained(variants, PLAIN_ARFT, plain(method), "target", TRACKING)
        if target:
            name = method.replace("_", " ")
            evidence = f"target tracking of arft minus that of {name} {number(target, 2)}; bound 0"
            yield finding(f"arft forgets more than {name} (both plain PPO)", target, 0.0, evidence)
    claim = "λ = 16: the kept clips are as after fine-tuning without an anti-reward"
    yield from kept_stay(variants, ARFT, CONTROL, claim)
    yield from samplers.findings(variants, f"{ARFT}, ")


def answer(document: Document) -> str:
    """The kept clips with arft and with each baseline, in one sentence."""
    variants, parts = document["results"]["variants"], []
    for method in PAPERS:
        kept = mean_gained(variants, PLAIN_ARFT, plain(method), "kept", TRACKING)
        if kept:
            parts.append(f"{number(kept, 2)} ({method.replace('_', ' ')})")
    return f"Tracking of the kept clips with arft minus that with each baseline: {'; '.join(parts)}."


STUDY = Study(
    name="comparison",
    title="Every method at the same budget",
    theirs="tracking while alive of the kept clips 0.83 (λ = 16), with its baselines 0.68, 0.69 and 0.71",
    claim="Anti-reward fine-tuning (arft) keeps the other clips better than the baselines do.",
    measure=measure,
    body=body,
    draw=lambda document: variant_bars(document["results"]["variants"]),
    findings=findings,
    answer=answer,
    conditions=lambda lab: {
        "values": [*METHODS, *samplers.ablation()],
        **lab.control_conditions(),
    },
)

if __name__ == "__main__":
    main(STUDY)
