"""One figure: what brought the targets back, attack by attack, for the unlearned policy, the control and the base."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import msgspec

from forgetmimic_jax.attacks.case import TRAINED
from forgetmimic_jax.attacks.document import CONTROL, Compared, EvidenceDocument, Numbers, Relearning
from forgetmimic_jax.attacks.pace import reached
from forgetmimic_jax.evaluation.document import Estimate
from forgetmimic_jax.evaluation.metrics import UNLEARNED
from forgetmimic_jax.evaluation.plots import bars, new_figure
from forgetmimic_jax.evaluation.statistics import over_seeds
from forgetmimic_jax.evaluation.tables import FORGOTTEN

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def what_brought_it_back(evidence: EvidenceDocument) -> dict[str, Compared]:
    """The numbers as they are and after each attack: of all targets and variants, those of which most is left."""
    target, compared = _most(evidence.originals.targets)
    found = {f"as it is:\n{target}": compared}
    if evidence.near_duplicates and evidence.near_duplicates.families:
        family, compared = _most(evidence.near_duplicates.families)
        found[f"near-duplicates:\n{family}"] = compared
    if evidence.splices and evidence.splices.forbidden:
        found["spliced into\nkept clips"] = evidence.splices.forbidden
    if evidence.recovery:
        target, compared = _most(evidence.recovery.after)
        found[f"fine-tuned on kept\nclips: {target}"] = compared
    if evidence.relearning:
        found["relearning, equal\ntarget steps (tracking)"] = _relearned(evidence.relearning)
    if evidence.held_out:
        target, compared = _most(evidence.held_out.after)
        found[f"first half shown:\n{target}"] = compared
    if evidence.numerics:
        groups = {f"{change}: {at}": of for change, by in evidence.numerics.changes.items() for at, of in by.items()}
        change, compared = _most(groups)
        found[f"weights in\n{change}"] = compared
    return found


def _relearned(relearning: Relearning) -> Compared:
    """What both track of the base's after equally many target steps: a share of its tracking, not of its skill."""
    ends = [reached(relearning, seed) for seed in relearning.base]
    shares = (over_seeds(values) for values in zip(*ends, strict=True))
    return {
        policy: Numbers(skill=msgspec.convert(share, Estimate))
        for policy, share in zip((UNLEARNED, CONTROL), shares, strict=True)
    }


def draw(evidence: EvidenceDocument) -> Figure:
    """Bars of skill and of motion content."""
    found = what_brought_it_back(evidence)
    figure = new_figure(width=2.0 + 1.3 * len(found), height=6.0)
    for row, (kind, label) in enumerate({"skill": "skill", "content": "motion content"}.items()):
        axes = figure.add_subplot(2, 1, row + 1)
        series = {
            policy: [getattr(of[policy], kind) if policy in of else None for of in found.values()] for policy in TRAINED
        }
        bars(axes, list(found), series)
        axes.axhline(FORGOTTEN, color="0.5", linestyle=":")
        axes.axhline(0.0, color="0.2", linewidth=0.8)
        axes.set_ylabel(f"{label} on the targets")
    figure.axes[0].set_title("What brought it back?", loc="left")
    figure.axes[0].legend(ncols=len(TRAINED), loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False)
    return figure


def _most(groups: Mapping[str, Compared]) -> tuple[str, Compared]:
    """The group in which the unlearned policy's skill, or else its content, is largest."""

    def most(name: str) -> float:
        numbers = groups[name][UNLEARNED]
        value = numbers.skill or numbers.content
        return -1.0 if value is None or value.mean is None else value.mean

    name = max(groups, key=most)
    return name, groups[name]
