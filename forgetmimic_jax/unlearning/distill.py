"""Distilling what is kept (after Lee et al. 2025, "Distillation Robustifies Unlearning"): no weight of the base stays.

A fresh policy rolls out the kept clips only. It learns them by PPO with a KL term towards what the base would do there
(`ppo.base_kl` at 1, the divergence of the fresh policy from the base; kickstarting, Schmitt et al. 2018, has the base's
from the student). It needs a hundredth of the steps of the base. Theirs are language models, and their teacher is
unlearned first, because any text may contain what is to be forgotten. Here the base teaches on steps of kept clips
only. So the policy does on the targets what the kept clips alone teach. It is also the control where `retrain` costs
too much. It is not in the paper.
"""

from __future__ import annotations

from forgetmimic_jax.unlearning.method import SHORT, Method, Pace

# A fresh policy learns from what the base would do, which has little noise: many small updates, fewer iterations.
PACE = Pace(
    {"cpu": 200, "paper": 1000},
    {"cpu": {**SHORT, "minibatches": 12, "epochs": 4, "base_kl": 1.0}, "paper": {"base_kl": 1.0}},
)
METHOD = Method(clips="kept", start="taught", pace=PACE)
