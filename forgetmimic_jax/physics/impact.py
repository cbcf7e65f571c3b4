"""MuJoCo's C engine with every contact of the robot: what a robot meets that no termination ends."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from forgetmimic_jax.physics.engine import CONTACT_FORCE, BodyState, PhysicsParameters, PhysicsState
from forgetmimic_jax.physics.native import VELOCITY_STAGE, HostBatch, NativeEngine
from forgetmimic_jax.robot.model import CONTACT_SENSOR, HEAD_SENSOR, Robot, touching_bodies, with_every_contact

SATURATED = 0.95  # of a motor's torque limit


@struct.dataclass
class Impact(BodyState):
    """Key bodies, and what the whole robot met during the control step; a force is the floor's on one body."""

    impact_force: Array  # [env] N, the largest on a body that is no foot, over the physics steps
    impact_speed: Array  # [env] m/s downward, the root's before the first physics step with such a force; 0 without
    head_contact: Array  # [env] 1 where the head touched the floor, else 0
    hand_contact: Array  # [env] 1 where a hand did, else 0
    torque_saturation: Array  # [env] share of joints and physics steps beyond 95 % of the torque limit


SEEN = tuple(name for name in Impact.__dataclass_fields__ if name not in BodyState.__dataclass_fields__)


class ImpactBatch(HostBatch):
    """Rows of a robot whose shapes touch each other. It looks at the contacts after every physics step.

    An impact lasts some 10 ms, less than a control step.
    """

    seen = len(SEEN)

    def __init__(self, robot: Robot, substeps: int, num_envs: int, num_threads: int):
        super().__init__(robot, substeps, num_envs, num_threads)
        model = robot.model
        touching = [model.body(body).id for body in touching_bodies(robot)]
        not_feet = [body for body in touching if body not in robot.pairs.feet]
        hands = [body for body in touching if body in robot.pairs.hands]
        sensors = {
            "bodies": [CONTACT_SENSOR + model.body(body).name for body in not_feet],
            "hands": [CONTACT_SENSOR + model.body(body).name for body in hands],
            "head": [HEAD_SENSOR + model.geom(shape).name for shape in robot.head_geom_ids],
        }
        self._columns = {
            part: np.array([model.sensor(name).adr[0] for name in names], int)[:, None] + np.arange(3)
            for part, names in sensors.items()
        }
        self._torque = self._batch.bind("actuator_force")
        self._saturated = SATURATED * model.actuator_forcerange[:, 1]

    def _advance(self) -> tuple[np.ndarray, ...]:
        """The fields of `Impact` that `BodyState` lacks, each [env]."""
        rows = len(self._batch.qpos)
        largest, speed, saturated = np.zeros((3, rows))
        head, hands = np.zeros((2, rows), bool)
        for _ in range(self._substeps):
            downward = -self._batch.qvel[:, 2]
            self._batch.step(nstep=1, stage=VELOCITY_STAGE)
            force = self._floor_force("bodies")
            speed = np.where((largest <= CONTACT_FORCE) & (force > CONTACT_FORCE), downward, speed)
            largest = np.maximum(largest, force)
            head |= self._floor_force("head") > CONTACT_FORCE
            hands |= self._floor_force("hands") > CONTACT_FORCE
            saturated += (np.abs(self._torque) > self._saturated).mean(-1) / self._substeps
        return tuple(values.astype(np.float32) for values in (largest, speed, head, hands, saturated))

    def _floor_force(self, part: str) -> np.ndarray:
        """The floor's largest force [env] N on one of the part's bodies or shapes in the last physics step."""
        force = np.asarray(self._outputs["sensordata"][:, self._columns[part]])
        return np.linalg.norm(force, axis=-1).max(-1, initial=0.0)


class ImpactEngine(NativeEngine):
    """The C engine for a robot whose shapes touch each other."""

    host = ImpactBatch

    def __init__(self, robot: Robot, substeps: int, num_envs: int):
        super().__init__(with_every_contact(robot), substeps, num_envs)

    def step(
        self, state: PhysicsState, parameters: PhysicsParameters, joint_target: Array, wrench: Array
    ) -> tuple[PhysicsState, Impact]:
        """See `Engine.step`."""
        state, bodies, seen = self._stepped(state, parameters, joint_target, wrench)
        return state, Impact(**vars(bodies), **dict(zip(SEEN, seen, strict=True)))

    def forward(self, state: PhysicsState, parameters: PhysicsParameters, mask: Array, bodies: BodyState) -> Impact:
        """See `Engine.forward`; nothing was met yet, by any robot."""
        fresh = super().forward(state, parameters, mask, bodies)
        nothing = jnp.zeros(mask.shape, jnp.float32)
        return Impact(**vars(fresh), **dict.fromkeys(SEEN, nothing))
