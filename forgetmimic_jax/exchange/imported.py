"""A policy of another project as plain arrays, and the policy of ours that acts the same."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.policy.gaussian import MAX_STD, MIN_STD
from forgetmimic_jax.policy.normalizer import OBSERVATION_LIMIT, VARIANCE_FLOOR, Normalizer
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.tracking.layouts import Layout

UNKNOWN_COUNT = 1e8  # observations behind statistics that do not say it: as many as the running ones ever remember
RAW_SCALE = 10.0  # of observations that were not normalised: ours are clipped at ten of these


@dataclass(frozen=True)
class ImportedActor:
    """An ELU perceptron: action = W_n elu(… elu(W_1 (observation - mean) / scale + b_1) …) + b_n."""

    layers: tuple[tuple[np.ndarray, np.ndarray], ...]  # kernel f32[in, out], bias f32[out]
    mean: np.ndarray | None = None  # f32[features]; None: nothing is subtracted
    scale: np.ndarray | None = None  # f32[features]; None: nothing is divided
    count: float = UNKNOWN_COUNT  # observations behind mean and scale
    std: np.ndarray | None = None  # f32[joint] exploration noise, if the file has it
    iteration: int = 0  # of the training it comes from

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Mean action f32[n, joint] at observations f32[n, features]."""
        x = observation if self.mean is None else observation - self.mean
        x = x if self.scale is None else x / self.scale
        for kernel, bias in self.layers[:-1]:
            x = x @ kernel + bias
            x = np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0)))
        kernel, bias = self.layers[-1]
        return x @ kernel + bias

    @property
    def hidden_layers(self) -> tuple[int, ...]:
        return tuple(kernel.shape[1] for kernel, _ in self.layers[:-1])


def behind(actor: ImportedActor, factor: np.ndarray, shift: np.ndarray) -> ImportedActor:
    """The actor that does at x what `actor` does at factor · (x + shift); exact, for both are linear.

    Args:
        actor: of factor · (x + shift).
        factor: f[features], none of them 0.
        shift: f[features].
    """
    mean, scale, layers = actor.mean, actor.scale, actor.layers
    if shift.any() or mean is not None:
        mean = ((0.0 if mean is None else mean) / factor - shift).astype(np.float32)
    if (factor != 1.0).any():
        if scale is not None:
            scale = (scale / factor).astype(np.float32)
        else:
            (kernel, bias), *others = layers
            layers = (((kernel * factor[:, None]).astype(np.float32), bias), *others)
    return dataclasses.replace(actor, layers=layers, mean=mean, scale=scale)


def check_actor(actor: ImportedActor, layout: Layout, robot: Robot, path: Path) -> None:
    """Sizes that fit layout, robot and each other, and finite numbers.

    Raises:
        InputError: what differs, and what is needed.
    """
    size = layout.size(robot.num_joints)
    kernels = [kernel for kernel, _ in actor.layers]
    if kernels[0].shape[0] != size:
        terms = ", ".join(f"{term.name} {term.size(robot.num_joints)}" for term in layout.terms)
        raise InputError(
            f"{path}: observations: found {kernels[0].shape[0]}; {size} are needed, in this order: {terms}"
        )
    if kernels[-1].shape[1] != robot.num_joints:
        raise InputError(
            f"{path}: actions: found {kernels[-1].shape[1]}; {robot.num_joints} are needed, one a joint of {robot.name}"
        )
    for i, (kernel, bias) in enumerate(actor.layers):
        inputs = size if i == 0 else kernels[i - 1].shape[1]
        if kernel.shape[0] != inputs or bias.shape != kernel.shape[1:]:
            raise InputError(
                f"{path}: layer {i}: found weights {list(kernel.shape)} (in, out) and {list(bias.shape)} biases; "
                f"{inputs} inputs and a bias for each output are needed"
            )
    if len(kernels) < 2:
        raise InputError(f"{path}: found no hidden layer; one or more are needed")
    for what, values, width in (
        ("normaliser's mean", actor.mean, size),
        ("normaliser's scale", actor.scale, size),
        ("exploration noise", actor.std, robot.num_joints),
    ):
        if values is not None and values.shape != (width,):
            raise InputError(f"{path}: {what}: found {list(values.shape)} numbers; {width} are needed")
    numbers = [array for layer in actor.layers for array in layer]
    numbers += [values for values in (actor.mean, actor.scale, actor.std) if values is not None]
    if not all(np.isfinite(values).all() for values in numbers):
        raise InputError(f"{path}: found NaN or Inf among the weights; finite numbers are needed")
    if actor.scale is not None and not (actor.scale > VARIANCE_FLOOR**0.5).all():
        raise InputError(f"{path}: normaliser's scale: found {actor.scale.min():g}; more than 0.001 is needed")


def with_actor(policy: Policy, actor: ImportedActor, std: float) -> Policy:
    """`policy` with the imported actor and its normaliser; what it was before serves as the form to fill.

    Ours divides by √(variance + 1e-6), so the variance is what makes that the imported scale: for rsl_rl, which divides
    by standard deviation + 0.01, a little more than its own. Without a normaliser, observations are divided by ten
    and the first layer's weights multiplied, so that ours, which clips at ten, does not cut a joint's speed.

    Args:
        policy: of the same layers.
        actor: the imported one.
        std: of the exploration noise, where the import has none.
    """
    (kernel, bias), *others = actor.layers
    features = kernel.shape[0]
    if actor.scale is None:
        kernel = kernel * np.float32(RAW_SCALE)
    scale = np.full(features, RAW_SCALE) if actor.scale is None else actor.scale.astype(np.float64)
    mean = np.zeros(features) if actor.mean is None else actor.mean
    layers = {
        f"Dense_{i}": {"kernel": jnp.asarray(kernel), "bias": jnp.asarray(bias)}
        for i, (kernel, bias) in enumerate([(kernel, bias), *others])
    }
    noise = np.full(others[-1][1].shape, std) if actor.std is None else np.clip(actor.std, MIN_STD, MAX_STD)
    log_std = jnp.asarray(np.log(noise), jnp.float32)
    return dataclasses.replace(
        policy,
        actor={"params": {**policy.actor["params"], "MLP_0": layers, "log_std": log_std}},
        actor_normalizer=Normalizer(
            mean=jnp.asarray(mean, jnp.float32),
            variance=jnp.asarray(scale**2 - VARIANCE_FLOOR, jnp.float32),
            count=jnp.asarray(min(actor.count, UNKNOWN_COUNT), jnp.float32),
        ),
    )


def within_limit(policy: Policy, observations: np.ndarray) -> np.ndarray:
    """Which of the observations [n, features] our normaliser passes unclipped, bool[n]."""
    normalizer = policy.actor_normalizer
    scaled = (observations - np.asarray(normalizer.mean)) / np.sqrt(np.asarray(normalizer.variance) + VARIANCE_FLOOR)
    return (np.abs(scaled) <= OBSERVATION_LIMIT).all(-1)


def notes(actor: ImportedActor, std: float) -> Sequence[str]:
    """What a user should know of an import, in sentences."""
    found = ["The critic starts fresh: its observations here are others than any other project's."]
    if actor.scale is None:
        found.append("The file has no observation normaliser; observations go in as they are.")
    if actor.std is None:
        found.append(f"The file has no exploration noise; fine-tuning starts from a standard deviation of {std:g}.")
    elif (np.clip(actor.std, MIN_STD, MAX_STD) != actor.std).any():
        found.append(f"Exploration noise beyond {MIN_STD:g} to {MAX_STD:g} was brought to these bounds.")
    return found
