"""Two configurations on their way: A with λ = 2, adaptive sampling and the wrench, B with λ = 8 (paper, fig. 7)"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from forgetmimic_jax.basics.files import read_rows
from forgetmimic_jax.evaluation.plots import new_figure
from forgetmimic_jax.evaluation.tables import markdown_table, number
from forgetmimic_jax.evaluation.variants import over_seeds
from forgetmimic_jax.studies.study import Lab, Study, main

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CONFIGURATIONS: dict[str, dict[str, Any]] = {
    "A: λ = 2, adaptive, wrench": {"penalty": 2.0, "sampler": "adaptive", "wrench": True},
    "B: λ = 8": {"penalty": 8.0},
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
    """The logged curves of both configurations over the seeds."""
    asked = {(label, seed): {**of, "seed": seed} for label, of in CONFIGURATIONS.items() for seed in lab.seeds}
    runs = lab.run(asked, "training dynamics")
    result = {}
    for label in CONFIGURATIONS:
        folders = [folder for (of, _), folder in runs.items() if of == label]
        logs = [{row["iteration"]: row for row in read_rows(folder / "metrics.jsonl")} for folder in folders]
        if logs:
            # A run that was stopped and went on has a row more, at the iteration where it was stopped.
            common = sorted(set(logs[0]).intersection(*logs))
            rows = [over_seeds([{name: log[at][name] for name in CURVES} for log in logs]) for at in common]
            result[label] = {"iterations": common, "rows": rows}
    return {"configurations": result}


def tell(document: Mapping[str, Any]) -> str:
    """Each curve's first and last value."""
    configurations = document["results"]["configurations"]
    header = ["", *(f"{label}, {when}" for label in configurations for when in ("first", "last"))]
    header += [f"paper's {label.partition(':')[0]}, first and last" for label in CONFIGURATIONS]
    rows = [
        [name.replace("_", " ")]
        + [number(of["rows"][place][name]) for of in configurations.values() for place in (0, -1)]
        + list(THEIRS.get(name, ("", "")))
        for name in CURVES
    ]
    note = (
        "R_anti here is a mean over target steps, the paper's over all steps; its numbers are of another library. "
        "Episode length is of the episodes that ended, and all environments start anew with the run: the first value "
        "is of those that fell at once. With the cpu budget B gives the targets half of the starts, A leaves them the "
        "share of its sampler.\n"
    )
    return f"{markdown_table(header, rows)}\n{note}"


def draw(document: Mapping[str, Any]) -> Figure:
    """One panel a curve, with its interval as a band."""
    figure = new_figure(width=11.0, height=7.5)
    for place, name in enumerate(CURVES):
        axes = figure.add_subplot(3, 3, place + 1)
        for label, of in document["results"]["configurations"].items():
            estimates = [row[name] for row in of["rows"]]
            means = [estimate["mean"] for estimate in estimates]
            (line,) = axes.plot(of["iterations"], means, label=label)
            low, high = ([estimate.get(end, estimate["mean"]) for estimate in estimates] for end in ("low", "high"))
            axes.fill_between(of["iterations"], low, high, color=line.get_color(), alpha=0.2, linewidth=0)
        axes.set_title(name.replace("_", " "), fontsize="medium")
        axes.set_xlabel("iterations", fontsize="small")
    figure.axes[0].legend(frameon=False, fontsize="small")
    return figure


STUDY = Study(
    name="training_dynamics",
    title="Two configurations on their way",
    measure=measure,
    tell=tell,
    draw=draw,
)

if __name__ == "__main__":
    main(STUDY)
