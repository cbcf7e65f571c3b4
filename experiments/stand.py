"""What does a robot do on a motion that it forgot by METHOD=stand? (ours)

Each group of targets is forgotten by `stand`, from every base and with every seed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.evaluation.document import read_evaluation
from forgetmimic_jax.evaluation.metrics import BASE, UNLEARNED
from forgetmimic_jax.evaluation.plots import bars, new_figure
from forgetmimic_jax.evaluation.repeats import difference_over_repeats, over_repeats, rate_over_repeats, units
from forgetmimic_jax.evaluation.statistics import PlainEstimate
from forgetmimic_jax.evaluation.tables import markdown_table, number, percent, share
from forgetmimic_jax.studies.claim import Finding, finding
from forgetmimic_jax.studies.conduct import main
from forgetmimic_jax.studies.lab import Lab
from forgetmimic_jax.studies.study import Document, Study
from forgetmimic_jax.studies.targets import usual_groups
from forgetmimic_jax.studies.variants import within
from forgetmimic_jax.tracking.stand import STAND
from forgetmimic_jax.unlearning.stand import PACE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WHERE = {"from_frame_0": "from frame 0", "all_starts": "all starts"}
RATES = {"upright_rate": "upright", "impact_rate": "impact"}
SUCCESS, SKILL, CONTENT, SECONDS = "success_from_frame_0", "skill", "content", "seconds"
KEPT, BEFORE, CHANGE = "kept", "base", "kept_change"  # success on the kept clips, the base's, and the difference
EPISODES = "_episodes"  # after the name of a rate: over how many it is
BOUNDS = {"skill": 0.10, "content": 0.15, "upright": 0.80, "impact": 0.12, "kept": -0.02}


def measure(lab: Lab) -> dict[str, Any]:
    """By group of targets and by repeat: what the targets lost, what the robot does instead, and what was kept."""
    runs = {
        (" + ".join(targets), repeat): {"method": "stand", "targets": ",".join(targets)}
        for repeat in lab.repeats
        for targets in groups(lab)
    }
    found: dict[str, dict[str, Any]] = {}
    for (label, repeat), folder in lab.run(runs, "stand").items():
        found.setdefault(label, {})[str(repeat)] = numbers(folder)
    return {"targets": found}


def groups(lab: Lab) -> list[tuple[str, ...]]:
    """Combat, dance and locomotion; the targets that the study names, or where the library has none of these."""
    return ([] if lab.options.targets else usual_groups(lab)) or [lab.targets]


def numbers(folder: Path) -> dict[str, float]:
    """The numbers of a finished run; those that are undefined are left out."""
    policies = read_evaluation(folder / "evaluation.json").policies
    base, unlearned = policies[BASE], policies[UNLEARNED]
    assert base.kept is not None
    assert unlearned.kept is not None
    assert unlearned.target is not None
    target, unbounded = unlearned.target, unlearned.target.unbounded
    assert unbounded is not None
    rates = {SUCCESS: target.success_rate_from_frame_0, KEPT: unlearned.kept.success_rate}
    rates[BEFORE] = base.kept.success_rate
    for where in WHERE:
        rates |= {f"{name}_{where}": getattr(getattr(unbounded, where), name) for name in RATES}
    found = {**rates, SKILL: target.skill, CONTENT: unbounded.all_starts.motion_content}
    result = {name: value.mean for name, value in found.items() if value is not None and value.mean is not None}
    result |= {f"{name}{EPISODES}": value.n for name, value in rates.items() if value is not None}
    result[CHANGE] = result[KEPT] - result[BEFORE]
    result[SECONDS] = sum(seconds(of) for of in (folder, folder.with_name(f"{folder.name}-{STAND}")))
    return result


def seconds(folder: Path) -> float:
    """What the iterations of a run took."""
    rows = read_rows(folder / "metrics.jsonl") if (folder / "metrics.jsonl").exists() else []
    return float(sum(row["seconds"] for row in rows))


def estimate(runs: Mapping[str, Mapping[str, float]], name: str) -> PlainEstimate | None:
    """A number over the repeats that have it."""
    values = {repeat: of[name] for repeat, of in runs.items() if name in of}
    return over_repeats(values) if values else None


def rate(runs: Mapping[str, Mapping[str, float]], name: str) -> PlainEstimate | None:
    """A rate over the repeats, its interval cut at 0 and 1."""
    values = {repeat: of[name] for repeat, of in runs.items() if name in of}
    return within(rate_over_repeats(values, episodes(runs, name)), 0.0, 1.0) if values else None


def change(runs: Mapping[str, Mapping[str, float]]) -> PlainEstimate:
    """Success on the kept clips minus the base's over the repeats; of older results without their episodes."""
    pairs = {repeat: (of[KEPT], of[BEFORE]) for repeat, of in runs.items() if KEPT in of}
    if len(pairs) < len(runs):
        return over_repeats({repeat: of[CHANGE] for repeat, of in runs.items()})
    return difference_over_repeats(pairs, episodes(runs, KEPT))


def episodes(runs: Mapping[str, Mapping[str, float]], name: str) -> dict[str, int]:
    """How many episodes a rate is over, by repeat; absent in older results."""
    return {repeat: int(of[f"{name}{EPISODES}"]) for repeat, of in runs.items() if f"{name}{EPISODES}" in of}


def body(document: Document) -> str:
    """A row a group of targets."""
    rows = []
    for label, runs in document["results"]["targets"].items():
        cells = [units(minutes(runs)), percent(rate(runs, SUCCESS)), percent(estimate(runs, SKILL))]
        cells.append(number(estimate(runs, CONTENT), 2))
        cells += [percent(rate(runs, f"{name}_{where}")) for name in RATES for where in WHERE]
        cells += [percent(change(runs)), number(minutes(runs), 1)]
        rows.append([label, *cells])
    header = ["targets", "n", f"success, {WHERE['from_frame_0']}", "skill retained", "motion content"]
    header += [f"{words}, {where}" for words in RATES.values() for where in WHERE.values()]
    header += ["kept success minus base", "minutes"]
    note = (
        "upright: share of the target episodes without a fall to the clip's end and 3 s longer, with no other "
        "termination. impact: share with a force of the floor above one body weight on a body that is no foot. motion "
        "content: 1 for the clip's own movement, 0 for a robot that stands. minutes: of the iterations, with those in "
        "which the teacher learns to stand, without the evaluation. Late starts of a short clip can succeed by "
        "standing, since most of a clip's end is standing.\n"
    )
    return f"{markdown_table(header, rows)}\n{note}"


def minutes(runs: Mapping[str, Mapping[str, float]]) -> PlainEstimate:
    """How long the runs trained."""
    return over_repeats({repeat: of[SECONDS] / 60.0 for repeat, of in runs.items()})


def findings(document: Document) -> Iterator[Finding]:
    """Forgotten, standing, and kept, group by group."""
    for label, runs in document["results"]["targets"].items():
        skill, content = estimate(runs, SKILL), estimate(runs, CONTENT)
        if skill:
            evidence = f"skill retained {percent(skill)}; bound {share(BOUNDS['skill'])}"
            yield finding(f"{label}: the skill on the targets is gone", skill, BOUNDS["skill"], evidence)
        if content:
            evidence = f"motion content {number(content, 2)}; bound {BOUNDS['content']:g}"
            yield finding(f"{label}: the robot shows none of the movement", content, BOUNDS["content"], evidence)
        upright, impact = rate(runs, "upright_rate_all_starts"), rate(runs, "impact_rate_all_starts")
        if upright and impact:
            evidence = f"upright {percent(upright)} ({label}); bound {share(BOUNDS['upright'])}"
            claim = f"{label}: the robot stays upright"
            yield finding(claim, upright, BOUNDS["upright"], evidence, below=False, main=True)
            evidence = f"impacts {percent(impact)}; bound {share(BOUNDS['impact'])}"
            yield finding(f"{label}: the robot does not hit the floor", impact, BOUNDS["impact"], evidence)
        kept = change(runs)
        evidence = f"kept success minus the base's {percent(kept)}; bound {share(BOUNDS['kept'])}"
        yield finding(f"{label}: the other clips are kept", kept, BOUNDS["kept"], evidence, below=False)


def answer(document: Document) -> str:
    """Upright and impacts of every group, in one sentence."""
    parts = []
    for label, runs in document["results"]["targets"].items():
        upright, impact = rate(runs, "upright_rate_all_starts"), rate(runs, "impact_rate_all_starts")
        if upright and impact:
            parts.append(f"{percent(upright)} and {percent(impact)} ({label})")
    return (
        "The robot stays upright in, and hits the floor with more than its weight in, this share of the episodes of "
        f"its targets: {'; '.join(parts) or 'not measured'}."
    )


def draw(document: Document) -> Figure:
    """Upright and impact rates of every group."""
    found = document["results"]["targets"]
    figure = new_figure(width=9.0, height=3.5)
    for place, (name, words) in enumerate(RATES.items()):
        axes = figure.add_subplot(1, 2, place + 1)
        series = {where: [rate(runs, f"{name}_{at}") for runs in found.values()] for at, where in WHERE.items()}
        bars(axes, list(found), series)
        axes.set_ylim(0.0, 1.0)
        axes.set_title(words, fontsize="medium")
    figure.axes[-1].legend(fontsize="small", frameon=False)
    return figure


STUDY = Study(
    name="stand",
    title="What does a robot do on a motion that it forgot by METHOD=stand?",
    claim="On a motion that it forgot by METHOD=stand, the robot stays upright.",
    ours=True,
    iterations=PACE.iterations,
    measure=measure,
    body=body,
    draw=draw,
    findings=findings,
    answer=answer,
    own_targets=True,
)

if __name__ == "__main__":
    main(STUDY)
