"""Retraining from scratch without the targets: the reference for unlearning (paper, baseline 1).

A fresh policy with the base's own settings, sampler and wrench, which never rolls out a target clip. It shows what a
policy does on a clip that it has not seen. It costs the whole training.
"""

from __future__ import annotations

from forgetmimic_jax.unlearning.method import Method, Pace

# The base may itself be an unlearned policy, whose settings have a KL to its own base.
PACE = Pace({}, {"cpu": {"base_kl": 0.0}, "paper": {"base_kl": 0.0}})
METHOD = Method(clips="kept", start="fresh", result="retrained", pace=PACE)
