"""What an iteration concentrates on. Traced, so that it may change between iterations without a compilation."""

from __future__ import annotations

import jax.numpy as jnp
from flax import struct
from jax import Array

from forgetmimic_jax.settings.config import PPOConfig


@struct.dataclass
class Focus:
    """Settings of an iteration that are traced."""

    starts: Array | None  # [clip] shares of the starts of episodes, 1 together; None: as the sampling rule gives them
    base_kl: Array | None  # [clip] weight of KL(π ‖ π_base) on the clip's steps; None: no such term
    target_kl: Array  # [] KL of an iteration that an adaptive step size follows
    gae_lambda: Array  # [] λ of the advantages
    settle: Array | None = None  # [] share of the step size that is taken; None: the whole


def focus_of(config: PPOConfig, is_target: Array) -> Focus:
    """The settings of a config: the sampling rule's starts, and the KL to the base on the clips to keep.

    Args:
        config: of the run.
        is_target: bool[clip] the clips to forget.
    """
    return Focus(
        starts=None,
        base_kl=jnp.where(is_target, 0.0, jnp.float32(config.base_kl)) if config.base_kl else None,
        target_kl=jnp.float32(config.target_kl),
        gae_lambda=jnp.float32(config.gae_lambda),
    )
