"""The paper's studies, one a file. `python -m experiments.STUDY --help` lists the flags of one.

Here are questions, claims and what is measured; trials, statistics and pages are `forgetmimic_jax/studies/`.
"""

from forgetmimic_jax.basics.drawing import draw_later

draw_later()  # before a study imports MuJoCo
