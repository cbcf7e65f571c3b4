"""The protocol both engines keep. Leading dimension of every array: environment.

An engine is stateless: what goes in decides what comes out, so a rollout can be stopped, saved and resumed.
"""

from __future__ import annotations

from typing import Protocol

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from forgetmimic_jax.basics import rotation
from forgetmimic_jax.robot.bodies import Bodies
from forgetmimic_jax.robot.model import CONTACT_SENSOR, Robot

CONTACT_FORCE = 1.0  # N, above which a body counts as touching the floor


@struct.dataclass
class PhysicsState:
    """All that a simulation step needs from the step before it."""

    qpos: Array  # [env, 7 + joint] root position m, root quaternion, joint positions rad
    qvel: Array  # [env, 6 + joint] root linear velocity (world), root angular velocity (root frame), joint velocities
    warmstart: Array  # [env, 6 + joint] the last physics step's acceleration, where the solver starts


@struct.dataclass
class PhysicsParameters:
    """What randomisation changes in the model, per environment."""

    foot_friction: Array  # [env] sliding friction of the soles
    torso_com: Array  # [env, 3] m, offset of the anchor body's centre of mass


@struct.dataclass
class BodyState(Bodies):
    """Key bodies [env, key_body, ...] of the simulated robots, and what they touch."""

    contact_force: Array  # [env, key_body, 3] N of the floor on the body, world frame, during the last physics step


class Engine(Protocol):
    """Steps and forward kinematics of a batch of robots; pure in the JAX sense."""

    def step(
        self, state: PhysicsState, parameters: PhysicsParameters, joint_target: Array, wrench: Array
    ) -> tuple[PhysicsState, BodyState]:
        """One control step.

        Args:
            state: state before the step.
            parameters: randomised model values.
            joint_target: [env, joint] rad, position targets of the PD loops.
            wrench: [env, 6] N and N m in the world frame, on the anchor body at its centre of mass.

        Returns:
            The state after the step, and the key bodies there.
        """
        ...

    def forward(self, state: PhysicsState, parameters: PhysicsParameters, mask: Array, bodies: BodyState) -> BodyState:
        """Key bodies of `state` where mask [env] holds, `bodies` elsewhere; contact forces there are zero."""
        ...


def body_state(xpos: Array, xquat: Array, cvel: Array, com: Array, contact_force: Array) -> BodyState:
    """Key-body velocities at the bodies' origins from MuJoCo's spatial velocity about the robot's centre of mass.

    Args:
        xpos: [env, key_body, 3] m.
        xquat: [env, key_body, 4].
        cvel: [env, key_body, 6] angular then linear, world axes, at `com`.
        com: [env, 3] m.
        contact_force: [env, key_body, 3] N.
    """
    ang_vel, lin_vel_com = cvel[..., :3], cvel[..., 3:]
    lin_vel = lin_vel_com + jnp.cross(ang_vel, xpos - com[:, None])
    return BodyState(
        pos=xpos, quat=rotation.normalize(xquat), lin_vel=lin_vel, ang_vel=ang_vel, contact_force=contact_force
    )


def contact_sensor_columns(robot: Robot) -> np.ndarray:
    """Columns [key_body, 3] of `sensordata` that hold the force of each key body on the floor, N in the world frame.

    MuJoCo gives the force of the sensor's first object on its second, the floor; an engine returns the opposite.
    """
    first = [int(robot.model.sensor(CONTACT_SENSOR + body).adr[0]) for body in robot.key_bodies]
    return np.array(first)[:, None] + np.arange(3)
