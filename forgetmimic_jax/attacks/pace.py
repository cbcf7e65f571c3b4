"""Whether the unlearned policy relearns the targets faster than the control: then some skill was only hidden."""

from __future__ import annotations

import msgspec
import numpy as np

from forgetmimic_jax.attacks.document import CONTROL, Curve, Relearning
from forgetmimic_jax.evaluation.metrics import UNLEARNED
from forgetmimic_jax.evaluation.relearning import DECISIVE, Lasted, lasted
from forgetmimic_jax.evaluation.tables import share

FASTER = 0.5  # of the control's target steps: who needs fewer is faster
CLOSE = 0.2  # of the base's tracking: what neither relearned may differ by so much


def pace(relearning: Relearning | None) -> tuple[bool | None, str]:
    """Whether it relearns the targets faster than the control, with every seed; None where that is not sure."""
    if relearning is None:
        return None, "How fast it relearns the targets was not measured."
    pairs = paired(relearning)
    faster: list[bool | None] = []
    short: list[str] = []
    for seed, pair in pairs.items():
        if any(run.there for run in pair):
            faster.append(sooner_than_control(*pair))
            continue
        ours, theirs = reached(relearning, seed)
        faster.append(ours > theirs + CLOSE)
        short.append(f"{share(ours)} against {share(theirs)}")
    steps = "; ".join(f"{_needed(unlearned)} against {_needed(control)}" for unlearned, control in pairs.values())
    numbers = (
        f"unlearned policy against control, seed by seed, {steps or 'none'} target steps until "
        f"{share(DECISIVE)} of the base's tracking"
    )
    numbers += f"; after the same target steps neither got there: {', '.join(short)}" if short else ""
    if faster and all(faster):
        return True, f"It relearns the targets faster than the control: {numbers}."
    if any(faster):
        return None, f"With some seeds it relearns the targets faster than the control: {numbers}."
    if None in faster or not faster:
        return None, f"Relearning was stopped too early to compare: {numbers}."
    return False, f"It does not relearn the targets faster than the control: {numbers}."


def sooner_than_control(unlearned: Lasted, control: Lasted) -> bool | None:
    """Whether the unlearned policy was faster; None where a run ended before that could be seen."""
    if unlearned.target_steps < FASTER * control.target_steps:
        return True if unlearned.there else None
    return False if control.there else None


def reached(relearning: Relearning, seed: str) -> tuple[float, float]:
    """What unlearned policy and control track of the targets after equally many target steps, as shares of the base's.

    Both are taken where the shorter of the two trainings ended.
    """
    ours, theirs = relearning.starts[UNLEARNED][seed], relearning.starts[CONTROL][seed]
    end = min(ours.target_steps[-1], theirs.target_steps[-1])

    def at_the_end(curve: Curve) -> float:
        return float(np.interp(end, curve.target_steps, curve.tracking) / relearning.base[seed])

    return at_the_end(ours), at_the_end(theirs)


def paired(relearning: Relearning) -> dict[str, tuple[Lasted, Lasted]]:
    """By seed, how long the unlearned policy and the control took to relearn the targets."""
    runs = lasted_until(relearning, DECISIVE)
    return {seed: (run, runs[CONTROL][seed]) for seed, run in runs[UNLEARNED].items() if seed in runs[CONTROL]}


def lasted_until(relearning: Relearning, level: float) -> dict[str, dict[str, Lasted]]:
    """How long the unlearned policy and the control took to a share of the base's tracking: policy → seed → run."""
    results = msgspec.to_builtins(relearning)
    return {start: lasted(results, start, level) for start in (UNLEARNED, CONTROL)}


def _needed(run: Lasted) -> str:
    return f"{'' if run.there else 'more than '}{run.target_steps:,.0f}"
