"""The paper's claims, one by one, against the numbers of our studies: `python -m experiments.claims`.

Fills the block of `experiments/README.md` from the studies' JSON alone. A claim is a number and a bound: it holds where
the number's whole 95 % interval over the seeds lies on the right side, does not hold where it lies on the wrong side,
and is open between. With one seed there is no interval, and the word is only which way it points.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments import comparison, membership, relearning, validity
from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.basics.files import write_atomically
from forgetmimic_jax.evaluation import statistics
from forgetmimic_jax.evaluation import variants as of_variants
from forgetmimic_jax.evaluation.metrics import ZERO_ACTION
from forgetmimic_jax.evaluation.relearning import at_first, lasted
from forgetmimic_jax.evaluation.statistics import Estimate
from forgetmimic_jax.evaluation.tables import FORGOTTEN, markdown_table, number, percent
from forgetmimic_jax.evaluation.variants import DEVIATION, within
from forgetmimic_jax.studies.claim import Finding, finding_between, judged
from forgetmimic_jax.studies.study import RESULTS
from forgetmimic_jax.sweep import half_gone_by_seed, told_half_gone

README = Path(__file__).parent / "README.md"
BLOCK = re.compile(r"(<!-- claims:start -->\n).*?(<!-- claims:end -->)", re.DOTALL)

SUCCESS, TRACKING = "success_rate", "survival_weighted_tracking"
LENGTH, RATIO = "episode_length", "survival_weighted_degradation_ratio"
NONE = 0.05  # of episodes: a success rate below it counts as none
POINTS = 0.05  # of success that kept clips may lose
NO_FURTHER_OFF = "while it stands it is no further off a target than the robot without a policy"
SOONER = 1.0  # steps by which an episode may end before doing nothing would end it
CONTROLS = ("distilled", "retrained", "fresh")  # never lived a target: what relearning is compared with
HEAD_START = 0.8  # of a level: a control that starts above that says little of how fast it is reached
ARFT, PLAIN_ARFT = "arft", "arft, plain PPO"
UNIFORM, FROZEN, ADAPTIVE = "arft, uniform clips", "arft, frozen", "arft, adaptive"
SAMPLERS = (UNIFORM, "arft, uniform bins", FROZEN, ADAPTIVE)
BASELINES = tuple(f"{name.replace('_', ' ')}, plain PPO" for name in comparison.PAPERS)
INCOMPLETE = ("random reward, plain PPO", "trajdeleter, plain PPO")  # which the paper says forget less


def gained(variants: Mapping[str, Any], label: str, other: str | None, group: str, metric: str) -> Estimate | None:
    """A variant's number less another's of the same seed, or less the base's; None where no seed has both."""
    found = of_variants.gained(variants, label, other, group, metric)
    return statistics.over_seeds(list(found.values())) if found else None


def effect(variants: Mapping[str, Any], pairs: Sequence[tuple[str, str]], group: str) -> Estimate | None:
    """What one switch changes in tracking: the mean of its `gained`, whatever else is set; None where no seed has all.

    Args:
        variants: of the comparison.
        pairs: the variants with and without it.
        group: target or kept.
    """
    each = [of_variants.gained(variants, *pair, group, TRACKING) for pair in pairs]
    means = [float(np.mean([of[seed] for of in each])) for seed in each[0] if all(seed in of for of in each)]
    return statistics.over_seeds(means) if means else None


def of_validity(document: Mapping[str, Any]) -> Iterator[Finding]:
    """Fig. 2: forgotten and kept; at the length of `make unlearn` also against the control, and by their ratio."""
    variants = document["results"]["variants"]
    for label, variant in variants.items():
        if label == validity.at_length(validity.CONTROL):
            continue
        target = variant["over_seeds"]["policy"]["target"]
        success, skill = target[SUCCESS], target.get("skill")
        claim = f"{label}: the targets no longer succeed"
        evidence = f"target success {percent(within(success, 0.0, 1.0))}; at most {NONE:.0%} asked"
        yield Finding(claim, judged(success, NONE), evidence, success["n"])
        if skill:
            evidence = f"{percent(skill)} of the skill above the zero action is left; at most {FORGOTTEN:.0%} asked"
            yield Finding(f"{label}: the skill is gone", judged(skill, FORGOTTEN), evidence, skill["n"])
        yield from _kept(variants, label, None, f"{label}: the kept clips stay as they were")
    label, control = validity.at_length("λ = 16"), validity.at_length(validity.CONTROL)
    if label in variants:
        yield from _kept(variants, label, control, f"{label}: the kept clips are what fine-tuning alone gives")
        ratio = variants[label]["over_seeds"]["policy"][RATIO]
        evidence = f"target over kept tracking {number(within(ratio, 0.0, np.inf), 3)}; {validity.ASKED_RATIO:g} asked"
        claim = f"{label}: the targets' tracking is under a tenth of the kept clips'"
        yield Finding(claim, judged(ratio, validity.ASKED_RATIO), evidence, ratio["n"])
        runs = variants[label]["seeds"].values()
        lengths = [(run["policy"]["target"][LENGTH], run[ZERO_ACTION]["target"][LENGTH]) for run in runs]
        later = statistics.over_seeds([policy - floor for policy, floor in lengths])
        evidence = f"target episodes last {number(later, 1)} steps on those without a policy of the same seed"
        claim = f"{label}: short episodes mean a lost skill, and not an episode ended on purpose"
        yield Finding(claim, judged(later, -SOONER, below=False), evidence, later["n"])
        off = [
            (run["policy"]["target"][DEVIATION], run[ZERO_ACTION]["target"][DEVIATION])
            for run in runs
            if DEVIATION in run["policy"]["target"]
        ]
        if off:
            further = statistics.over_seeds([policy - floor for policy, floor in off])
            claim = f"{label}: {NO_FURTHER_OFF}"
            without = np.mean([floor for _, floor in off])
            evidence = (
                f"largest key body error {number(further, 3)} m more than the {without:.3f} m without a policy, "
                "seed by seed, on the steps that both and the base survive"
            )
            yield Finding(claim, judged(further, 0.0), evidence, further["n"])


def of_comparison(document: Mapping[str, Any]) -> Iterator[Finding]:
    """Table 1: against the control, the other methods, and the ablation."""
    variants = document["results"]["variants"]
    claim = "λ = 16: the kept clips are what fine-tuning without an anti-reward gives"
    yield from _kept(variants, ARFT, comparison.CONTROL, claim)
    for method in BASELINES:
        kept = gained(variants, method, PLAIN_ARFT, "kept", TRACKING)
        if kept:
            evidence = f"kept tracking {number(kept, 2)} on that of {PLAIN_ARFT}"
            yield Finding(f"{method}, hurts the kept clips more than arft", judged(kept, 0.0), evidence, kept["n"])
    for method in INCOMPLETE:
        target = gained(variants, method, PLAIN_ARFT, "target", TRACKING)
        if target:
            evidence = f"target tracking {number(target, 2)} on that of {PLAIN_ARFT}"
            verdict = judged(target, 0.0, below=False)
            yield Finding(f"{method}, forgets less than arft", verdict, evidence, target["n"])
    with_wrench = {label: f"{label}, wrench" for label in SAMPLERS}
    switches = {
        "adaptive RSI": (
            [(ADAPTIVE, UNIFORM), (with_wrench[ADAPTIVE], with_wrench[UNIFORM])],
            "than with uniform clips, mean of wrench and none",
        ),
        "the feedback of adaptive RSI": (
            [(ADAPTIVE, FROZEN), (with_wrench[ADAPTIVE], with_wrench[FROZEN])],
            "than frozen at the base's shares, mean of wrench and none",
        ),
        "the wrench": (
            [(wrench, label) for label, wrench in with_wrench.items()],
            "than without, mean of the samplers",
        ),
    }
    for name, (pairs, otherwise) in switches.items():
        for group, claim in (("target", f"{name} resists forgetting"), ("kept", f"{name} costs the kept clips")):
            change = effect(variants, pairs, group)
            if change:
                verdict = judged(change, 0.0, below=group == "kept")
                yield Finding(claim, verdict, f"{group} tracking {number(change, 2)} more {otherwise}", change["n"])


def of_penalty(document: Mapping[str, Any]) -> Iterator[Finding]:
    """Table 2: where the targets tip over."""
    variants = document["results"]["variants"]
    crossed = half_gone_by_seed(variants)
    if crossed:
        crit = next(iter(variants.values()))["over_seeds"].get("lambda_crit")
        evidence = f"half of the skill is gone at λ = {told_half_gone(crossed)}"
        evidence += f"; λ_crit on the base's steps {number(crit, 2)}" if crit else ""
        yield finding_between("forgetting sets in below λ = 8 = W", crossed, 8.0, evidence)


def of_heat_map(document: Mapping[str, Any]) -> Iterator[Finding]:
    """Fig. 3: wear."""
    groups, bound = document["results"]["groups"], 0.95
    start, end = groups[0]["kept"][TRACKING], groups[-1]["kept"][TRACKING]
    evidence = f"kept tracking {number(start, 2)} at the start, {number(end, 2)} at the end; {bound:.0%} of it asked"
    verdict = judged(end, bound * start["mean"], below=False)
    claim = f"{document['asked']['iterations']:,} iterations do not wear the kept clips down"
    yield Finding(claim, verdict, evidence, end["n"])


def of_motion_types(document: Mapping[str, Any]) -> Iterator[Finding]:
    """Fig. 4 and the H2's table: any motion, and any number of them, and the others stay."""
    variants = document["results"]["variants"]
    for label, variant in variants.items():
        skill = variant["over_seeds"]["policy"]["target"].get("skill")
        if skill:
            evidence = f"{percent(skill)} of the skill is left"
            claim = f"{label} can be forgotten on the {document['asked']['robot'].upper()}"
            yield Finding(claim, judged(skill, FORGOTTEN), evidence, skill["n"])
        yield from _kept(variants, label, None, f"{label}: the kept clips stay as they were")


def of_physical_behaviour(document: Mapping[str, Any]) -> Iterator[Finding]:
    """Fig. 6: forgotten, or sabotaged?"""
    policies = document["results"]["policies"]

    def of(label: str, name: str) -> Estimate:
        return statistics.over_seeds([float(np.mean(run[name])) for run in policies[label].values()])

    base, floor = (of(label, LENGTH)["mean"] for label in ("base", "zero action"))
    for label in ("λ = 8", "λ = 16"):
        if label in policies:
            found = of(label, LENGTH)
            steps = f"{number(found, 1)} steps, the base's {base:.1f}, without a policy {floor:.1f}"
            claim = f"{label}: short episodes mean a lost skill, and not an episode ended on purpose"
            short = found["mean"] < 0.5 * (base + floor)
            verdict = judged(found, floor - SOONER, below=False) if short else "not short"
            yield Finding(claim, verdict, f"target episodes last {steps}", found["n"])
    label = "λ = 16"
    kinds = (
        ("the feet are less on the floor than the base's", "foot_contact", "base", True),
        ("joints are more often beyond their limits than the base's", "joint_limit_violation", "base", False),
        (NO_FURTHER_OFF, DEVIATION, "zero action", True),
    )
    for claim, name, other, below in kinds:
        if all(name in run for run in policies.get(label, {"": {}}).values()):
            found, theirs = of(label, name), of(other, name)["mean"]
            kind = name.replace("_", " ").replace(" common", ", on the steps that all survive,")
            evidence = f"{kind} {number(within(found, 0.0, np.inf), 3)}, {other} {theirs:.3f}"
            yield Finding(f"{label}: {claim}", judged(found, theirs, below=below), evidence, found["n"])


def of_training_dynamics(document: Mapping[str, Any]) -> Iterator[Finding]:
    """Fig. 7: what the paper reads off the curves of its two configurations, last value on the first."""
    for label, of in document["results"]["configurations"].items():
        first, last = of["rows"][0], of["rows"][-1]
        forgets = label.startswith("B")
        claims = [("entropy", forgets), *([] if forgets else [("wrench_gain", True), ("top_bin_probability", True)])]
        for name, rises in claims:
            change = difference(last[name], first[name])
            evidence = f"{number(last[name], 3)} after {number(first[name], 3)} at first"
            claim = f"{label}: {name.replace('_', ' ')} {'rises' if rises else 'falls'}"
            yield Finding(claim, judged(change, 0.0, below=not rises), evidence, last[name]["n"])
        if forgets:
            last_anti, bound = last["target/R_anti"], FORGOTTEN * first["target/R_anti"]["mean"]
            evidence = f"R_anti a target step {number(last_anti, 2)}; at least {bound:.2f} asked, a fifth of the first"
            verdict = judged(last_anti, bound, below=False)
            yield Finding(f"{label}: the targets' anti-reward goes to nothing", verdict, evidence, last_anti["n"])


def difference(last: Estimate, first: Estimate) -> Estimate:
    """Of two estimates whose seeds are no longer known one by one: as wide as both intervals together."""
    result: Estimate = {"mean": last["mean"] - first["mean"], "n": last["n"]}
    if "low" in last and "low" in first:
        result |= {"low": last["low"] - first["high"], "high": last["high"] - first["low"]}
    return result


def of_relearning(document: Mapping[str, Any]) -> Iterator[Finding]:
    """Fig. 8, with the controls that the paper lacks."""
    results = document["results"]
    pairs = itertools.product(CONTROLS, relearning.SHARES)
    for control, share in pairs:
        if not {"unlearned", control} <= results["starts"].keys():
            continue
        claim = f"{share:.0%} of the tracking comes back after no fewer target steps than a {control} policy needs"
        mine, theirs = (lasted(results, label, share) for label in ("unlearned", control))
        both = [seed for seed in mine if seed in theirs]
        sooner = statistics.over_seeds([mine[seed].target_steps - theirs[seed].target_steps for seed in both])
        never = {
            label: sum(not of[seed].there for seed in both) for label, of in (("unlearned", mine), (control, theirs))
        }
        verdict = judged(sooner, 0.0, below=False)
        if never["unlearned"] or (never[control] and verdict in ("holds", "one seed: yes")):
            verdict = "open"
        mean = float(np.mean([theirs[seed].target_steps for seed in both]))
        evidence = f"{number(sooner, 0)} target steps more than the {mean:,.0f} of the {control} one of the same seed"
        head_start = float(np.mean([at_first(results, control).get(seed, 0.0) for seed in both]))
        if head_start >= HEAD_START * share:
            verdict, evidence = "the control starts near it", f"{evidence}, which starts at {head_start:.0%}"
        ends = [f"{label} in {count} of {len(both)} runs" for label, count in never.items() if count]
        if ends:
            evidence += f"; not reached, counted with the run's end: {' and '.join(ends)}"
        yield Finding(claim, verdict, evidence, sooner["n"])


def of_membership(document: Mapping[str, Any]) -> Iterator[Finding]:
    """Appendix: the attack."""
    for label, of in document["results"]["policies"].items():
        claim = f"{label}: membership of the targets cannot be told"
        auc, hits = (within(of[name], 0.0, 1.0) for name in ("auc", "tpr_at_5_percent_fpr"))
        guessed = membership.guessed_hits(document["asked"])
        evidence = (
            f"AUC {number(auc, 2)}, guessing 0.5; hits at 5 % false alarms {number(hits, 2)}, guessing {guessed:.2f}"
        )
        yield Finding(claim, membership.verdict(of, guessed), evidence, of["auc"]["n"])


JUDGES: dict[str, Callable[[Mapping[str, Any]], Iterator[Finding]]] = {
    "g1/validity": of_validity,
    "g1/comparison": of_comparison,
    "g1/penalty": of_penalty,
    "g1/heat_map": of_heat_map,
    "g1/motion_types": of_motion_types,
    "h2/number_of_targets": of_motion_types,
    "g1/physical_behaviour": of_physical_behaviour,
    "g1/training_dynamics": of_training_dynamics,
    "g1/relearning": of_relearning,
    "g1/membership": of_membership,
}


def _kept(variants: Mapping[str, Any], label: str, other: str | None, claim: str) -> Iterator[Finding]:
    change = gained(variants, label, other, "kept", SUCCESS)
    if change:
        whose = "the control's" if other else "the base's"
        evidence = f"kept success {percent(change)} on {whose}; at most {POINTS:.0%} lost asked"
        yield Finding(claim, judged(change, -POINTS, below=False), evidence, change["n"])


def table(folder: Path = RESULTS, judges: Mapping[str, Callable] = JUDGES) -> str:
    """Every claim whose study has been measured, and which have not been."""
    rows: list[Sequence[str]] = []
    missing = []
    for study, judge in judges.items():
        path = folder / f"{study}.json"
        if not path.is_file():
            missing.append(Path(study).name)
            continue
        document = json.loads(path.read_text())
        rows += [
            [f"[{Path(study).name}](results/{study}.md)", of.claim, f"**{of.word}**", of.evidence, str(of.seeds)]
            for of in judge(document)
        ]
    text = markdown_table(["study", "claim", "here", "evidence", "seeds"], rows) if rows else ""
    return f"{text}\nNot measured yet: {', '.join(missing)}.\n" if missing else text


def main() -> None:
    """Write the table into its block."""
    text = README.read_text()
    if not BLOCK.search(text):
        raise InputError(f"{README}: no block '<!-- claims:start -->' ... '<!-- claims:end -->' to fill")
    write_atomically(README, BLOCK.sub(lambda block: f"{block[1]}{table()}{block[2]}", text).encode())


if __name__ == "__main__":
    run_command(main)
