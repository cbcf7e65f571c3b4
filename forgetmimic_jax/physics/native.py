"""MuJoCo's C engine on all CPU cores (`mujoco.batch`) as a function of the host: the default engine on a CPU."""

from __future__ import annotations

import copy
import queue
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np
from jax import Array

from forgetmimic_jax.basics.provenance import cores
from forgetmimic_jax.basics.rows import select_rows
from forgetmimic_jax.physics.engine import (
    BodyState,
    PhysicsParameters,
    PhysicsState,
    body_state,
    contact_sensor_columns,
)
from forgetmimic_jax.physics.host_call import Function, HostFunction
from forgetmimic_jax.robot.model import Robot

VELOCITY_STAGE = int(mujoco.mjtStage.mjSTAGE_VEL)


class HostBatch:
    """A `mujoco.batch.Batch` whose rows are only scratch: every call, one at a time, loads the state it is given."""

    seen = 0  # further results of a control step, each [env]

    def __init__(self, robot: Robot, substeps: int, num_envs: int, num_threads: int):
        model = copy.copy(robot.model)
        # A diverged simulation must show as NaN, to be counted; MuJoCo's own reset would hide it.
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        mujoco.set_mju_user_warning(lambda message: None)
        self._batch = mujoco.batch.Batch(model, num_envs, num_threads)
        self._substeps = substeps
        self._keys = robot.key_body_ids
        self._anchor = robot.anchor_body_id
        self._torso_com = model.body_ipos[self._anchor].copy()
        self._feet = robot.foot_geom_ids
        self._everyone = slice(None)
        self._contact_columns = contact_sensor_columns(robot)
        self._outputs = {
            name: self._batch.bind(name) for name in ("xpos", "xquat", "cvel", "subtree_com", "sensordata")
        }
        self._friction = self._batch.expand("geom_friction")
        self._body_ipos = self._batch.expand("body_ipos")

    def step(self, *arguments: np.ndarray) -> tuple[np.ndarray, ...]:
        """A control step of all rows."""
        *loaded, joint_target, wrench = arguments
        # What overflows float32 has diverged, and shows as infinity: no warning on the user's screen.
        with np.errstate(over="ignore"):
            batch = self._batch
            self._load(self._everyone, *loaded)
            batch.ctrl[:] = joint_target
            batch.xfrc_applied[:, self._anchor] = wrench
            seen = self._advance()
            force = -self._outputs["sensordata"][:, self._contact_columns].astype(np.float32)
            new = tuple(x.astype(np.float32) for x in (batch.qpos, batch.qvel, batch.qacc_warmstart))
            return (*new, *self._bodies(self._everyone), force, *seen)

    def forward(self, *arguments: np.ndarray) -> tuple[np.ndarray, ...]:
        """The bodies of the rows in a mask, which is the last argument."""
        *loaded, mask = arguments
        rows = np.flatnonzero(mask)
        if rows.size:
            self._load(rows, *loaded)
            self._batch.forward(ids=rows.astype(np.int32), stage=VELOCITY_STAGE)
        return self._bodies(rows)

    def _advance(self) -> tuple[np.ndarray, ...]:
        """The physics steps of one control step; returns what is to be seen of them."""
        self._batch.step(nstep=self._substeps, stage=VELOCITY_STAGE)
        return ()

    def _load(self, rows, qpos, qvel, warmstart, friction, torso_com) -> None:
        batch = self._batch
        batch.qpos[rows] = qpos[rows]
        batch.qvel[rows] = qvel[rows]
        batch.qacc_warmstart[rows] = warmstart[rows]
        for geom in self._feet:
            self._friction[rows, geom, 0] = friction[rows]
        self._body_ipos[rows, self._anchor] = self._torso_com + torso_com[rows]

    def _bodies(self, rows) -> tuple[np.ndarray, ...]:
        """Key-body fields of `rows`; the other rows are zero."""
        fields = (("xpos", self._keys), ("xquat", self._keys), ("cvel", self._keys), ("subtree_com", 1))
        count, keys = len(self._batch.qpos), len(self._keys)
        arrays = tuple(np.zeros((count, *dims), np.float32) for dims in body_dims(keys))
        for array, (name, columns) in zip(arrays, fields, strict=True):
            array[rows] = self._outputs[name][rows][:, columns]
        return arrays


def body_dims(keys: int) -> tuple[tuple[int, ...], ...]:
    """Dimensions of position, quaternion, velocity and centre of mass of one robot with `keys` key bodies."""
    return (keys, 3), (keys, 4), (keys, 6), (3,)


class NativeEngine:
    """Batches of MuJoCo's own as a function of the host that is pure: a call leaves nothing for the next one.

    Under `vmap`, as of a whole iteration over several trainings, the members are stepped one after the other. The
    shards of a training step at the same time, each in a batch that no other one uses then, with its own threads.

    Args:
        robot: what is simulated.
        substeps: physics steps of a control step.
        num_envs: robots of a batch.
        num_threads: threads of a batch; by default its part of the cores.
        shards: batches that step at the same time.
    """

    host: type[HostBatch] = HostBatch

    def __init__(self, robot: Robot, substeps: int, num_envs: int, num_threads: int = 0, shards: int = 1):
        threads = num_threads or max(1, cores() // shards)
        self._free: queue.SimpleQueue[HostBatch] = queue.SimpleQueue()
        for _ in range(shards):
            self._free.put(self.host(robot, substeps, num_envs, threads))
        model = robot.model

        def shape(*dims: int) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct((num_envs, *dims), jnp.float32)

        keys = len(robot.key_body_ids)
        state = (shape(model.nq), shape(model.nv), shape(model.nv))
        bodies = tuple(shape(*dims) for dims in body_dims(keys))
        seen = (shape(),) * self.host.seen
        computes = _description(self.host, robot, substeps, num_envs, threads, shards)
        self._step = HostFunction(
            self._on_batch(self.host.step), (*state, *bodies, shape(keys, 3), *seen), b"step" + computes
        )
        self._forward = HostFunction(self._on_batch(self.host.forward), bodies, b"forward" + computes)

    def step(
        self, state: PhysicsState, parameters: PhysicsParameters, joint_target: Array, wrench: Array
    ) -> tuple[PhysicsState, BodyState]:
        """See `Engine.step`."""
        return self._stepped(state, parameters, joint_target, wrench)[:2]

    def forward(self, state: PhysicsState, parameters: PhysicsParameters, mask: Array, bodies: BodyState) -> BodyState:
        """See `Engine.forward`."""
        loaded = (state.qpos, state.qvel, state.warmstart, parameters.foot_friction, parameters.torso_com)
        xpos, xquat, cvel, com = self._forward(*loaded, mask)
        fresh = body_state(xpos, xquat, cvel, com, jnp.zeros_like(bodies.contact_force))
        return select_rows(mask, fresh, bodies)

    def _stepped(
        self, state: PhysicsState, parameters: PhysicsParameters, joint_target: Array, wrench: Array
    ) -> tuple[PhysicsState, BodyState, list[Array]]:
        """The results of `Engine.step`, and what the batch saw besides."""
        loaded = (state.qpos, state.qvel, state.warmstart, parameters.foot_friction, parameters.torso_com)
        qpos, qvel, warmstart, xpos, xquat, cvel, com, force, *seen = self._step(*loaded, joint_target, wrench)
        return PhysicsState(qpos, qvel, warmstart), body_state(xpos, xquat, cvel, com, force), seen

    def _on_batch(self, method: Function) -> Function:
        """A method of a batch that nobody else uses until it returns."""
        free = self._free

        def call(*arguments: np.ndarray) -> Sequence[np.ndarray]:
            batch = free.get()
            try:
                return method(batch, *arguments)
            finally:
                free.put(batch)

        return call


def _description(host: type[HostBatch], robot: Robot, *numbers: int) -> bytes:
    """All that a batch's results and its speed depend on besides its arguments."""
    model = np.empty(mujoco.mj_sizeModel(robot.model), np.uint8)
    mujoco.mj_saveModel(robot.model, None, model)
    places = (robot.key_body_ids.tolist(), robot.anchor_body_id, robot.foot_geom_ids.tolist())
    more = (robot.key_bodies, robot.head_geom_ids.tolist(), robot.pairs)
    return repr((host.__qualname__, *numbers, *places, *more)).encode() + model.tobytes()
