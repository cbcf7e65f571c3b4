"""Other clips, and more of them, to forget (paper, fig. 4 and the H2's table)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from forgetmimic_jax.evaluation.metrics import BASE
from forgetmimic_jax.evaluation.plots import heat_map, new_figure
from forgetmimic_jax.settings.options import comma_separated
from forgetmimic_jax.studies.claim import Finding
from forgetmimic_jax.studies.findings import forgotten_and_kept, kept_stay, skill_gone
from forgetmimic_jax.studies.lab import Lab
from forgetmimic_jax.studies.study import Document, Study, variants_study
from forgetmimic_jax.studies.variants import estimates

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GROUPS = ("punch,kick", "dance_a,dance_b", "run")  # combat, dance and locomotion, as in the paper


def usual_groups(lab: Lab) -> list[tuple[str, ...]]:
    """Combat, dance and locomotion, as far as the clips of a lab's bases have them."""
    there = [tuple(clip for clip in comma_separated(group) if clip in lab.bases[0].clips) for group in GROUPS]
    return [targets for targets in there if targets]


def targets_study(
    groups: tuple[str, ...] = GROUPS,
    name: str = "targets",
    title: str = "Does it matter which motions are to be forgotten?",
    claim: str = "Combat, dance and locomotion can be forgotten, and the other clips are kept.",
    papers: Mapping[str, Any] | None = None,
    theirs: str = "",
) -> Study:
    """The default run with each group of targets; the paper's numbers beside it where it has them."""

    def variants(lab: Lab) -> dict[str, dict[str, Any]]:
        from forgetmimic_jax.tracking.setup import check_targets

        conditions = usual_groups(lab) if groups == GROUPS else [comma_separated(group) for group in groups]
        for targets in conditions:
            check_targets(targets, lab.bases[0].clips)
        return {" + ".join(targets): {"targets": ",".join(targets)} for targets in conditions}

    conditions = {"values": list(groups)}
    return variants_study(
        name,
        title,
        claim,
        variants,
        papers=papers or {},
        theirs=theirs,
        conditions=lambda lab: conditions,
        draw=draw,
        findings=findings,
        answer=lambda document: forgotten_and_kept(document["results"]["variants"]),
    )


def findings(document: Document) -> Iterator[Finding]:
    """Each group of targets is forgotten, and the other clips are kept."""
    variants, robot = document["results"]["variants"], document["conditions"]["robot"].upper()
    for label in variants:
        yield from skill_gone(variants, label, f"{label}: forgotten on the {robot}", main=True)
        yield from kept_stay(variants, label, None, f"{label}: the kept clips stay as they were", main=True)


def draw(document: Document) -> Figure:
    """Survival-weighted tracking of every clip, of the base and after each group was forgotten; targets framed."""
    from matplotlib.patches import Rectangle

    variants = document["results"]["variants"]
    over = {label: estimates(variant) for label, variant in variants.items()}
    first = next(iter(over.values()))[BASE]
    columns = {"base": first} | {label: of["policy"] for label, of in over.items()}
    clips = list(first["clips"])
    values = [[of["clips"][clip]["mean"] for of in columns.values()] for clip in clips]
    figure = new_figure(width=3.0 + 0.9 * len(columns), height=1.5 + 0.35 * len(clips))
    axes = figure.add_subplot()
    heat_map(axes, values, clips, list(columns))
    for place, variant in enumerate(variants.values(), start=1):
        for target in variant["options"]["targets"].split(","):
            corner = (place - 0.5, clips.index(target) - 0.5)
            axes.add_patch(Rectangle(corner, 1.0, 1.0, fill=False, edgecolor="red", linewidth=2))
    axes.set_title("survival-weighted tracking", fontsize="medium")
    return figure
