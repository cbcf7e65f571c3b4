"""Plain fine-tuning, the control: as many steps as unlearning takes, uniform sampling, no wrench, no anti-reward.

On the kept clips only it is the weakest baseline of machine unlearning, forgetting by neglect (Golatkar et al. 2020,
"Eternal Sunshine of the Spotless Net"); with `--clips all` it tells what those steps do to a policy by themselves,
and from an unlearned checkpoint it is relearning.
"""

from __future__ import annotations

from forgetmimic_jax.unlearning.method import Method

METHOD = Method(clips="kept", result="fine_tuned")
