"""What a deploy tool makes of an exported policy: its observation and its joint targets.

Written with nothing but NumPy, MuJoCo and the ONNX file's own metadata (the terms, the body that they are of, the order
of the joints, gains, default pose, scales, action mode), so that a mistake in the export, or in the environment that
the policy was trained in, shows.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np

from forgetmimic_jax.exchange.onnx_actor import ACTION_MODES, OnnxActor
from forgetmimic_jax.motion.library import Frames
from forgetmimic_jax.robot.model import Robot

DOWN = np.array([0.0, 0.0, -1.0])


class Deployed:
    """An exported policy on a robot, by the metadata of the policy alone: names, order of joints, gains, scales."""

    def __init__(self, actor: OnnxActor, robot: Robot):
        self.actor, self.robot, self.model = actor, robot, copy.copy(robot.model)
        self.names = actor.names("observation_names")
        self.joints = np.array([robot.joint_names.index(name) for name in actor.names("joint_names")])
        self.body = actor.names("body_names").index(actor.metadata["anchor_body_name"])  # among the reference's
        self.body_id = self.model.body(actor.metadata["anchor_body_name"]).id
        self.default, self.scale = actor.numbers("default_joint_pos"), actor.numbers("action_scale")
        self.offset = actor.metadata["action_mode"] == ACTION_MODES["offset"]
        stiffness, damping = actor.numbers("joint_stiffness"), actor.numbers("joint_damping")
        self.model.actuator_gainprm[self.joints, 0] = stiffness
        self.model.actuator_biasprm[self.joints, 1] = -stiffness
        self.model.actuator_biasprm[self.joints, 2] = -damping

    def observation(self, data: mujoco.MjData, reference: Frames, last_action: np.ndarray) -> np.ndarray:
        """The actor's observation f32[features] from the robot's sensors and the frame to reach next."""
        seen = Seen(self, data, reference, last_action)
        return np.concatenate([np.ravel(TERMS[name](seen)) for name in self.names]).astype(np.float32)

    def joint_target(self, reference: Frames, action: np.ndarray) -> np.ndarray:
        """Joint targets f64[joint] rad of the PD loops, in the model's order."""
        origin = self.default if self.offset else reference.joint_pos[self.joints]
        joint_target = np.zeros(len(action))
        joint_target[self.joints] = origin + self.scale * action
        return joint_target


class Seen(NamedTuple):
    """What the terms of an observation are made of."""

    deployed: Deployed
    data: mujoco.MjData
    reference: Frames
    last_action: np.ndarray  # [joint]

    def of_reference(self, field: str) -> np.ndarray:
        """A field of the reference's body."""
        return getattr(self.reference.bodies, field)[self.deployed.body]

    def in_reference(self, vector: np.ndarray) -> np.ndarray:
        """A world vector in the frame of the reference's body."""
        return _in_frame(self.of_reference("quat"), vector)

    @property
    def body_quat(self) -> np.ndarray:
        """Of the robot's own body of the same name."""
        return self.data.xquat[self.deployed.body_id]

    def anchor_position(self) -> np.ndarray:
        """The reference's body seen from the robot's."""
        return _in_frame(self.body_quat, self.of_reference("pos") - self.data.xpos[self.deployed.body_id])

    def anchor_orientation(self) -> np.ndarray:
        """The first two columns of the rotation from the robot's body to the reference's, [3, 2]."""
        inverse, relative, matrix = np.zeros(4), np.zeros(4), np.zeros(9)
        mujoco.mju_negQuat(inverse, self.body_quat)
        mujoco.mju_mulQuat(relative, inverse, self.of_reference("quat"))
        mujoco.mju_quat2Mat(matrix, relative)
        return matrix.reshape(3, 3)[:, :2]

    def joints(self, values: np.ndarray) -> np.ndarray:
        """Values [joint] of the model in the policy's order."""
        return values[self.deployed.joints]


_REFERENCE: dict[str, Callable[[Seen], np.ndarray]] = {
    "height": lambda s: s.of_reference("pos")[2:],
    "lin_vel_b": lambda s: s.in_reference(s.of_reference("lin_vel")),
    "ang_vel_b": lambda s: s.in_reference(s.of_reference("ang_vel")),
    "gravity_b": lambda s: s.in_reference(DOWN),
}
TERMS: dict[str, Callable[[Seen], np.ndarray]] = {
    **{f"ref_base_{name}": value for name, value in _REFERENCE.items() if name != "gravity_b"},
    "ref_gravity_b": _REFERENCE["gravity_b"],
    **{f"ref_root_{name}": value for name, value in _REFERENCE.items()},
    "ref_joint_pos": lambda s: s.joints(s.reference.joint_pos),
    "command": lambda s: np.stack([s.joints(s.reference.joint_pos), s.joints(s.reference.joint_vel)]),
    "motion_anchor_pos_b": lambda s: s.anchor_position(),
    "motion_anchor_ori_b": lambda s: s.anchor_orientation(),
    "base_lin_vel": lambda s: _in_frame(s.data.qpos[3:7], s.data.qvel[:3]),
    "base_ang_vel": lambda s: s.data.qvel[3:6],
    "projected_gravity": lambda s: _in_frame(s.data.qpos[3:7], DOWN),
    "joint_pos": lambda s: s.joints(s.data.qpos[7:]) - s.deployed.default,
    "joint_vel": lambda s: s.joints(s.data.qvel[6:]),
    "actions": lambda s: s.last_action,
}


def _in_frame(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """A world vector in the frame that `quat` turns into the world."""
    inverse, result = np.zeros(4), np.zeros(3)
    mujoco.mju_negQuat(inverse, quat)
    mujoco.mju_rotVecQuat(result, vector, inverse)
    return result
