"""Two configurations during training: A with λ = 2, adaptive sampling and the wrench, B with λ = 8 (paper, fig. 7)"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.evaluation.plots import new_figure
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
            rows = [
                estimates_of(
                    {
                        repeat: {name: log[at][name] for name in CURVES if name in log[at]}
                        for repeat, log in logs.items()
                    }
                )
                for at in common
            ]
            result[label] = {"iterations": common, "rows": rows}
    return {"configurations": result}


def body(document: Document) -> str:
    """Each curve's first and last value."""
    configurations = document["results"]["configurations"]
    header = ["", *(f"{label}, {when}" for label in configurations for when in ("first", "last"))]
    header += [f"paper's {label.partition(':')[0]}, first and last" for label in CONFIGURATIONS]
    rows = [
        [name.replace("_", " ")]
        + [number(of["rows"][place].get(name)) for of in configurations.values() for place in (0, -1)]
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
        if label in configurations:
            rows = configurations[label]["rows"]
            first, last = rows[0][name], rows[-1][name]
            words = name.replace("_", " ")
            evidence = f"{words} {first['mean']:.3f} at the start, {number(last, 3)} at the end ({label})"
            claim = f"{label}: {words} {'rises' if rises else 'falls'}"
            yield finding(claim, difference(last, first), 0.0, evidence, below=not rises, main=is_main)
    if B in configurations:
        rows = configurations[B]["rows"]
        first, last = rows[0]["target/R_anti"], rows[-1]["target/R_anti"]
        bound = FORGOTTEN * first["mean"]
        evidence = f"R_anti a target step {number(last, 2)}; bound {bound:.2f}, a fifth of the first"
        yield finding(f"{B}: the targets' anti-reward goes to nothing", last, bound, evidence, below=False)


def difference(last: PlainEstimate, first: PlainEstimate) -> PlainEstimate:
    """Of two estimates whose runs are not known one by one: as wide as both intervals together."""
    result: PlainEstimate = {"mean": last["mean"] - first["mean"], "n": last["n"]}
    if "low" in last and "low" in first:
        ends: PlainEstimate = {"low": last["low"] - first["high"], "high": last["high"] - first["low"]}
        result |= {**ends, "std": last["std"] + first["std"]}
    return result


def draw(document: Document) -> Figure:
    """One panel a curve, with its interval as a band."""
    figure = new_figure(width=11.0, height=7.5)
    for place, name in enumerate(CURVES):
        axes = figure.add_subplot(3, 3, place + 1)
        for label, of in document["results"]["configurations"].items():
            points = [(at, row[name]) for at, row in zip(of["iterations"], of["rows"], strict=True) if name in row]
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
)

if __name__ == "__main__":
    main(STUDY)
