"""Reference-state initialisation: which clip and frame an episode starts from (paper, 'Standard RSI').

Every sampler is a distribution over (clip, bin) with the frame uniform inside the bin.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from forgetmimic_jax.basics.shards import total
from forgetmimic_jax.motion.library import MotionLibrary
from forgetmimic_jax.settings.config import SamplingConfig


@struct.dataclass
class Bins:
    """Temporal bins of every clip. An episode may start at frames start ≤ frame < end of a valid bin.

    A clip without a valid bin is never started.
    """

    start: Array  # i32[clip, bin]
    end: Array  # i32[clip, bin]
    valid: Array  # bool[clip, bin]


class Start(NamedTuple):
    """Where episodes start."""

    clip: Array  # i32[env]
    bin: Array  # i32[env] of the clip
    frame: Array  # i32[env]


def make_bins(library: MotionLibrary, bin_seconds: float, control_step: float) -> Bins:
    """Bins of `bin_seconds`; valid if at least half of its width is covered, and every clip has at least one.

    The last valid bin takes the rest of the clip. The last frame of a clip is never a start: no step follows it.
    """
    width = max(1, round(bin_seconds / control_step))
    starts = np.asarray(library.length) - 1
    count = max(1, -(-int(starts.max()) // width))
    start = np.tile(np.arange(count) * width, (len(starts), 1))
    covered = np.clip(starts[:, None] - start, 0, width)
    valid = covered >= width / 2
    valid[:, 0] = True
    last = valid.sum(1) - 1
    end = np.minimum(start + width, starts[:, None])
    end[np.arange(len(starts)), last] = starts
    return Bins(
        start=jnp.asarray(np.where(valid, start, 0), jnp.int32),
        end=jnp.asarray(np.where(valid, end, 1), jnp.int32),
        valid=jnp.asarray(valid),
    )


def initial_failure_level(config: SamplingConfig, bins: Bins) -> Array:
    """L [clip, bin] before any episode ended."""
    return jnp.where(bins.valid, jnp.float32(config.initial_failure), 0.0)


def bin_probabilities(
    config: SamplingConfig,
    bins: Bins,
    failure_level: Array,
    is_target: Array | None = None,
    starts: Array | None = None,
) -> Array:
    """p [clip, bin] of starting in each bin.

    adaptive and frozen: p = (1 − ρ) softmax(L/τ + ln p0) + ρ p0 with τ = 1/ln(1 + N_valid); frozen differs only in that
    L is no longer updated. The prior p0 is the paper's 1/N_valid, or with `prior` clips the same for every clip.
    uniform_bins: 1/N_valid. uniform_clips: a clip uniformly, then a frame uniformly.

    With `target_share` the clips of is_target (bool[clip]) get that share of it all, and the others the rest. With
    `starts` every clip gets its share [clip], and the rule decides among its bins alone; a clip without one gets none.
    """
    probabilities = _by_rule(config, bins, failure_level)
    if starts is not None:
        return starts[:, None] * probabilities / jnp.maximum(probabilities.sum(-1, keepdims=True), 1e-12)
    if not config.target_share or is_target is None:
        return probabilities
    targets, kept = probabilities * is_target[:, None], probabilities * ~is_target[:, None]
    return config.target_share * targets / targets.sum() + (1.0 - config.target_share) * kept / kept.sum()


def _by_rule(config: SamplingConfig, bins: Bins, failure_level: Array) -> Array:
    count = bins.valid.sum()
    if config.rule == "uniform_clips":
        frames = jnp.where(bins.valid, bins.end - bins.start, 0)
        return frames / jnp.maximum(frames.sum(-1, keepdims=True), 1) / bins.valid.any(-1).sum()
    if config.rule == "uniform_bins":
        return bins.valid / count
    weight = bins.valid / (jnp.maximum(bins.valid.sum(-1, keepdims=True), 1) if config.prior == "clips" else 1)
    prior = weight / weight.sum()
    favoured = prior * jnp.exp((failure_level - 1.0) * jnp.log1p(count))
    return (1.0 - config.uniform_ratio) * favoured / favoured.sum() + config.uniform_ratio * prior


def sample_start(config: SamplingConfig, key: Array, probabilities: Array, bins: Bins, num: int) -> Start:
    """Starts [num]; the config's share of them at the first frame of the clip."""
    bin_key, frame_key = jax.random.split(key)
    # By the inverse of the cumulative distribution: one uniform number a draw, where Gumbel's trick needs one a bin.
    cumulative = jnp.cumsum(probabilities.reshape(-1))
    drawn = jax.random.uniform(bin_key, (num,)) * cumulative[-1]
    flat = jnp.searchsorted(cumulative, drawn, side="right")
    clip, index = jnp.divmod(flat, probabilities.shape[1])
    frame = jax.random.randint(frame_key, (num,), bins.start[clip, index], bins.end[clip, index])
    if config.first_frame:
        first = jax.random.bernoulli(jax.random.fold_in(key, 2), config.first_frame, (num,))
        index, frame = jnp.where(first, 0, index), jnp.where(first, 0, frame)
    return Start(clip.astype(jnp.int32), index.astype(jnp.int32), frame.astype(jnp.int32))


def episode_failure(config: SamplingConfig, tracking_sum: Array, steps: Array, horizon: Array) -> Array:
    """f_episode [...] in [0, 1] of ended episodes.

    survival_weighted: 1 − clamp(Σ_t r̄_t / horizon), so an early death counts as failure. alive_mean: the paper's
    literal mean over the steps alive.

    Args:
        config: which signal.
        tracking_sum: Σ_t r̄_t over the episode.
        steps: steps of the episode.
        horizon: steps that the episode could have, min(500, frames left).
    """
    divisor = horizon if config.failure_signal == "survival_weighted" else steps
    return 1.0 - jnp.clip(tracking_sum / jnp.maximum(divisor, 1), 0.0, 1.0)


def update_failure_level(
    config: SamplingConfig, failure_level: Array, done: Array, failure: Array, clip: Array, index: Array
) -> Array:
    """L [clip, bin] after a batch of ended episodes of every shard, each credited to its start bin.

    The paper's EMA is per episode. k episodes of mean f̄ give L ← (1−α)^k L + (1 − (1−α)^k) f̄, so the time constant
    in episodes does not depend on how many end at once.

    Args:
        config: smoothing α, and the rule: `frozen` keeps L; the others learn it, for the wrench too.
        failure_level: L before.
        done: bool[...] where an episode ended.
        failure: f_episode[...].
        clip: i32[...] the episode's clip.
        index: i32[...] its start bin.
    """
    if config.rule == "frozen":
        return failure_level
    num_bins = failure_level.shape[1]
    flat = (clip * num_bins + index).reshape(-1)
    ended = done.reshape(-1).astype(jnp.float32)

    def by_bin(values: Array) -> Array:
        return total(jax.ops.segment_sum(values, flat, failure_level.size).reshape(failure_level.shape))

    count, failures = by_bin(ended), by_bin(ended * failure.reshape(-1))
    keep = (1.0 - config.smoothing) ** count
    return keep * failure_level + (1.0 - keep) * failures / jnp.maximum(count, 1.0)
