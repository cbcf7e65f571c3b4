"""MuJoCo's C engine on all CPU cores (`mujoco.batch`) behind a pure callback: the default engine on a CPU."""

from __future__ import annotations

import copy
import threading

import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np
from jax import Array

from forgetmimic_jax.basics.provenance import cores
from forgetmimic_jax.physics.engine import (
    BodyState,
    PhysicsParameters,
    PhysicsState,
    body_state,
    contact_sensor_columns,
    select_rows,
)
from forgetmimic_jax.robot.model import Robot

VELOCITY_STAGE = int(mujoco.mjtStage.mjSTAGE_VEL)


class NativeEngine:
    """A `mujoco.batch.Batch` whose rows are only scratch: every call loads the state it is given.

    Purity is what allows `jax.pure_callback`: nothing of one call is felt by the next. Under `vmap`, as of a whole
    iteration over several trainings, the members are stepped one after the other.
    """

    def __init__(self, robot: Robot, substeps: int, num_envs: int, num_threads: int = 0):
        model = copy.copy(robot.model)
        # A diverged simulation must show as NaN, to be counted; MuJoCo's own reset would hide it.
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        mujoco.set_mju_user_warning(lambda message: None)
        self._batch = mujoco.batch.Batch(model, num_envs, num_threads or cores())
        self._lock = threading.Lock()
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
        keys = len(self._keys)

        def shape(*dims: int) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct((num_envs, *dims), jnp.float32)

        self._state_shapes = (shape(model.nq), shape(model.nv), shape(model.nv))
        self._body_shapes = (shape(keys, 3), shape(keys, 4), shape(keys, 6), shape(3))
        self._force_shape = shape(keys, 3)
        self._seen_shapes: tuple[jax.ShapeDtypeStruct, ...] = ()

    def step(
        self, state: PhysicsState, parameters: PhysicsParameters, joint_target: Array, wrench: Array
    ) -> tuple[PhysicsState, BodyState]:
        """See `Engine.step`."""
        return self._stepped(state, parameters, joint_target, wrench)[:2]

    def forward(self, state: PhysicsState, parameters: PhysicsParameters, mask: Array, bodies: BodyState) -> BodyState:
        """See `Engine.forward`."""
        xpos, xquat, cvel, com = jax.pure_callback(
            self._forward_host,
            self._body_shapes,
            (state.qpos, state.qvel, state.warmstart, parameters.foot_friction, parameters.torso_com, mask),
            vmap_method="sequential",
        )
        fresh = body_state(xpos, xquat, cvel, com, jnp.zeros_like(bodies.contact_force))
        return select_rows(mask, fresh, bodies)

    def _stepped(
        self, state: PhysicsState, parameters: PhysicsParameters, joint_target: Array, wrench: Array
    ) -> tuple[PhysicsState, BodyState, list[Array]]:
        """The results of `Engine.step`, and what `_advance` saw."""
        shapes = (*self._state_shapes, *self._body_shapes, self._force_shape, *self._seen_shapes)
        loaded = (state.qpos, state.qvel, state.warmstart, parameters.foot_friction, parameters.torso_com)
        qpos, qvel, warmstart, xpos, xquat, cvel, com, force, *seen = jax.pure_callback(
            self._step_host,
            shapes,
            (*loaded, joint_target, wrench),
            vmap_method="sequential",
        )
        return PhysicsState(qpos, qvel, warmstart), body_state(xpos, xquat, cvel, com, force), seen

    def _advance(self) -> tuple[np.ndarray, ...]:
        """The physics steps of one control step; returns what is to be seen of them, in the shapes `_seen_shapes`."""
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
        arrays = tuple(np.zeros(shape.shape, np.float32) for shape in self._body_shapes)
        for array, (name, columns) in zip(arrays, fields, strict=True):
            array[rows] = self._outputs[name][rows][:, columns]
        return arrays

    def _step_host(self, arguments) -> tuple[np.ndarray, ...]:
        *loaded, joint_target, wrench = (np.asarray(x) for x in arguments)
        # What overflows float32 has diverged, and shows as infinity: no warning on the user's screen.
        with self._lock, np.errstate(over="ignore"):
            batch = self._batch
            self._load(self._everyone, *loaded)
            batch.ctrl[:] = joint_target
            batch.xfrc_applied[:, self._anchor] = wrench
            seen = self._advance()
            force = -self._outputs["sensordata"][:, self._contact_columns].astype(np.float32)
            new = tuple(x.astype(np.float32) for x in (batch.qpos, batch.qvel, batch.qacc_warmstart))
            return (*new, *self._bodies(self._everyone), force, *seen)

    def _forward_host(self, arguments) -> tuple[np.ndarray, ...]:
        *loaded, mask = (np.asarray(x) for x in arguments)
        with self._lock:
            rows = np.flatnonzero(mask)
            if rows.size:
                self._load(rows, *loaded)
                self._batch.forward(ids=rows.astype(np.int32), stage=VELOCITY_STAGE)
            return self._bodies(rows)
