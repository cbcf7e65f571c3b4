"""What does the penalty λ do, and where do the targets tip over? (paper, table 2; with 6, 7, 9 and 12 around W = 8)"""

from __future__ import annotations

from forgetmimic_jax.studies.study import main
from forgetmimic_jax.sweep import lambda_study

STUDY = lambda_study(name="penalty")

if __name__ == "__main__":
    main(STUDY)
