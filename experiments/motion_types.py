"""Does it matter which motions are to be forgotten? (paper, fig. 4); see `studies/targets.py`."""

from __future__ import annotations

from forgetmimic_jax.studies.conduct import main
from forgetmimic_jax.studies.targets import targets_study

STUDY = targets_study(name="motion_types")

if __name__ == "__main__":
    main(STUDY)
