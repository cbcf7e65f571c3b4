"""Weights with less precision, or with noise: what unlearning hid in small differences comes back.

Four-bit weights brought back what language models had unlearned (Zhang et al. 2024, "Catastrophic Failure of LLM
Unlearning via Quantization"). Only the actor is changed, since the critic does not act.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import msgspec
from jax import Array

from forgetmimic_jax.attacks.case import Case
from forgetmimic_jax.attacks.document import Numerics
from forgetmimic_jax.attacks.performance import Performance, by_clip
from forgetmimic_jax.evaluation import statistics
from forgetmimic_jax.evaluation.document import Estimate
from forgetmimic_jax.evaluation.metrics import UNLEARNED
from forgetmimic_jax.evaluation.rollout import Acting

P = TypeVar("P", bound=Acting)
Change = Callable[[Array, Array], Array]  # a layer's weights [input, output] and a random key → the new weights


def quantised(weights: Array, bits: int) -> Array:
    """Weights [input, output] as integers of `bits` bits, times a scale for each output.

    The scale is the output's largest weight over 2^(bits − 1) − 1. Rounding is to the nearest, ties to even.
    """
    largest = 2 ** (bits - 1) - 1
    scale = jnp.abs(weights).max(axis=0) / largest
    return jnp.round(weights / jnp.where(scale > 0.0, scale, 1.0)) * scale


def half_precision(weights: Array) -> Array:
    """Weights rounded to bfloat16, in float32 again."""
    return weights.astype(jnp.bfloat16).astype(jnp.float32)


def noisy(share: float, weights: Array, key: Array) -> Array:
    """Weights with Gaussian noise of `share` of their own standard deviation."""
    return weights + share * weights.std() * jax.random.normal(key, weights.shape)


NOISES = (0.01, 0.03, 0.1)
CHANGES: Mapping[str, Change] = {
    "bf16": lambda weights, key: half_precision(weights),
    "int8": lambda weights, key: quantised(weights, 8),
    "int4": lambda weights, key: quantised(weights, 4),
    **{f"noise {share:.0%}": functools.partial(noisy, share) for share in NOISES},
}


def changed(policy: P, change: Change, seed: int = 0) -> P:
    """The policy with every layer of its actor changed; biases and exploration noise stay.

    Args:
        policy: a `Policy`, or a pytree around one.
        change: of `CHANGES`.
        seed: of the noise.
    """
    keys = iter(jax.random.split(jax.random.PRNGKey(seed), len(jax.tree.leaves(policy))))

    def layer(path: Any, weights: Array) -> Array:
        key, place = next(keys), jax.tree_util.keystr(path, simple=True, separator="/").split("/")
        return change(weights, key) if "actor" in place and place[-1] == "kernel" else weights

    return jax.tree_util.tree_map_with_path(layer, policy)


def attack(case: Case) -> Numerics:
    """Every change of every policy's weights on the targets, and of the unlearned policy's on the kept clips."""
    policies = case.policies
    versions = {
        (name, change): changed(policy, make, case.seed)
        for name, policy in policies.items()
        for change, make in CHANGES.items()
    }
    words = {f"{name}, {change}": of for (name, change), of in versions.items()}
    performance = case.on_targets.joined(case.target_stage.perform(words))
    against = {f"{name}, {change}": name for name, change in versions}
    compared = by_clip(performance, case.targets, against=against, seed=case.seed, policies=list(against))
    stage = case.stage(case.chosen(case.kept), case.scale.kept_variant_episodes)
    ours = {change: versions[UNLEARNED, change] for change in CHANGES}
    on_kept = stage.perform({"before": case.policies[UNLEARNED], **ours})
    success = {name: _success(on_kept, name) for name in on_kept.length}
    return Numerics(
        before=case.by_clip(case.on_targets, case.targets),
        changes={
            change: {target: {name: of[f"{name}, {change}"] for name in policies} for target, of in compared.items()}
            for change in CHANGES
        },
        kept_before=success.pop("before"),
        kept=success,
    )


def _success(performance: Performance, policy: str) -> Estimate:
    success = performance.length[policy] == performance.horizon
    return msgspec.convert(statistics.rate(int(success.sum()), len(success)), Estimate)
