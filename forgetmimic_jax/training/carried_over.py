"""A policy for another robot: what one robot learned, carried over joint by joint as a start for training."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.policy.normalizer import Normalizer
from forgetmimic_jax.policy.policy import Policy, init_policy
from forgetmimic_jax.robot.model import Robot, load_robot, relative_height
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.layouts import TERMS, Layout, find_layout
from forgetmimic_jax.tracking.observation import critic_size
from forgetmimic_jax.training.checkpoint import CheckpointInfo, load_policy

Places = tuple[np.ndarray, np.ndarray]  # of the same things, for the old robot and for the new one
REMEMBERED = 1e6  # observations that the statistics carried over count for: the new robot's soon outweigh them


def policy_for(robot: Robot, info: CheckpointInfo) -> Policy:
    """The policy of a checkpoint of another robot, carried over as a start for `robot`, with the same layout.

    Args:
        robot: to be trained.
        info: of the other robot's checkpoint.

    Raises:
        InputError: the robots have no joint, or not as many key bodies, in common, or the old one has changed.
    """
    path, name = info.path, info.robot
    old = load_robot(name, action=info.config.action)
    if info.joints != old.joint_names:
        raise InputError(f"{path}: joints: not those of robots/{name} today, in their order")
    found, needed = len(old.key_bodies), len(robot.key_bodies)
    if found != needed:
        raise InputError(f"{path}: key_bodies: '{name}' has {found}; {needed} are needed, as '{robot.name}' has")
    if not shared_joints(old, robot)[0].size:
        raise InputError(f"{path}: joints: '{name}' has none that is called as one of '{robot.name}'")
    layout, key = find_layout(info.config.observation.layout), jax.random.PRNGKey(info.config.seed)
    sizes = layout.size(robot.num_joints), critic_size(layout, robot)
    fresh = init_policy(info.config.ppo, robot.num_joints, *sizes, key)
    return carried_over(load_policy(info, old), info.config, old, robot, fresh)


def carried_over(policy: Policy, config: Config, old: Robot, new: Robot, fresh: Policy) -> Policy:
    """`policy` of robot `old` as a start for `new`: inputs and outputs go with the joint they belong to, by name.

    A joint that only the new robot has starts unheard, its action at 0; one that only the old has is left out. Means of
    the observations move with the default pose and the height. A residual action stays as it is, the same share of the
    joint's torque; an action on the default pose becomes the one of the same joint target. What the critic alone sees
    is per key body, in the order of the robots' roles, and stays in place.

    Args:
        policy: of the old robot.
        config: of the old robot: what both see, and what an action is added to.
        old: robot of as many key bodies as the new one, in the same roles.
        new: another robot.
        fresh: a random policy of the new robot, with the same hidden layers.
    """
    layout, places = find_layout(config.observation.layout), shared_joints(old, new)
    actions = _actions(config, old, new)
    rows, output = _features(layout, old, new), (np.arange(1), np.arange(1))
    size, new_size = policy.actor_normalizer.mean.size, fresh.actor_normalizer.mean.size
    private = np.arange(policy.critic_normalizer.mean.size - size)  # of the critic alone
    critic_rows = (np.append(rows[0], size + private), np.append(rows[1], new_size + private))
    actor_normalizer = _moved(policy.actor_normalizer, layout, actions, old, new)
    critic_normalizer = _moved(policy.critic_normalizer, layout, actions, old, new)
    actor, critic = policy.actor["params"], policy.critic["params"]
    log_std = np.full(new.num_joints, np.mean(actor["log_std"]), np.float32)
    log_std[places[1]] = (np.asarray(actor["log_std"]) + np.log(actions.ratio))[places[0]]
    actor = {
        "MLP_0": _placed(actions.of(actor["MLP_0"]), fresh.actor["params"]["MLP_0"], rows, places),
        "log_std": log_std,
    }
    critic = {"MLP_0": _placed(critic["MLP_0"], fresh.critic["params"]["MLP_0"], critic_rows, output)}
    carried = dataclasses.replace(
        fresh,
        actor={"params": actor},
        critic={"params": critic},
        actor_normalizer=_statistics(actor_normalizer, fresh.actor_normalizer, rows),
        critic_normalizer=_statistics(critic_normalizer, fresh.critic_normalizer, critic_rows),
    )
    return jax.tree.map(lambda new, like: jnp.asarray(new, like.dtype), carried, fresh)


class Actions(NamedTuple):
    """What an action of the old robot becomes for the new, joint by joint: ratio · action + shift."""

    ratio: np.ndarray  # [joint] in the old robot's policy order
    shift: np.ndarray

    def of(self, layers: Mapping[str, Any]) -> Mapping[str, Any]:
        """A perceptron's layers with such an output."""
        last = f"Dense_{len(layers) - 1}"
        kernel, bias = np.asarray(layers[last]["kernel"]), np.asarray(layers[last]["bias"])
        return {**layers, last: {"kernel": kernel * self.ratio, "bias": bias * self.ratio + self.shift}}


def _actions(config: Config, old: Robot, new: Robot) -> Actions:
    """Of a residual: the same action. On the default pose: the action that asks for the same joint target."""
    actions = Actions(np.ones(old.num_joints), np.zeros(old.num_joints))
    if config.action.mode == "offset":
        ours, theirs = shared_joints(old, new)
        scale, new_scale = _in_policy_order(old, "action_scale"), _in_policy_order(new, "action_scale")
        actions.ratio[ours] = scale[ours] / new_scale[theirs]
        actions.shift[ours] = _pose_change(old, new) / new_scale[theirs]
    return actions


def _in_policy_order(robot: Robot, field: str) -> np.ndarray:
    """Constants [joint] of a robot in its policy's order of joints."""
    return np.asarray(getattr(robot.arrays, field))[robot.policy_joints]


def _pose_change(old: Robot, new: Robot) -> np.ndarray:
    """The old robot's default pose less the new one's, rad, of the joints that both have."""
    ours, theirs = shared_joints(old, new)
    return _in_policy_order(old, "default_joint_pos")[ours] - _in_policy_order(new, "default_joint_pos")[theirs]


def shared_joints(old: Robot, new: Robot) -> Places:
    """The joints that both robots have, as places in the old one's and in the new one's policy order."""
    orders = old.policy_joint_names, new.policy_joint_names
    names = [name for name in orders[0] if name in orders[1]]
    return tuple(np.array([order.index(name) for name in names], int) for order in orders)  # type: ignore[return-value]


def _features(layout: Layout, old: Robot, new: Robot) -> Places:
    """The actor's observations that both robots have, as places among the old one's and the new one's."""
    result = []
    for robot, joints in zip((old, new), shared_joints(old, new), strict=True):
        places, every = layout.places(robot.num_joints), np.arange(layout.size(robot.num_joints))
        parts = []
        for term in layout.terms:
            here = every[places[term.name]]
            parts.append(here.reshape(-1, robot.num_joints)[:, joints].ravel() if term.per_joint else here)
        result.append(np.concatenate(parts))
    return result[0], result[1]


def _moved(of: Normalizer, layout: Layout, actions: Actions, old: Robot, new: Robot) -> Normalizer:
    """Statistics of the old robot's observations, actor's first, for the new one's height, pose and actions."""
    mean, variance = np.array(of.mean), np.array(of.variance)
    for name, here in layout.places(old.num_joints).items():  # a slice is a view: what follows changes the arrays
        if TERMS[name].height:
            mean[here] *= relative_height(new.model) / relative_height(old.model)
        if TERMS[name].encoder:
            mean[here][shared_joints(old, new)[0]] += _pose_change(old, new)
        if name == "actions":
            mean[here] = mean[here] * actions.ratio + actions.shift
            variance[here] *= actions.ratio**2
    return Normalizer(jnp.asarray(mean), jnp.asarray(variance), of.count)


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


def _statistics(old: Normalizer, fresh: Normalizer, places: Places) -> Normalizer:
    """Statistics at their new places; an observation that is new has none yet: its variance is 0."""
    mean, variance = np.zeros(fresh.mean.shape, np.float32), np.zeros(fresh.mean.shape, np.float32)
    mean[places[1]], variance[places[1]] = old.mean[places[0]], old.variance[places[0]]
    return Normalizer(jnp.asarray(mean), jnp.asarray(variance), jnp.minimum(old.count, REMEMBERED))
