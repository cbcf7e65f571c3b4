"""What the studies say of the paper's claims and of ours, one row each: `python -m experiments.claims`.

Fills the block of `experiments/README.md` from the studies' JSON alone. Each study states its claim and its findings;
the rule that gives a claim its word is in `forgetmimic_jax/studies/claim.py`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from experiments import (
    comparison,
    from_scratch,
    generality,
    heat_map,
    membership,
    motion_types,
    number_of_targets,
    overlap,
    penalty,
    physical_behaviour,
    relearning,
    stand,
    training_dynamics,
    validity,
)
from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.basics.files import write_atomically
from forgetmimic_jax.evaluation.tables import markdown_table
from forgetmimic_jax.studies.claim import answer
from forgetmimic_jax.studies.conduct import RESULTS
from forgetmimic_jax.studies.document import read_document
from forgetmimic_jax.studies.page import findings_of, size
from forgetmimic_jax.studies.study import Study

README = Path(__file__).parent / "README.md"
BLOCK = re.compile(r"(<!-- claims:start -->\n).*?(<!-- claims:end -->)", re.DOTALL)

STUDIES: Mapping[str, Study] = {
    "g1/validity": validity.STUDY,
    "g1/comparison": comparison.STUDY,
    "g1/penalty": penalty.STUDY,
    "g1/heat_map": heat_map.STUDY,
    "g1/motion_types": motion_types.STUDY,
    "h2/number_of_targets": number_of_targets.STUDY,
    "g1/physical_behaviour": physical_behaviour.STUDY,
    "g1/training_dynamics": training_dynamics.STUDY,
    "g1/relearning": relearning.STUDY,
    "g1/membership": membership.STUDY,
    "g1/stand": stand.STUDY,
    "h2/stand": stand.STUDY,
    "g1/overlap": overlap.STUDY,
    "g1/generality": generality.STUDY,
    "g1/from_scratch": from_scratch.STUDY,
}


def table(folder: Path = RESULTS, studies: Mapping[str, Study] = STUDIES) -> str:
    """The claim of every study that has been measured, and which have not been."""
    rows, missing = [], []
    for name, study in studies.items():
        document = read_document(folder / f"{name}.json")
        if document is None:
            missing.append(name)
            continue
        found = answer(study.claim, findings_of(study, document))
        link = f"[{study.name}](results/{name}.md)"
        measured = study.answer(document) if study.answer else f"{found.evidence[:1].upper()}{found.evidence[1:]}."
        claim = f"Ours: {found.claim}" if study.ours else found.claim
        rows.append([claim, f"**{found.word}**", measured, study.theirs, size(study, document), link])
    header = ["the paper's claim", "here", "what was measured", "the paper's number", "runs of each kind", "study"]
    text = markdown_table(header, rows) if rows else ""
    return f"{text}\nNot measured yet: {', '.join(missing)}.\n" if missing else text


def main() -> None:
    """Write the table into its block."""
    text = README.read_text()
    if not BLOCK.search(text):
        raise InputError(f"{README}: no block '<!-- claims:start -->' ... '<!-- claims:end -->' to fill")
    write_atomically(README, BLOCK.sub(lambda block: f"{block[1]}{table()}{block[2]}", text).encode())


if __name__ == "__main__":
    run_command(main)
