"""The metrics of an iteration's steps, all clips together and clip by clip."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from forgetmimic_jax.basics.shards import average, total
from forgetmimic_jax.ppo.state import TrainState
from forgetmimic_jax.ppo.threshold import threshold_metrics
from forgetmimic_jax.ppo.transition import Outcome
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.env import Assets, start_probabilities


def rollout_metrics(
    config: Config, assets: Assets, state: TrainState, clip: Array, outcome: Outcome | None
) -> dict[str, Array]:
    """Scalars, and sums [clip] under names that start with `clip/`, over the steps of every shard.

    Args:
        config: of the run.
        assets: constant arrays.
        state: after the iteration.
        clip: i32[time, env] of each step.
        outcome: of each step; None where states were drawn and nothing was simulated.
    """
    clips = len(assets.is_target)
    probabilities = start_probabilities(config, assets, state.failure_level)

    def per_clip(values: Array) -> Array:
        return total(jax.ops.segment_sum(values.reshape(-1).astype(jnp.float32), clip.reshape(-1), clips))

    steps = per_clip(jnp.ones(clip.shape))
    metrics = {
        "top_bin_probability": probabilities.max(),
        "clip/steps": steps,
        "clip/probability": probabilities.sum(-1),
    }
    if outcome is None:
        return metrics
    done = outcome.done
    ended, ended_steps, completed = per_clip(done), per_clip(outcome.steps * done), per_clip(outcome.truncated)
    tracking, regularisation = per_clip(outcome.tracking), per_clip(outcome.regularisation)
    normalized = per_clip(outcome.normalized_tracking)
    metrics |= {
        "reward": average(outcome.reward.mean()),
        "value": average(outcome.value.mean()),
        "tracking_reward": average(outcome.normalized_tracking.mean()),
        "episode_length": ended_steps.sum() / jnp.maximum(ended.sum(), 1),
        "completed": completed.sum() / jnp.maximum(ended.sum(), 1),
        "wrench_gain": average(outcome.wrench_gain.mean()),
        "diverged": total(outcome.diverged.sum().astype(jnp.int32)),
        "clip/episodes": ended,
        "clip/episode_length_sum": ended_steps,
        "clip/completed": completed,
        "clip/survival_weighted_sum": per_clip((1.0 - outcome.failure) * done),
        "clip/tracking_sum": normalized,
    }
    metrics |= {f"terminated/{name}": total(value.sum()) for name, value in outcome.causes.items()}
    return metrics | threshold_metrics(config, assets.is_target, steps, tracking, regularisation, normalized)
