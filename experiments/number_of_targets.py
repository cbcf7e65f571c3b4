"""How many clips can be forgotten at once? One, two and three on the Unitree H2 (paper, its H2 table)."""

from __future__ import annotations

from dataclasses import dataclass

from forgetmimic_jax.studies import paper
from forgetmimic_jax.studies.conduct import main
from forgetmimic_jax.studies.options import Options
from forgetmimic_jax.studies.targets import targets_study

GROUPS = ("dance_a", "punch,kick", "jump,spinkick,cartwheel")  # dance, combat and acrobatics, as in the paper


@dataclass(kw_only=True)
class H2Options(Options):
    """Run the missing trials of a study, then write its JSON, its page and its figure."""

    robot: str = "h2"
    """Robot under robots/."""


STUDY = targets_study(
    GROUPS,
    name="number_of_targets",
    title="How many motions can be forgotten at once?",
    claim="On a second robot, one, two or three motions can be forgotten at once, and the other clips are kept.",
    papers=paper.H2,
    theirs="0 % of the target episodes succeed with each of its three groups",
)

if __name__ == "__main__":
    main(STUDY, H2Options)
