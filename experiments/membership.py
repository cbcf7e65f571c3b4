"""Can one tell that a policy was trained on the targets? Tier 1: each clip against its mirror image (appendix)"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from forgetmimic_jax.evaluation.membership import FALSE_POSITIVES, attack_targets
from forgetmimic_jax.evaluation.plots import bars, new_figure
from forgetmimic_jax.evaluation.repeats import SEED, Repeat, units
from forgetmimic_jax.evaluation.statistics import PlainEstimate
from forgetmimic_jax.evaluation.tables import markdown_table, number
from forgetmimic_jax.studies import paper
from forgetmimic_jax.studies.claim import FAILS, ONE_VALUE, OPEN, Finding, finding, more_units, p_value
from forgetmimic_jax.studies.conduct import main
from forgetmimic_jax.studies.lab import Key, Lab, newest_policy
from forgetmimic_jax.studies.policies import retrained_in_words
from forgetmimic_jax.studies.study import Document, Study
from forgetmimic_jax.studies.variants import EPISODES, estimates_of, within

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GUESSED = 0.5  # AUC and accuracy of guessing
UNLEARNED = "λ = 16"
CLAIMS = {
    "tpr_at_5_percent_fpr": "the attack's surest hits are",
    "marked_at_5_percent_fpr": "the targets that look less trained than their mirror images are",
}
VARIANTS: dict[str, dict[str, Any]] = {
    UNLEARNED: {},
    "fine-tuned, all clips": {"method": "finetune", "clips": "all"},
    "distilled": {"method": "distill"},
}
HITS = {"tpr_at_5_percent_fpr": "TPR at 5 % FPR", "marked_at_5_percent_fpr": "marked at 5 % FPR"}
NAMES = {"accuracy": "accuracy", "auc": "AUC", **HITS}


def measure(lab: Lab) -> dict[str, Any]:
    """Every policy on the clips and on their mirror images, and the attack on the targets."""
    from forgetmimic_jax.motion.clip import read_clip
    from forgetmimic_jax.motion.mirror import mirrored
    from forgetmimic_jax.robot.model import load_robot
    from forgetmimic_jax.tracking.setup import library_folder

    variants = {(label, repeat): variant for label, variant in VARIANTS.items() for repeat in lab.repeats}
    variants |= {("retrained", repeat): variant for repeat, variant in lab.retrained.items()}
    runs = lab.run(variants, "membership")
    policies: dict[Key, Path] = {("base", Repeat(place, 0)): base.path for place, base in enumerate(lab.bases)}
    policies |= {key: newest_policy(folder) for key, folder in runs.items()}
    robot = load_robot(lab.config.robot)
    clips = [read_clip(library_folder(lab.config) / f"{name}.npz") for name in lab.bases[0].clips]
    members, names = lab.rollouts(policies, clips)
    twins, _ = lab.rollouts(policies, [mirrored(robot, clip) for clip in clips])
    is_target = np.isin(next(iter(members.values())).clip, [names.index(target) for target in lab.targets])
    attacks: dict[str, dict[str, dict[str, float]]] = {}
    episodes = int(is_target.sum())
    for key, rollout in members.items():
        label, repeat = key
        found = attack_targets(rollout, twins[key], is_target)
        attacks.setdefault(label, {})[str(repeat)] = {**dataclasses.asdict(found), EPISODES: episodes}
    return {"attacks": attacks}


def over_runs(document: Document) -> dict[str, Any]:
    """The attack on each kind of policy, as estimates over its runs."""
    results = document["results"]
    if "attacks" not in results:  # stored as estimates
        return results["policies"]
    return {label: estimates_of(found) for label, found in results["attacks"].items()}


def measured(policies: Mapping[str, Any]) -> dict[str, str]:
    """The numbers that all policies have: older results lack one."""
    return {name: title for name, title in NAMES.items() if all(name in of for of in policies.values())}


def guessed_hits(conditions: Mapping[str, Any]) -> float:
    """The hits of an attacker who guesses, at the threshold that `attack` takes of so few others."""
    others = len(conditions["targets"]) * conditions["episodes"]
    return (int(FALSE_POSITIVES * others) + 1) / (others + 1)


def body(document: Document) -> str:
    """The attack on each kind of policy."""
    policies, guessed = over_runs(document), guessed_hits(document["conditions"])
    names = measured(policies)
    rows = [
        [label, units(of["auc"]), *(number(within(of[name], 0.0, 1.0), 2) for name in names)]
        for label, of in policies.items()
    ]
    empty = [""] * (len(names) - 1)
    marked = ""
    if "marked_at_5_percent_fpr" in names:
        marked = (
            "TPR: the share of the targets' episodes that look more trained than 95 % of the mirror images'; marked: "
            "less trained than 95 % of them. "
        )
    rows += [[f"*paper: {label}*", "", f"{value:.2f}", *empty] for label, value in paper.MEMBERSHIP.items()]
    note = (
        "The attack sees the targets and their mirror images, which no policy was trained on, and says which is which. "
        "It learned what trained clips look like from the kept clips and their mirror images. Guessing gives accuracy "
        f"0.5, AUC 0.5 and a TPR of {guessed:.2f} (more than 0.05 because there are few mirror images). An AUC above "
        "0.5: the policy does the targets as it does trained clips. Below 0.5: it does them worse than clips that it "
        f"never saw, and is marked by having forgotten them. {marked}"
        f"{retrained_in_words(document['conditions'])} This is one attack: if it finds nothing, something may still be "
        "left. The paper's attack is another, on another library.\n"
    )
    return f"{markdown_table(['', 'n', *names.values()], rows)}\n{note}"


def findings(document: Document) -> Iterator[Finding]:
    """Whether the attack separates the targets from their mirror images, in either direction."""
    guessed = guessed_hits(document["conditions"])
    for label, of in over_runs(document).items():
        auc = of["auc"]
        evidence = f"AUC {number(within(auc, 0.0, 1.0), 2)}; guessing {GUESSED}{more_units(auc, GUESSED)}"
        claim = f"{label}: the attack cannot tell the targets from their mirror images"
        word, main, unit = separable(auc), label == UNLEARNED, auc.get("unit", SEED)
        yield Finding(claim, word, evidence, auc["n"], p_value(auc, GUESSED), main=main, unit=unit)
        for name, title in HITS.items():
            if name in of:
                evidence = f"{title} {number(within(of[name], 0.0, 1.0), 2)}; guessing {guessed:.2f}"
                yield finding(f"{label}: {CLAIMS[name]} no more than guessing's", of[name], guessed, evidence)


def answer(document: Document) -> str:
    """The attack on the unlearned policy, in one sentence."""
    policies = over_runs(document)
    if UNLEARNED not in policies:
        return "No unlearned policy was measured."
    auc = within(policies[UNLEARNED]["auc"], 0.0, 1.0)
    marked = ""
    if auc.get("high", 1.0) < GUESSED:
        marked = ", so the policy does the targets worse than clips that it never saw"
    elif auc.get("low", 0.0) > GUESSED:
        marked = ", so the policy still does the targets as it does trained clips"
    return f"The AUC of the attack is {number(auc, 2)}, where guessing has {GUESSED}{marked}."


def separable(auc: PlainEstimate) -> str:
    """The word for "the attack cannot tell": an interval around guessing leaves it open."""
    if "low" not in auc:
        return ONE_VALUE if auc["n"] > 1 else OPEN
    return OPEN if auc["low"] <= GUESSED <= auc["high"] else FAILS


def draw(document: Document) -> Figure:
    """Accuracy, AUC and TPR of each kind of policy."""
    policies = over_runs(document)
    figure = new_figure(width=7.0, height=4.0)
    axes = figure.add_subplot()
    names = measured(policies)
    bars(axes, list(policies), {title: [of[name] for of in policies.values()] for name, title in names.items()})
    axes.axhline(GUESSED, color="0.5", linestyle=":")
    axes.set_ylim(0.0, 1.0)
    axes.legend(frameon=False)
    return figure


STUDY = Study(
    name="membership",
    title="Can one tell that a policy was trained on the targets?",
    claim="After unlearning an attacker cannot tell that the policy was trained on the targets.",
    measure=measure,
    body=body,
    draw=draw,
    findings=findings,
    answer=answer,
    theirs=f"accuracy of another attack {paper.MEMBERSHIP['λ = 16']}, on its base {paper.MEMBERSHIP['base']:.2f}",
    conditions=lambda lab: lab.control_conditions(),
)

if __name__ == "__main__":
    main(STUDY)
