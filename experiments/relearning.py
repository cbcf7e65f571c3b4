"""How fast is a forgotten motion learned again, and how fast one that was never learned? (paper, fig. 8)

Plain fine-tuning on all clips, from four starts: the unlearned policy, one that learned the kept clips from the base
and was never trained on a target, one retrained without the targets, and a random one. If the unlearned policy needs
far fewer target steps than those that were never trained on the targets, the motion was hidden and not forgotten.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.evaluation.document import FILE, Estimate, read_evaluation
from forgetmimic_jax.evaluation.plots import new_figure
from forgetmimic_jax.evaluation.relearning import (
    DECISIVE,
    LEVELS,
    Lasted,
    at_first,
    lasted,
)
from forgetmimic_jax.evaluation.repeats import Repeat, over_repeats, units
from forgetmimic_jax.evaluation.skill import retained, skills
from forgetmimic_jax.evaluation.tables import KEPT, markdown_table, number, percent, share
from forgetmimic_jax.studies import paper
from forgetmimic_jax.studies.claim import Between, Finding, finding_between
from forgetmimic_jax.studies.conduct import main
from forgetmimic_jax.studies.lab import Key, Lab, newest_policy
from forgetmimic_jax.studies.policies import retrained_in_words
from forgetmimic_jax.studies.study import ITERATIONS, Document, Study
from forgetmimic_jax.studies.variants import TRACKING, within
from forgetmimic_jax.training.checkpoint import read_info
from forgetmimic_jax.unlearning.method import FINE_TUNING, SHORT
from forgetmimic_jax.unlearning.registry import method_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EVALUATIONS = 20
CONTROLS = ("distilled", "retrained")  # which can do the kept clips and were never trained on a target
UNUSABLE = "the control is unusable"
COMPETENT = f"A control needs at least {share(KEPT)} with its whole interval; one that has less decides nothing."
HEAD_START = 0.8  # of a level: a control that starts above that says little of how fast it is reached


def measure(lab: Lab) -> dict[str, Any]:
    """First the policies to start from, then their relearning."""
    length = {"iterations": ITERATIONS[lab.options.preset]}
    trials: dict[Key, dict[str, Any]] = {("unlearned", repeat): length for repeat in lab.repeats}
    trials |= {("distilled", repeat): {**length, "method": "distill"} for repeat in lab.repeats}
    trials |= {("retrained", repeat): variant for repeat, variant in lab.retrained.items()}
    folders = lab.run(trials, "policies to relearn from")
    if lab.controls:  # each relearns with every seed
        trained = {repeat: folders.get(("retrained", Repeat(repeat.base, 0))) for repeat in lab.repeats}
        folders |= {("retrained", repeat): folder for repeat, folder in trained.items() if folder}
    policies = {key: newest_policy(folder) for key, folder in folders.items()}
    relearned = lab.run(relearning_runs(lab, policies), "relearning")
    base: dict[str, float] = {}
    curves: dict[str, Any] = {label: {} for label, _ in relearned}
    for repeat in lab.repeats:
        starts = {label: policy for (label, of), policy in policies.items() if of == repeat}
        first = lab.as_watched({"base": lab.bases[repeat.base].path, **starts}, repeat.seed)
        base[str(repeat)] = _tracking(first["base"], lab.targets)
        for (label, of), folder in relearned.items():
            if of == repeat:
                curves[label][str(repeat)] = curve_of(folder, lab.targets, first.get(label))
    return {"base": base, "starts": curves, "kept_skill": measured_skills(folders)}


def measured_skills(folders: Mapping[Key, Path]) -> dict[str, dict[str, Any]]:
    """By start and repeat: share of the base's skill on the kept clips that the policy retains.

    Args:
        folders: by start and repeat, the run that trained or evaluated the policy.
    """
    found: dict[str, dict[str, Any]] = {}
    for (label, repeat), folder in folders.items():
        result = method_of(read_info(newest_policy(folder)).config).result
        kept = skills(read_evaluation(folder / FILE).policies[result], target=False)
        if kept:
            found.setdefault(label, {})[str(repeat)] = msgspec.to_builtins(retained(kept).estimate)
    return found


def relearning_runs(lab: Lab, policies: Mapping[Key, Path]) -> dict[Key, dict[str, Any]]:
    """The options of each relearning run, by start and repeat.

    All of them have the same fixed step size and no KL to their start; settings of their own would be those that they
    were trained with. On a laptop half of the starts are on the targets, as in unlearning: whoever wants the targets
    back would do the same.
    """
    name = lab.options.preset
    pace = {**SHORT, "schedule": "fixed", "base_kl": 0.0} if name == "cpu" else {}
    alike = [f"ppo.{setting}={json.dumps(value)}" for setting, value in pace.items()]
    alike += ["wrench.max_gain=0.0", f"sampling.target_share={FINE_TUNING.target_share.get(name, 0.0)}"]
    watched = {"clips": "all", "set": [*lab.watched(EVALUATIONS), *alike]}
    runs: dict[Key, dict[str, Any]] = {
        key: {**watched, "method": "finetune", "base": policy} for key, policy in policies.items()
    }
    fresh = {**watched, "method": "retrain", "sampler": "uniform_clips"}
    # A fresh policy has no base: with each further base the same training would count once more.
    return runs | {("fresh", repeat): fresh for repeat in lab.repeats if repeat.base == 0}


def _tracking(clips: Mapping[str, Mapping[str, float]], targets: tuple[str, ...]) -> float:
    """Survival-weighted tracking, mean of the targets."""
    return float(np.mean([clips[target][TRACKING] for target in targets]))


def curve_of(
    folder: Path, targets: tuple[str, ...], at_first: Mapping[str, Mapping[str, float]] | None
) -> dict[str, list[float]]:
    """Tracking on the targets, and the target steps until then, at every evaluation of a relearning run.

    Args:
        folder: of the run.
        targets: clips.
        at_first: the policy that the run started from, clip by clip, on the same episodes; None for a fresh one.
    """
    rows, log = read_rows(folder / "evaluations.jsonl"), read_rows(folder / "metrics.jsonl")
    on_target = np.diff([0, *(row["environment_steps"] for row in log)]) * [row["target/step_share"] for row in log]
    counted = ([0, *(row["iteration"] for row in log)], [0.0, *np.cumsum(on_target)])
    start = [] if at_first is None else [(0, _tracking(at_first, targets), 0.0)]
    points = [
        (row["iteration"], _tracking(row["clips"], targets), float(np.interp(row["iteration"], *counted)))
        for row in rows
    ]
    iterations, tracking, steps = zip(*start, *points, strict=True)
    return {"iterations": list(iterations), "tracking": list(tracking), "target_steps": list(steps)}


def body(document: Document) -> str:
    """Iterations and target steps until each share of the base, over the runs."""
    results = document["results"]
    rows = []
    for label in results["starts"]:
        for level in LEVELS:
            found = lasted(results, label, level)
            reached = sum(run.there for run in found.values())
            cells = []
            for place in (0, 1):
                mean = over_repeats({repeat: run[place] for repeat, run in found.items()})
                cells.append(number(mean, 0) if reached == len(found) else f"more than {mean['mean']:,.0f}")
            before = at_first(results, label)
            first = percent(within(over_repeats(before), 0.0, np.inf)) if before else ""
            kept = "" if label == "fresh" else kept_in_words(kept_skills(results, label))
            rows.append([label, kept, first, share(level), f"{reached} of {len(found)}", *cells])
    theirs = ", ".join(f"{iterations:,} for {clips}" for clips, iterations in paper.RELEARNING.items())
    note = (
        f"Kept: share of the base's skill on the kept clips, the lowest of the runs. {COMPETENT} At the start and "
        "shares: of the base's survival-weighted tracking on the targets, "
        f"{number(over_repeats(results['base']))}, on the same episodes. A share is reached at "
        "the first of two evaluations in a row that are not below it. More than: a run that never reached it counts "
        "with its end. No start is regularised towards a base, and with the cpu preset half of the starts are on the "
        "targets. Fresh: a random policy, one for each seed whatever the base. It decides no claim: it is slower than "
        "any policy that can do the kept clips, whether that one forgot the targets or never knew them. "
        f"{retrained_in_words(document['conditions'])} The paper (another library and budget) took {theirs} "
        "until 95 % of its tracking while alive, from its unlearned policy; it has no control.\n"
    )
    header = [
        "start",
        "kept",
        "at the start",
        "share of the base",
        "runs that reached it",
        "iterations",
        "target steps",
    ]
    return f"{markdown_table(header, rows)}\n{note}"


def kept_skills(results: Mapping[str, Any], start: str) -> dict[str, Estimate]:
    """By repeat: share of the base's skill on the kept clips that a start retains; absent where it is not known."""
    return msgspec.convert(results.get("kept_skill", {}).get(start, {}), dict[str, Estimate])


def kept_in_words(skills: Mapping[str, Estimate]) -> str:
    """The lowest of the skills; "unknown" without any."""
    return percent(min(skills.values(), key=_low)) if skills else "unknown"


def competent(results: Mapping[str, Any], control: str) -> list[str]:
    """The repeats whose control retains KEPT of the kept clips' skill with its whole interval."""
    skills = kept_skills(results, control)
    return [repeat for repeat in results["starts"][control] if repeat in skills and _low(skills[repeat]) >= KEPT]


def _low(skill: Estimate) -> float:
    return 0.0 if skill.low is None else skill.low


def findings(document: Document) -> Iterator[Finding]:
    """Fig. 8, with the controls that the paper lacks."""
    results = document["results"]
    for control, level in itertools.product(CONTROLS, LEVELS):
        if results["starts"].get("unlearned") and results["starts"].get(control):
            yield _no_sooner(results, control, level)


def answer(document: Document) -> str:
    """How much longer the unlearned policy needs, in one sentence."""
    results, parts = document["results"], []
    for control in CONTROLS:
        if not (results["starts"].get("unlearned") and results["starts"].get(control)):
            continue
        differences = steps_more(results, control, DECISIVE)
        if differences:
            n = over_repeats(dict.fromkeys(differences, 0.0))
            parts.append(f"{steps_in_words(differences)} ({control}, n = {units(n)})")
        else:
            parts.append(f"unusable ({control}, kept skill {kept_in_words(kept_skills(results, control))})")
    return (
        f"Steps on the targets until {share(DECISIVE)} of the base's tracking, of the unlearned policy minus of one "
        f"that was never trained on them: {'; '.join(parts) or 'no control'}."
    )


def _no_sooner(results: Mapping[str, Any], control: str, level: float) -> Finding:
    """The unlearned policy needs no fewer target steps than a control until a share `level` of the base."""
    mine, theirs = lasted(results, "unlearned", level), lasted(results, control, level)
    claim = f"{share(level)} of the tracking comes back after no fewer target steps than a {control} policy needs"
    differences = steps_more(results, control, level)
    if not differences:
        evidence = f"{control}: {kept_in_words(kept_skills(results, control))} of the kept clips' skill; {COMPETENT}"
        return Finding(claim, UNUSABLE, evidence.rstrip("."), 0)
    evidence = f"target steps until {share(level)}, unlearned minus {control} {steps_in_words(differences)}; bound 0"
    mean = float(np.mean([theirs[repeat].target_steps for repeat in differences]))
    all_there = all(theirs[repeat].there for repeat in differences)
    evidence += f"; {control} {'' if all_there else 'more than '}{mean:,.0f}"
    for label, of in (("unlearned", mine), (control, theirs)):
        never = sum(not of[repeat].there for repeat in differences)
        evidence += f"; {label} never got there in {never} of {len(differences)} runs" if never else ""
    unusable = len(set(mine) & set(theirs)) - len(differences)
    evidence += f"; {unusable} more {control} unusable" if unusable else ""
    head_start = float(np.mean([at_first(results, control).get(repeat, 0.0) for repeat in differences]))
    if head_start >= HEAD_START * level:
        n = over_repeats(dict.fromkeys(differences, 0.0))["n"]
        return Finding(claim, "the control starts near it", f"{evidence}, and starts at {share(head_start)}", n)
    return finding_between(claim, differences, 0.0, evidence, below=False, main=level == DECISIVE)


def steps_more(results: Mapping[str, Any], control: str, level: float) -> dict[str, Between]:
    """By repeat: how many more target steps the unlearned policy needs than a usable control, until a share `level`."""
    mine, theirs = lasted(results, "unlearned", level), lasted(results, control, level)
    return {at: more_steps(mine[at], theirs[at]) for at in competent(results, control) if at in mine}


def steps_in_words(differences: Mapping[str, Between]) -> str:
    """The mean with its interval; run by run where a run that never got there only bounds the difference."""
    if all(low == high for low, high in differences.values()):
        return number(over_repeats({repeat: low for repeat, (low, _) in differences.items()}), 0)
    return f"{', '.join(map(_in_words, differences.values()))} (run by run)"


def _in_words(difference: Between) -> str:
    low, high = difference
    if low == high:
        return f"{low:,.0f}"
    if math.isfinite(low):
        return f"at least {low:,.0f}"
    return f"at most {high:,.0f}" if math.isfinite(high) else "unknown"


def more_steps(unlearned: Lasted, control: Lasted) -> Between:
    """How many more target steps the unlearned policy needed than a control: a run that never got there needs more."""
    difference = unlearned.target_steps - control.target_steps
    return Between(difference if control.there else -math.inf, difference if unlearned.there else math.inf)


def draw(document: Document) -> Figure:
    """Tracking on the targets over iterations and over target steps."""
    base = float(np.mean(list(document["results"]["base"].values())))
    figure = new_figure(width=10.0, height=4.0)
    for place, x in enumerate(("iterations", "target_steps")):
        axes = figure.add_subplot(1, 2, place + 1)
        for colour, (label, runs) in enumerate(document["results"]["starts"].items()):
            for number_, curve in enumerate(runs.values()):
                axes.plot(curve[x], curve["tracking"], color=f"C{colour}", label="" if number_ else label)
        for level in LEVELS:
            axes.axhline(level * base, color="0.7", linestyle=":")
        axes.set_xlabel(x.replace("_", " "))
        axes.locator_params(axis="x", nbins=6)
        axes.set_ylabel("survival-weighted tracking on the targets")
    figure.axes[0].legend(frameon=False)
    return figure


STUDY = Study(
    name="relearning",
    title="How fast does a forgotten motion come back?",
    claim="A forgotten motion comes back no faster than one that was never learned.",
    iterations={"cpu": 300, "paper": 10_000},
    watches=True,
    measure=measure,
    body=body,
    draw=draw,
    findings=findings,
    answer=answer,
    theirs="4,250 to 7,500 iterations until 95 % of its tracking while alive; no control",
    conditions=lambda lab: lab.control_conditions(),
)

if __name__ == "__main__":
    main(STUDY)
