"""What does the robot do on a forgotten clip? Six physical measures (paper, fig. 6)"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from experiments.validity import LENGTH, NO_FURTHER_OFF, SOONER
from forgetmimic_jax.evaluation import metrics, tables
from forgetmimic_jax.evaluation.plots import new_figure
from forgetmimic_jax.evaluation.repeats import Repeat, base_of, over_repeats, rate_over_repeats
from forgetmimic_jax.evaluation.statistics import PlainEstimate
from forgetmimic_jax.evaluation.tables import UNITS, markdown_table, number, percent
from forgetmimic_jax.studies.claim import Finding, finding
from forgetmimic_jax.studies.conduct import main
from forgetmimic_jax.studies.lab import Key, Lab, newest_policy
from forgetmimic_jax.studies.study import Document, Study
from forgetmimic_jax.studies.variants import DEVIATION, within

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
MEASURES = (LENGTH, *ERRORS)
UNLEARNED, ZERO = "λ = 16", "zero action"


def measure(lab: Lab) -> dict[str, Any]:
    """Every policy on the same episodes of the targets; every episode's six numbers."""
    runs = lab.run(
        {(label, repeat): variant for label, variant in VARIANTS.items() for repeat in lab.repeats},
        "physical behaviour",
    )
    policies: dict[Key, Path | None] = {("base", Repeat(place, 0)): base.path for place, base in enumerate(lab.bases)}
    policies[ZERO, Repeat(0, 0)] = None
    policies |= {key: newest_policy(folder) for key, folder in runs.items()}
    rollouts, names = lab.rollouts(policies)
    common = metrics.common_length(rollouts.values())
    on_target = np.isin(next(iter(rollouts.values())).clip, [names.index(target) for target in lab.targets])
    result: dict[str, Any] = {}
    for (label, repeat), rollout in rollouts.items():
        values = metrics.episode_metrics(rollout, common)
        shown = [*MEASURES, *(name + metrics.COMMON for name in ERRORS)]
        result.setdefault(label, {})[str(repeat)] = {name: values[name][on_target].round(5).tolist() for name in shown}
    without_end: dict[str, Any] = {}
    for (label, repeat), numbers in lab.unbounded(policies).items():
        without_end.setdefault(label, {})[str(repeat)] = {
            name: [None if np.isnan(value) else round(float(value), 5) for value in values]
            for name, values in numbers.items()
        }
    return {"policies": result, "unbounded": without_end}


def over_runs(policies: Document, label: str, name: str) -> PlainEstimate:
    """A measure of a kind of policy, over its runs."""
    return over_repeats({repeat: float(np.mean(run[name])) for repeat, run in policies[label].items()})


def minus(policies: Document, label: str, other: str, name: str) -> PlainEstimate:
    """A measure of a kind of policy minus that of each run's own base, or that of zero actions, which have no base."""
    theirs = {base_of(repeat): float(np.mean(run[name])) for repeat, run in policies[other].items()}
    return over_repeats({
        repeat: float(np.mean(run[name])) - theirs[0 if other == ZERO else base_of(repeat)]
        for repeat, run in policies[label].items()
    })  # fmt: skip


def words(name: str) -> str:
    """A measure for a reader."""
    common = ", common steps" if name.endswith(metrics.COMMON) else ""
    return f"{name.removesuffix(metrics.COMMON).replace('_', ' ')}{common}"


def body(document: Document) -> str:
    """Means over the runs, over the steps alive and over the steps that every policy survives."""
    policies = document["results"]["policies"]
    rows = []
    for name in (*MEASURES, *(name + metrics.COMMON for name in ERRORS)):
        unit = UNITS.get(name.removesuffix(metrics.COMMON), "m")
        largest, digits = 1.0 if unit == "share" else np.inf, 1 if name == LENGTH else 3
        cells = [number(within(over_runs(policies, label, name), 0.0, largest), digits) for label in policies]
        rows.append([f"{words(name)}, {unit}", *cells])
    note = (
        "On the targets. Errors over the steps alive flatter a policy that falls at once; common steps are those that "
        "every policy survives. Paper (another library and budget): length 500 to 8-13 steps, anchor position error "
        "0.576 to 0.053-0.055 m, foot contact 0.94 to 0.40-0.56, joint limit violation 0.12 to 0.26.\n"
    )
    return f"{markdown_table(['', *policies], rows)}\n{note}{unbounded_table(document['results'].get('unbounded', {}))}"


def unbounded_table(policies: Document) -> str:
    """What the robot does on the targets without terminations; nothing for older results.

    A run's number is the mean over the episodes in which it is defined.
    """
    if not policies:
        return ""
    rows = []
    for name, label in tables.UNBOUNDED.items():
        rate = name.endswith("_rate")
        lowest = metrics.LOWEST_CONTENT if name == "motion_content" else 0.0
        highest = 1.0 if rate or "share" in label or name == "motion_content" else np.inf
        estimates = (unbounded_over_runs(policies, of, name) for of in policies)
        rows.append([label, *((percent if rate else number)(within(one, lowest, highest)) for one in estimates)])
    note = (
        "The targets without terminations, to the clip's end and 3 s longer with its last frame held, and with "
        "self-collision. `docs/method.md` defines the numbers.\n"
    )
    return f"\n**Without terminations**\n\n{markdown_table(['', *policies], rows)}\n{note}"


def unbounded_over_runs(policies: Document, label: str, name: str) -> PlainEstimate | None:
    """A number of `tables.UNBOUNDED` of a kind of policy, over its runs; None where no run defines it."""
    quantile = {"impact_force_median": 0.5, "impact_force_95": 0.95}.get(name)
    runs = {repeat: run["impact_force" if quantile else name] for repeat, run in policies[label].items()}
    defined = {repeat: [value for value in run if value is not None] for repeat, run in runs.items()}
    found = {
        repeat: float(np.quantile(run, quantile, method="inverted_cdf") if quantile else np.mean(run))
        for repeat, run in defined.items()
        if run
    }
    if not found:
        return None
    if name.endswith("_rate"):
        return rate_over_repeats(found, {repeat: len(run) for repeat, run in defined.items()})
    return over_repeats(found)


def findings(document: Document) -> Iterator[Finding]:
    """Does the policy lack the skill, or does it end its episodes on purpose?"""
    policies = document["results"]["policies"]
    if UNLEARNED not in policies:
        return
    later = minus(policies, UNLEARNED, ZERO, LENGTH)
    evidence = f"length of target episodes minus the zero-action baseline's {number(later, 1)} steps; bound {-SOONER:g}"
    claim = f"{UNLEARNED}: target episodes end no sooner than the zero-action baseline's"
    yield finding(claim, later, -SOONER, evidence, below=False, main=True)
    kinds = (
        (NO_FURTHER_OFF, DEVIATION, ZERO, True, True),
        ("the feet touch the ground less often than the base's", "foot_contact", "base", True, False),
        ("joints exceed their limits more often than the base's", "joint_limit_violation", "base", False, False),
    )
    for claim, name, other, below, is_main in kinds:
        if name in next(iter(policies[other].values())):
            more = minus(policies, UNLEARNED, other, name)
            evidence = f"{words(name)} minus the {other}'s {number(more)}; bound 0"
            yield finding(f"{UNLEARNED}: {claim}", more, 0.0, evidence, below=below, main=is_main)


def answer(document: Document) -> str:
    """How long the robot follows a target, in one sentence."""
    policies = document["results"]["policies"]
    if UNLEARNED not in policies:
        return "No unlearned policy was measured."
    base, zero, unlearned = (number(over_runs(policies, label, LENGTH), 1) for label in ("base", ZERO, UNLEARNED))
    return f"An episode of a target lasts {unlearned} steps; with the base {base}, with zero actions {zero}."


def draw(document: Document) -> Figure:
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
    title="What does the robot do on a forgotten clip?",
    claim="The robot fails at a forgotten clip because it lacks the skill, and does not act against it.",
    measure=measure,
    body=body,
    draw=draw,
    findings=findings,
    answer=answer,
    theirs="an episode of a target lasts 500 steps with the base and 8 to 13 after unlearning",
)

if __name__ == "__main__":
    main(STUDY)
