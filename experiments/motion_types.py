"""Does it matter what is to be forgotten: combat, dance or locomotion? (paper, fig. 4)"""

from __future__ import annotations

from forgetmimic_jax.studies.study import main
from forgetmimic_jax.sweep import targets_study

STUDY = targets_study(name="motion_types")

if __name__ == "__main__":
    main(STUDY)
