"""What does the penalty λ do? (paper, table 2; with 6, 7, 9 and 12 around W = 8); see `studies/penalty.py`."""

from __future__ import annotations

from forgetmimic_jax.studies.conduct import main
from forgetmimic_jax.studies.penalty import penalty_study

STUDY = penalty_study()

if __name__ == "__main__":
    main(STUDY)
