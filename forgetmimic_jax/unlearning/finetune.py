"""Fine-tuning alone, the control: the same training as unlearning, without the anti-reward.

On the kept clips only it is the weakest baseline of machine unlearning, forgetting by neglect (Golatkar et al. 2020,
"Eternal Sunshine of the Spotless Net"); with `--clips all` it shows what the training alone does to a policy.
From an unlearned checkpoint it is relearning. On a laptop it has a KL term towards the base, as unlearning has;
the paper's PPO is `--set ppo.base_kl=0 ppo.equal_clips=false`.
"""

from __future__ import annotations

from forgetmimic_jax.unlearning.method import Method

METHOD = Method(clips="kept", result="fine_tuned")
