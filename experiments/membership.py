"""Can one tell that a policy was trained on the targets? Tier 1: each clip against its mirror image (appendix)"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from forgetmimic_jax.evaluation import paper
from forgetmimic_jax.evaluation.membership import FALSE_POSITIVES, attack, features
from forgetmimic_jax.evaluation.plots import bars, new_figure
from forgetmimic_jax.evaluation.tables import markdown_table, number
from forgetmimic_jax.evaluation.variants import over_seeds, within
from forgetmimic_jax.studies.study import Lab, Study, main, newest_policy

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NAMES = {"accuracy": "accuracy", "auc": "AUC", "tpr_at_5_percent_fpr": "TPR at 5 % FPR"}


def measure(lab: Lab) -> dict[str, Any]:
    """Every policy on the clips and on their mirror images, and the attack on the targets."""
    from forgetmimic_jax.motion.clip import read_clip
    from forgetmimic_jax.motion.mirror import mirrored
    from forgetmimic_jax.robot.model import load_robot
    from forgetmimic_jax.tracking.setup import library_folder

    runs = lab.run(
        {
            **{("λ = 16", seed): {"seed": seed} for seed in lab.seeds},
            **{("fine-tuned, all clips", s): {"method": "finetune", "clips": "all", "seed": s} for s in lab.seeds},
            **{("distilled", seed): {"method": "distill", "seed": seed} for seed in lab.seeds},
            **{
                ("retrained", seed): {"method": "retrain", "iterations": lab.control_iterations, "seed": seed}
                for seed in lab.control_seeds
            },
        },
        "membership",
    )
    policies: dict[tuple[str, int], Path] = {("base", 0): lab.base}
    policies |= {key: newest_policy(folder) for key, folder in runs.items()}
    robot = load_robot(lab.config.robot)
    clips = [read_clip(library_folder(lab.config) / f"{name}.npz") for name in lab.info.clips]
    members, names = lab.rollouts(policies, clips)
    twins, _ = lab.rollouts(policies, [mirrored(robot, clip) for clip in clips])
    is_target = np.isin(next(iter(members.values())).clip, [names.index(target) for target in lab.targets])
    attacks: dict[str, list[dict[str, float]]] = {}
    for key, rollout in members.items():
        both = features(rollout, twins[key])
        known, asked = (tuple(values[mask] for values in both) for mask in (~is_target, is_target))
        attacks.setdefault(key[0], []).append(dataclasses.asdict(attack(known, asked)))  # type: ignore[arg-type]
    return {"policies": {label: over_seeds(found) for label, found in attacks.items()}}


def guessed_hits(asked: Mapping[str, Any]) -> float:
    """The hits of an attacker who guesses, at the threshold that `attack` takes of so few others."""
    others = len(asked["targets"]) * asked["episodes"]
    return (int(FALSE_POSITIVES * others) + 1) / (others + 1)


def verdict(of: Mapping[str, Mapping[str, float]], guessed: float) -> str:
    """What AUC and hits over several policies say, in words; `guessed` are the hits of guessing."""
    auc, hits = of["auc"], of["tpr_at_5_percent_fpr"]
    if "low" not in auc:
        return "one policy: no interval, no verdict"
    if auc["low"] > 0.5:
        return "evidence that it was trained on them"
    if auc["high"] < 0.5:
        return "the targets are done worse than their images: marked by having been forgotten"
    if hits["low"] > guessed:
        return "the AUC finds no evidence, the hits at 5 % false alarms do"
    return "this probe finds no evidence"


def tell(document: Mapping[str, Any]) -> str:
    """The attack on each kind of policy."""
    policies, guessed = document["results"]["policies"], guessed_hits(document["asked"])
    rows = [
        [label, str(of["auc"]["n"]), *(number(within(of[name], 0.0, 1.0), 2) for name in NAMES), verdict(of, guessed)]
        for label, of in policies.items()
    ]
    rows += [[f"*paper: {label}*", "", f"{value:.2f}", "", "", ""] for label, value in paper.MEMBERSHIP.items()]
    note = (
        "Members are the targets, the others their mirror images, which no policy was trained on; the attacker learned "
        "from the kept clips and their images. Guessing is 0.5, 0.5 and "
        f"{guessed:.2f}, more than 0.05 because the others are few. Intervals are over policies. The "
        f"retrained one has had {document['asked']['control_iterations']:,} iterations. This is probe evidence: it "
        "certifies nothing. The paper's attack is another, on another library.\n"
    )
    return f"{markdown_table(['', 'policies', *NAMES.values(), 'verdict'], rows)}\n{note}"


def draw(document: Mapping[str, Any]) -> Figure:
    """Accuracy, AUC and TPR of each kind of policy."""
    policies = document["results"]["policies"]
    figure = new_figure(width=7.0, height=4.0)
    axes = figure.add_subplot()
    bars(axes, list(policies), {title: [of[name] for of in policies.values()] for name, title in NAMES.items()})
    axes.axhline(0.5, color="0.5", linestyle=":")
    axes.set_ylim(0.0, 1.0)
    axes.legend(frameon=False)
    return figure


STUDY = Study(
    name="membership",
    title="Can one tell that a policy was trained on the targets?",
    retrains=True,
    measure=measure,
    tell=tell,
    draw=draw,
)

if __name__ == "__main__":
    main(STUDY)
