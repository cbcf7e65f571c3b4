"""What does the robot do when it is asked for a forgotten clip? Six physical measures (paper, fig. 6)"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from forgetmimic_jax.evaluation import metrics, statistics
from forgetmimic_jax.evaluation.plots import new_figure
from forgetmimic_jax.evaluation.tables import UNITS, markdown_table, number
from forgetmimic_jax.evaluation.variants import within
from forgetmimic_jax.studies.study import Lab, Study, main, newest_policy

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ERRORS = (
    *("anchor_position_error", "anchor_orientation_error", "max_key_body_position_error"),
    *("foot_contact", "joint_limit_violation"),
)
VARIANTS: dict[str, dict[str, Any]] = {
    "fine-tuned": {"method": "finetune", "clips": "all"},
    "λ = 8": {"penalty": 8.0},
    "λ = 16": {"penalty": 16.0},
}
MEASURES = ("episode_length", *ERRORS)


def measure(lab: Lab) -> dict[str, Any]:
    """Every policy on the same episodes of the targets; every episode's six numbers."""
    runs = lab.run(
        {(label, seed): {**variant, "seed": seed} for label, variant in VARIANTS.items() for seed in lab.seeds},
        "physical behaviour",
    )
    policies: dict[tuple[str, int], Path | None] = {("base", 0): lab.base, ("zero action", 0): None}
    policies |= {key: newest_policy(folder) for key, folder in runs.items()}
    rollouts, names = lab.rollouts(policies)
    common = metrics.common_length(rollouts.values())
    on_target = np.isin(next(iter(rollouts.values())).clip, [names.index(target) for target in lab.targets])
    result: dict[str, Any] = {}
    for (label, seed), rollout in rollouts.items():
        values = metrics.episode_metrics(rollout, common)
        shown = [*MEASURES, *(name + metrics.COMMON for name in ERRORS)]
        result.setdefault(label, {})[str(seed)] = {name: values[name][on_target].round(5).tolist() for name in shown}
    return {"policies": result}


def tell(document: Mapping[str, Any]) -> str:
    """Means over the seeds, over the steps alive and over the steps that every policy survives."""
    policies = document["results"]["policies"]
    rows = []
    for name in (*MEASURES, *(name + metrics.COMMON for name in ERRORS)):
        common = name.endswith(metrics.COMMON)
        plain = name.removesuffix(metrics.COMMON)
        label = f"{plain.replace('_', ' ')}, {UNITS.get(plain, 'm')}{', common steps' if common else ''}"
        cells = [statistics.over_seeds([np.mean(run[name]) for run in of.values()]) for of in policies.values()]
        largest = 1.0 if UNITS.get(plain) == "share" else np.inf
        digits = 1 if name == "episode_length" else 3
        rows.append([label, *(number(within(cell, 0.0, largest), digits) for cell in cells)])
    note = (
        "On the targets. Errors over the steps alive flatter a policy that falls at once; common steps are those that "
        "every policy survives. Paper (another library and budget): length 500 to 8-13 steps, anchor position error "
        "0.576 to 0.053-0.055 m, foot contact 0.94 to 0.40-0.56, joint limit violation 0.12 to 0.26.\n"
    )
    return f"{markdown_table(['', *policies], rows)}\n{note}"


def draw(document: Mapping[str, Any]) -> Figure:
    """A violin of all episodes for each measure and policy."""
    policies = document["results"]["policies"]
    figure = new_figure(width=11.0, height=6.0)
    for place, name in enumerate(MEASURES):
        axes = figure.add_subplot(2, 3, place + 1)
        axes.violinplot(
            [np.concatenate([run[name] for run in of.values()]) for of in policies.values()], showmeans=True
        )
        axes.set_xticks(range(1, len(policies) + 1), list(policies), fontsize="small", rotation=20)
        axes.set_title(f"{name.replace('_', ' ')}, {UNITS.get(name, 'm')}", fontsize="medium")
    return figure


STUDY = Study(
    name="physical_behaviour",
    title="What does the robot do when it is asked for a forgotten clip?",
    measure=measure,
    tell=tell,
    draw=draw,
)

if __name__ == "__main__":
    main(STUDY)
