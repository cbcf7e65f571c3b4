"""Two configurations during training: A with λ = 2, adaptive sampling and the wrench, B with λ = 8 (paper, fig. 7)"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.evaluation.plots import new_figure
from forgetmimic_jax.evaluation.repeats import over_repeats
from forgetmimic_jax.evaluation.statistics import PlainEstimate
from forgetmimic_jax.evaluation.tables import FORGOTTEN, markdown_table, number
from forgetmimic_jax.studies.claim import Finding, finding
from forgetmimic_jax.studies.conduct import main
from forgetmimic_jax.studies.lab import Lab
from forgetmimic_jax.studies.study import Document, Study
from forgetmimic_jax.studies.variants import estimates_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

A, B = "A: λ = 2, adaptive, wrench", "B: λ = 8"
CONFIGURATIONS: dict[str, dict[str, Any]] = {
    A: {"penalty": 2.0, "sampler": "adaptive", "wrench": True},
    B: {"penalty": 8.0},
}
CURVES = (
    *("target/R_anti", "target/tracking_reward", "kept/tracking_reward", "target/lambda_crit", "entropy"),
    *("episode_length", "wrench_gain", "top_bin_probability", "value_loss"),
)
# First and last value of each of the paper's two curves, from its text; its R_anti is a mean over all steps.
THEIRS = {
    "target/R_anti": ("-0.49, -0.53", "-1.11, -0.05"),
    "entropy": ("12.9, 11.9", "22.0, 31.6"),
    "episode_length": ("468, 482", "394, 375"),
    "wrench_gain": ("0.007, 0.026", "0"),
    "top_bin_probability": ("0.013, 0.015", "0.0025"),
    "value_loss": ("0.047, 0.044", "0.614, 0.194"),
}


def measure(lab: Lab) -> dict[str, Any]:
    """The logged curves of both configurations over the repeats."""
    variants = {(label, repeat): of for label, of in CONFIGURATIONS.items() for repeat in lab.repeats}
    runs = lab.run(variants, "training dynamics")
    result = {}
    for label in CONFIGURATIONS:
        folders = {str(repeat): folder for (of, repeat), folder in runs.items() if of == label}
        logs = {
            repeat: {row["iteration"]: row for row in read_rows(folder / "metrics.jsonl")}
            for repeat, folder in folders.items()
        }
        if logs:
            # A run that was stopped and resumed has one row more, at the iteration where it was stopped.
            common = sorted(set.intersection(*map(set, logs.values())))
            curves = {
                repeat: [{name: log[at][name] for name in CURVES if name in log[at]} for at in common]
                for repeat, log in logs.items()
            }
            result[label] = {"iterations": common, "runs": curves}
    return {"configurations": result}


def over_runs(of: Mapping[str, Any]) -> list[Any]:
    """Estimates over the runs of a configuration at every logged iteration."""
    if "runs" not in of:  # stored as estimates
        return of["rows"]
    places = range(len(of["iterations"]))
    return [estimates_of({repeat: rows[place] for repeat, rows in of["runs"].items()}) for place in places]


def risen(of: Mapping[str, Any], name: str, share: float = 1.0) -> PlainEstimate | None:
    """The last value of a curve minus a share of the first, run by run; None where no run has both.

    Results that were stored as means over the runs alone have none.
    """
    ends = {repeat: (rows[0], rows[-1]) for repeat, rows in of.get("runs", {}).items()}
    found = {
        repeat: last[name] - share * first[name]
        for repeat, (first, last) in ends.items()
        if name in first and name in last
    }
    return over_repeats(found) if found else None


def body(document: Document) -> str:
    """Each curve's first and last value."""
    curves = {label: over_runs(of) for label, of in document["results"]["configurations"].items()}
    header = ["", *(f"{label}, {when}" for label in curves for when in ("first", "last"))]
    header += [f"paper's {label.partition(':')[0]}, first and last" for label in CONFIGURATIONS]
    rows = [
        [name.replace("_", " ")]
        + [number(rows[place].get(name)) for rows in curves.values() for place in (0, -1)]
        + list(THEIRS.get(name, ("", "")))
        for name in CURVES
    ]
    note = (
        "R_anti here is a mean over target steps, the paper's over all steps; its numbers are of another library. "
        "Episode length is of the episodes that ended. All environments start anew with the run, so the first value is "
        "of those that fell at once. With the cpu preset B takes half of the starts from the targets, A the share that "
        "its sampler gives them.\n"
    )
    return f"{markdown_table(header, rows)}\n{note}"


def findings(document: Document) -> Iterator[Finding]:
    """What the paper reads off its curves, last value against first."""
    configurations = document["results"]["configurations"]
    claims = [(A, "entropy", False, True), (B, "entropy", True, True)]
    claims += [(A, name, True, False) for name in ("wrench_gain", "top_bin_probability")]
    for label, name, rises, is_main in claims:
        more = risen(configurations.get(label, {}), name)
        if more:
            words = name.replace("_", " ")
            evidence = f"{words} at the end minus that at the start {number(more)} ({label}); bound 0"
            claim = f"{label}: {words} {'rises' if rises else 'falls'}"
            yield finding(claim, more, 0.0, evidence, below=not rises, main=is_main)
    left = risen(configurations.get(B, {}), "target/R_anti", FORGOTTEN)
    if left:
        evidence = f"R_anti of a target step at the end minus a fifth of that at the start {number(left, 2)}; bound 0"
        yield finding(f"{B}: the targets' anti-reward goes to nothing", left, 0.0, evidence, below=False)


def answer(document: Document) -> str:
    """Entropy before and after, in one sentence."""
    ends = {label: over_runs(of) for label, of in document["results"]["configurations"].items()}
    parts = [
        f"from {number(rows[0]['entropy'], 2)} to {number(rows[-1]['entropy'], 2)} ({label})"
        for label, rows in ends.items()
    ]
    return f"The entropy of the policy's actions goes {' and '.join(parts)}."


def draw(document: Document) -> Figure:
    """One panel a curve, with its interval as a band."""
    figure = new_figure(width=11.0, height=7.5)
    configurations = document["results"]["configurations"]
    rows = {label: list(zip(of["iterations"], over_runs(of), strict=True)) for label, of in configurations.items()}
    for place, name in enumerate(CURVES):
        axes = figure.add_subplot(3, 3, place + 1)
        for label, of in rows.items():
            points = [(at, row[name]) for at, row in of if name in row]
            iterations = [at for at, _ in points]
            means, low, high = (
                [estimate.get(end, estimate["mean"]) for _, estimate in points] for end in ("mean", "low", "high")
            )
            (line,) = axes.plot(iterations, means, label=label)
            axes.fill_between(iterations, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
        axes.set_title(name.replace("_", " "), fontsize="medium")
        axes.set_xlabel("iterations", fontsize="small")
    figure.axes[0].legend(frameon=False, fontsize="small")
    return figure


STUDY = Study(
    name="training_dynamics",
    title="Two configurations during training",
    claim="Entropy rises where the policy forgets (λ = 8) and falls where it does not (λ = 2).",
    measure=measure,
    body=body,
    draw=draw,
    findings=findings,
    answer=answer,
    theirs=f"entropy {THEIRS['entropy'][0]} (A) and {THEIRS['entropy'][1]} (B), first and last",
)

if __name__ == "__main__":
    main(STUDY)
