"""How fast does a forgotten motion come back, and how fast does one that was never there come? (paper, fig. 8)

Plain fine-tuning on all clips, from the unlearned policy, from one that learned the kept clips from the base and never
lived a target, from one retrained without the targets, and from scratch. If the unlearned policy needs far fewer target
steps than those that never had them, the motion was hidden and not forgotten.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.evaluation import paper, statistics
from forgetmimic_jax.evaluation.document import FILE, read_evaluation
from forgetmimic_jax.evaluation.plots import new_figure
from forgetmimic_jax.evaluation.relearning import Origin, Origins, at_first, comparable_settings, lasted
from forgetmimic_jax.evaluation.tables import markdown_table, number, percent
from forgetmimic_jax.evaluation.variants import within
from forgetmimic_jax.evaluation.verdict import retained, skills
from forgetmimic_jax.settings.config import load_config
from forgetmimic_jax.studies.study import ITERATIONS, Lab, Study, main, newest_policy
from forgetmimic_jax.training.checkpoint import policy_hash
from forgetmimic_jax.unlearning.method import FINE_TUNING, SHORT
from forgetmimic_jax.unlearning.registry import method_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EVALUATIONS = 20
SHARES = (0.5, 0.8, 0.95)  # of the base's survival-weighted tracking on the targets


def measure(lab: Lab) -> dict[str, Any]:
    """First the policies to start from, then their relearning."""
    given = {"iterations": ITERATIONS[lab.options.budget]}
    asked: dict[tuple[str, int], dict[str, Any]] = {("unlearned", seed): {**given, "seed": seed} for seed in lab.seeds}
    asked |= {("distilled", seed): {**given, "method": "distill", "seed": seed} for seed in lab.seeds}
    retrain = {"method": "retrain", "iterations": lab.control_iterations}
    asked |= {("retrained", seed): {**retrain, "seed": seed} for seed in lab.control_seeds}
    folders = lab.run(asked, "policies to relearn from")
    policies = {key: newest_policy(folder) for key, folder in folders.items()}
    # A start's own settings would be its training's: all of them relearn at the same fixed pace and held by nothing. On
    # a laptop the targets have as many of the starts as in unlearning: whoever wants them back would do the same.
    on_laptop = lab.options.budget == "cpu"
    pace = {**SHORT, "schedule": "fixed", "base_kl": 0.0} if on_laptop else {}
    alike = [f"ppo.{name}={json.dumps(value)}" for name, value in pace.items()]
    alike += ["wrench.max_gain=0.0", f"sampling.target_share={FINE_TUNING.target_share['cpu'] if on_laptop else 0.0}"]
    watched = {"clips": "all", "set": [*lab.watched(EVALUATIONS), *alike]}
    relearn: dict[tuple[str, int], dict[str, Any]] = {
        (label, seed): {**watched, "method": "finetune", "base": policy, "seed": seed}
        for (label, seed), policy in policies.items()
    }
    relearn |= {
        ("fresh", seed): {**watched, "method": "retrain", "sampler": "uniform_clips", "seed": seed}
        for seed in lab.seeds
    }
    relearned = lab.run(relearn, "relearning")
    base: dict[str, float] = {}
    curves: dict[str, Any] = {label: {} for label, _ in relearned}
    for seed in lab.seeds:
        starts = {label: policy for (label, of), policy in policies.items() if of == seed}
        at_first = lab.as_watched({"base": lab.base, **starts}, seed)
        base[str(seed)] = _tracking(at_first["base"], lab.targets)
        for (label, of), folder in relearned.items():
            if of == seed:
                curves[label][str(seed)] = curve_of(folder, lab.targets, at_first.get(label))
    return {"base": base, "starts": curves, "origins": msgspec.to_builtins(origins(lab, folders))}


def origins(lab: Lab, folders: Mapping[tuple[str, int], Path]) -> Origins:
    """How the policies of each start were trained, so that a report can tell whether the curves belong to its run.

    Args:
        lab: of the study.
        folders: by start and seed, the run that trained the policy.
    """
    starts: dict[str, Origin] = {}
    for (label, seed), folder in folders.items():
        config = load_config(folder / "config.yaml")
        origin = starts.setdefault(label, Origin(comparable_settings(config), {}))
        kept = skills(read_evaluation(folder / FILE).policies[method_of(config).result], target=False)
        if kept:
            origin.kept_skill[str(seed)] = retained(kept).estimate
    return Origins(policy_hash(lab.info), starts)


def _tracking(clips: Mapping[str, Mapping[str, float]], targets: tuple[str, ...]) -> float:
    """Survival-weighted tracking, mean of the targets."""
    return float(np.mean([clips[target]["survival_weighted_tracking"] for target in targets]))


def curve_of(
    folder: Path, targets: tuple[str, ...], at_first: Mapping[str, Mapping[str, float]] | None
) -> dict[str, list[float]]:
    """Tracking on the targets, and the target steps lived until then, at every evaluation of a relearning run.

    Args:
        folder: of the run.
        targets: clips.
        at_first: the policy that the run started from, clip by clip, on the same episodes; None for a fresh one.
    """
    rows, log = (read_rows(folder / name) for name in ("evaluations.jsonl", "metrics.jsonl"))
    lived = np.diff([0, *(row["environment_steps"] for row in log)]) * [row["target/step_share"] for row in log]
    counted = ([0, *(row["iteration"] for row in log)], [0.0, *np.cumsum(lived)])
    start = [] if at_first is None else [(0, _tracking(at_first, targets), 0.0)]
    points = [
        (row["iteration"], _tracking(row["clips"], targets), float(np.interp(row["iteration"], *counted)))
        for row in rows
    ]
    iterations, tracking, steps = zip(*start, *points, strict=True)
    return {"iterations": list(iterations), "tracking": list(tracking), "target_steps": list(steps)}


def tell(document: Mapping[str, Any]) -> str:
    """Iterations and target steps until each share of the base, over the seeds that got there."""
    results = document["results"]
    rows = []
    for label in results["starts"]:
        for share in SHARES:
            found = lasted(results, label, share).values()
            reached = sum(run.there for run in found)
            cells = []
            for place in (0, 1):
                mean = statistics.over_seeds([run[place] for run in found])
                cells.append(number(mean, 0) if reached == len(found) else f"more than {mean['mean']:,.0f}")
            before = list(at_first(results, label).values())
            first = percent(within(statistics.over_seeds(before), 0.0, np.inf)) if before else ""
            rows.append([label, first, f"{100 * share:.0f} %", f"{reached} of {len(found)}", *cells])
    theirs = ", ".join(f"{iterations:,} for {clips}" for clips, iterations in paper.RELEARNING.items())
    note = (
        f"At first and shares: of the base's survival-weighted tracking on the targets, "
        f"{number(statistics.over_seeds(list(results['base'].values())))}, on the same episodes, reached at the first "
        "of two evaluations in a row that are not below; more than: a run that never got there counts with its end. "
        "Whatever the start, with the cpu budget relearning is held by no anchor and has half of its starts on the "
        "targets. "
        f"The retrained policy has had {document['asked']['control_iterations']:,} iterations: as little as that is a "
        f"reference for the first steps only. The paper (another library and budget) took {theirs} until 95 % of its "
        "tracking while alive, from its unlearned policy; it has no control.\n"
    )
    header = ["start", "at first", "share of the base", "runs that reached it", "iterations", "target steps"]
    return f"{markdown_table(header, rows)}\n{note}"


def draw(document: Mapping[str, Any]) -> Figure:
    """Tracking on the targets over iterations and over target steps."""
    base = float(np.mean(list(document["results"]["base"].values())))
    figure = new_figure(width=10.0, height=4.0)
    for place, x in enumerate(("iterations", "target_steps")):
        axes = figure.add_subplot(1, 2, place + 1)
        for colour, (label, runs) in enumerate(document["results"]["starts"].items()):
            for number_, curve in enumerate(runs.values()):
                axes.plot(curve[x], curve["tracking"], color=f"C{colour}", label="" if number_ else label)
        for share in SHARES:
            axes.axhline(share * base, color="0.7", linestyle=":")
        axes.set_xlabel(x.replace("_", " "))
        axes.locator_params(axis="x", nbins=6)
        axes.set_ylabel("survival-weighted tracking on the targets")
    figure.axes[0].legend(frameon=False)
    return figure


STUDY = Study(
    name="relearning",
    title="How fast does a forgotten motion come back?",
    iterations={"cpu": 300, "paper": 10_000},
    retrains=True,
    watches=True,
    measure=measure,
    tell=tell,
    draw=draw,
)

if __name__ == "__main__":
    main(STUDY)
