"""Does anti-reward fine-tuning make the policy forget the targets and keep the rest? (paper, fig. 2)"""

from __future__ import annotations

from forgetmimic_jax.evaluation import paper
from forgetmimic_jax.study import main, variants_study

STUDY = variants_study(
    "validity",
    "Are the targets forgotten and the other clips kept?",
    lambda lab: {"λ = 8": {"penalty": 8.0}, "λ = 16": {"penalty": 16.0}},
    paper.VALIDITY,
)

if __name__ == "__main__":
    main(STUDY)
