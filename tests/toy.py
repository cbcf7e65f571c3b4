"""A toy world to judge the judge in: no physics, and policies that are tiny networks.

The robot is always at the reference. A policy tracks a frame as well as its action is like the base's there, and falls
where it is too far off. The base has learned one network for the targets' surroundings and another for the rest; a
policy that never saw a target has the second one everywhere.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from forgetmimic_jax.attacks.performance import Performance
from forgetmimic_jax.evaluation.rollout import episode_starts
from forgetmimic_jax.motion.library import build_library
from forgetmimic_jax.tracking.layouts import find_layout

FALL = 0.4  # tracking below which a policy falls
WIDE, NARROW = 0.15, 1e-3  # rad: how far around a target's frames something reaches


@struct.dataclass
class Network:
    """actions = tanh(reference · kernel)."""

    actor: dict[str, Array]
    first: int = struct.field(pytree_node=False)

    def mean_action(self, observation: Array) -> Array:
        kernel = self.actor["kernel"]
        return jnp.tanh(observation[:, self.first : self.first + len(kernel)] @ kernel)


def network(seed: int, joints: int, first: int) -> Network:
    return Network({"kernel": jax.random.normal(jax.random.PRNGKey(seed), (joints, joints))}, first)


@struct.dataclass
class Near:
    """One policy near some frames, the less the farther away, and another elsewhere."""

    near: Network
    elsewhere: Network
    frames: Array  # [frame, joint] rad
    reach: float = struct.field(pytree_node=False)
    strength: float = struct.field(pytree_node=False)

    def mean_action(self, observation: Array) -> Array:
        joints = observation[:, self.near.first : self.near.first + self.frames.shape[1]]
        distance = jnp.sqrt(((joints[:, None] - self.frames) ** 2).mean(-1)).min(-1)
        gate = self.strength * jnp.exp(-0.5 * (distance / self.reach) ** 2)[:, None]
        return gate * self.near.mean_action(observation) + (1.0 - gate) * self.elsewhere.mean_action(observation)


class ToyStage:
    """Has the interface of `attacks.rollouts.Stage`."""

    base = None  # what is right: the latest base that performed

    def __init__(self, setup, clips, *, episodes, seed, from_start=False):
        self.names = tuple(clip.name for clip in clips)
        self._library = build_library(setup.robot, clips)
        self._place = find_layout(setup.config.observation.layout).places(setup.robot.num_joints)
        self.clip, self.start_frame = episode_starts(np.asarray(self._library.length), episodes, seed)
        if from_start:
            self.start_frame = np.zeros_like(self.start_frame)

    def perform(self, policies) -> Performance:
        type(self).base = policies.get("base", type(self).base)
        last = np.asarray(self._library.length)[self.clip] - 1
        horizon = last - self.start_frame
        steps = np.arange(horizon.max())
        frame = np.minimum(self.start_frame[:, None] + steps + 1, last[:, None])
        joints = np.asarray(self._library.at(self.clip[:, None], frame).joint_pos)
        features = sum(place.stop - place.start for place in self._place.values())
        observation = np.zeros((joints.shape[0] * joints.shape[1], features), np.float32)
        observation[:, self._place["ref_joint_pos"]] = joints.reshape(-1, joints.shape[-1])
        right = type(self).base.mean_action(jnp.asarray(observation))
        tracking, length = {}, {}
        for name, policy in policies.items():
            action = jnp.zeros_like(right) if policy is None else policy.mean_action(jnp.asarray(observation))
            error = np.asarray(((action - right) ** 2).mean(-1)).reshape(joints.shape[:2])
            tracking[name] = np.exp(-3.0 * error)
            # It falls in the third step in a row that it does not track.
            off = (tracking[name] < FALL) & (steps < horizon[:, None])
            fell = off[:, 2:] & off[:, 1:-1] & off[:, :-2]
            length[name] = np.where(fell.any(1), np.maximum(fell.argmax(1), 1), horizon)
        movement = np.full(joints.shape[:2], 0.04)
        deviation = {
            name: movement * np.where(steps < length[name][:, None], 1.0 - values, 1.0)
            for name, values in tracking.items()
        }
        return Performance(self.names, self.clip, self.start_frame, horizon, length, tracking, deviation, movement)
