"""A policy for another robot: what one robot learned, carried over joint by joint as a start for training."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.policy.normalizer import Normalizer
from forgetmimic_jax.policy.policy import Policy, init_policy
from forgetmimic_jax.robot.model import Robot, load_robot, relative_height
from forgetmimic_jax.tracking.layouts import Layout, find_layout
from forgetmimic_jax.tracking.observation import critic_size
from forgetmimic_jax.training.checkpoint import CheckpointInfo, load_policy

Places = tuple[np.ndarray, np.ndarray]  # of the same things, for the source and for the target
REMEMBERED = 1e6  # observations that the statistics carried over count for: the new robot's soon outweigh them


def policy_for(robot: Robot, info: CheckpointInfo) -> Policy:
    """The policy of a checkpoint of another robot, carried over as a start for `robot`, with the same layout.

    Args:
        robot: to be trained.
        info: of the other robot's checkpoint.

    Raises:
        InputError: the robots have no joint, or not as many key bodies, in common, or the source has changed.
    """
    path, name = info.path, info.robot
    source = load_robot(name)
    if info.joints != source.joint_names:
        raise InputError(f"{path}: joints: not those of robots/{name} today, in their order")
    found, needed = len(source.key_bodies), len(robot.key_bodies)
    if found != needed:
        raise InputError(f"{path}: key_bodies: '{name}' has {found}; {needed} are needed, as '{robot.name}' has")
    if not shared_joints(source, robot)[0].size:
        raise InputError(f"{path}: joints: '{name}' has none that is called as one of '{robot.name}'")
    layout, key = find_layout(info.config.observation.layout), jax.random.PRNGKey(info.config.seed)
    sizes = layout.size(robot.num_joints), critic_size(layout, robot)
    fresh = init_policy(info.config.ppo, robot.num_joints, *sizes, key)
    return carried_over(load_policy(info, source), layout, source, robot, fresh)


def carried_over(policy: Policy, layout: Layout, source: Robot, target: Robot, fresh: Policy) -> Policy:
    """`policy` of robot `source` as a start for `target`: inputs and outputs go with the joint they belong to, by name.

    A joint that only the target has starts unheard, its action at 0, which follows the reference; one that only the
    source has is left out. Means of the observations move with the default pose and the height. What the critic alone
    sees is per key body, in the order of the robots' roles, and stays in place.

    Args:
        policy: of the source.
        layout: of what both see.
        source: robot of as many key bodies as the target, in the same roles.
        target: another robot.
        fresh: a random policy of the target, with the same hidden layers.
    """
    joints, rows, output = (
        shared_joints(source, target),
        _features(layout, source, target),
        (np.arange(1), np.arange(1)),
    )
    size, new_size = policy.actor_normalizer.mean.size, fresh.actor_normalizer.mean.size
    private = np.arange(policy.critic_normalizer.mean.size - size)  # of the critic alone
    critic_rows = (np.append(rows[0], size + private), np.append(rows[1], new_size + private))
    normalizers = (policy.actor_normalizer, policy.critic_normalizer)
    means, critic_means = (_moved_means(normalizer.mean, layout, source, target) for normalizer in normalizers)
    actor, critic = policy.actor["params"], policy.critic["params"]
    log_std = np.full(target.num_joints, np.mean(actor["log_std"]), np.float32)
    log_std[joints[1]] = np.asarray(actor["log_std"])[joints[0]]
    actor = {"MLP_0": _placed(actor["MLP_0"], fresh.actor["params"]["MLP_0"], rows, joints), "log_std": log_std}
    critic = {"MLP_0": _placed(critic["MLP_0"], fresh.critic["params"]["MLP_0"], critic_rows, output)}
    carried = dataclasses.replace(
        fresh,
        actor={"params": actor},
        critic={"params": critic},
        actor_normalizer=_statistics(policy.actor_normalizer, fresh.actor_normalizer, means, rows),
        critic_normalizer=_statistics(policy.critic_normalizer, fresh.critic_normalizer, critic_means, critic_rows),
    )
    return jax.tree.map(lambda new, like: jnp.asarray(new, like.dtype), carried, fresh)


def shared_joints(source: Robot, target: Robot) -> Places:
    """The joints that both robots have, as places among the source's and among the target's."""
    names = [name for name in source.joint_names if name in target.joint_names]
    return tuple(np.array([robot.joint_names.index(name) for name in names], int) for robot in (source, target))  # type: ignore[return-value]


def _features(layout: Layout, source: Robot, target: Robot) -> Places:
    """The actor's observations that both robots have, as places among the source's and among the target's."""
    result = []
    for robot, joints in zip((source, target), shared_joints(source, target), strict=True):
        places, every = layout.places(robot.num_joints), np.arange(layout.size(robot.num_joints))
        parts = []
        for term in layout.terms:
            here = every[places[term.name]]
            parts.append(here.reshape(-1, robot.num_joints)[:, joints].ravel() if term.per_joint else here)
        result.append(np.concatenate(parts))
    return result[0], result[1]


def _moved_means(mean: Any, layout: Layout, source: Robot, target: Robot) -> np.ndarray:
    """Means of the source's observations, actor's first, for a robot of the target's height and default pose."""
    places, means = layout.places(source.num_joints), np.array(mean)
    ours, theirs = shared_joints(source, target)
    moved = np.asarray(source.arrays.default_joint_pos)[ours] - np.asarray(target.arrays.default_joint_pos)[theirs]
    for term in layout.terms:
        if term.height:
            means[places[term.name]] *= relative_height(target.model) / relative_height(source.model)
        if term.encoder:
            means[places[term.name]][ours] += moved  # a slice is a view, so this changes `means`
    return means


def _placed(layers: Mapping[str, Any], fresh: Mapping[str, Any], inputs: Places, outputs: Places) -> Any:
    """A perceptron's layers with the first one's inputs and the last one's outputs at their new places, 0 elsewhere."""
    names = [f"Dense_{place}" for place in range(len(layers))]
    result = {name: {part: np.array(values) for part, values in layers[name].items()} for name in names}
    kernel = np.zeros(fresh[names[0]]["kernel"].shape, np.float32)
    kernel[inputs[1]] = result[names[0]]["kernel"][inputs[0]]
    result[names[0]]["kernel"] = kernel
    last = {part: np.zeros(values.shape, np.float32) for part, values in fresh[names[-1]].items()}
    for part, values in last.items():
        values[..., outputs[1]] = result[names[-1]][part][..., outputs[0]]
    return result | {names[-1]: last}


def _statistics(old: Normalizer, fresh: Normalizer, means: np.ndarray, places: Places) -> Normalizer:
    """Statistics at their new places; an observation that is new has none yet: its variance is 0."""
    mean, variance = np.zeros(fresh.mean.shape, np.float32), np.zeros(fresh.mean.shape, np.float32)
    mean[places[1]], variance[places[1]] = means[places[0]], np.asarray(old.variance)[places[0]]
    return Normalizer(jnp.asarray(mean), jnp.asarray(variance), jnp.minimum(old.count, REMEMBERED))
