"""MJX: the same physics as an XLA (`jax`) or a Warp (`warp`) program, the engine on accelerators."""

from __future__ import annotations

import contextlib
import functools
import io
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from forgetmimic_jax.basics.console import warn
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.rows import select_rows
from forgetmimic_jax.physics.engine import (
    BodyState,
    PhysicsParameters,
    PhysicsState,
    body_state,
    contact_sensor_columns,
)
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.settings.config import PhysicsConfig

with contextlib.redirect_stdout(io.StringIO()):  # without warp, the import prints that it is missing
    import mujoco.mjx.warp
    from mujoco import mjx
    from mujoco.mjx._src import support

# What no longer fits into Warp's arrays, and the setting that gives more room: bits of mujoco_warp's OverflowType.
FULL = {"warp_constraints": 1 << 0, "warp_contacts": (1 << 2) | (1 << 3)}


class Room(NamedTuple):
    """Of an environment in Warp's arrays; the jax implementation sizes its own."""

    contacts: int
    constraints: int


PAPER_ROOM = Room(PhysicsConfig.warp_contacts, PhysicsConfig.warp_constraints)  # the settings' defaults


class MjxEngine:
    """MJX under `vmap`; the model's randomised values enter as mapped leaves of the model."""

    def __init__(
        self, robot: Robot, substeps: int, implementation: Literal["jax", "warp"] = "jax", room: Room = PAPER_ROOM
    ):
        if implementation == "warp" and not mujoco.mjx.warp.WARP_INSTALLED:
            raise InputError("physics engine 'mjx-warp': warp is not installed; pip install 'mujoco-mjx[warp]'")
        self._robot = robot
        self._substeps = substeps
        self._implementation, self._room = implementation, room
        self._keys = robot.key_body_ids
        self._anchor = robot.anchor_body_id
        self._feet = robot.foot_geom_ids
        self._floor = robot.model.geom("floor").id
        plain = _without_contact_sensors(robot.spec)
        # Bodies at the new state are always computed in jax: Warp gives velocities only inside a whole step.
        self._body_model = mjx.put_model(plain, impl="jax")
        self._body_data = mjx.make_data(plain, impl="jax")
        self._model = self._body_model if implementation == "jax" else _warp_model(robot)

    @property
    def num_contacts(self) -> int:
        """Contact points per environment that the jax implementation computes, touching or not."""
        return int(self._body_data._impl.ncon)

    def step(
        self, state: PhysicsState, parameters: PhysicsParameters, joint_target: Array, wrench: Array
    ) -> tuple[PhysicsState, BodyState]:
        """See `Engine.step`."""
        start = self._start(state.qpos.shape[0])
        physics_step = mjx.step if self._implementation == "warp" else _step

        def one(
            state: PhysicsState, parameters: PhysicsParameters, joint_target: Array, wrench: Array
        ) -> tuple[PhysicsState, Array, Array]:
            model = self._model.tree_replace(
                {
                    "geom_friction": self._model.geom_friction.at[self._feet, 0].set(parameters.foot_friction),
                    "body_ipos": self._model.body_ipos.at[self._anchor].add(parameters.torso_com),
                }
            )
            data = start.replace(
                qpos=state.qpos,
                qvel=state.qvel,
                qacc_warmstart=state.warmstart,
                ctrl=joint_target,
                xfrc_applied=start.xfrc_applied.at[self._anchor].set(wrench),
            )
            data, full = jax.lax.scan(
                lambda d, _: ((d := physics_step(model, d)), self._full(d)), data, length=self._substeps
            )
            return PhysicsState(data.qpos, data.qvel, data.qacc_warmstart), self._contact_force(model, data), full

        # An accelerator's default precision for products (TF32, bfloat16) would ruin the solver.
        with jax.default_matmul_precision("highest"):
            state, force, full = jax.vmap(one)(state, parameters, joint_target, wrench)
            if self._implementation == "warp":
                _say_where_full(full, self._room)
            return state, self._bodies(state, force)

    def forward(self, state: PhysicsState, parameters: PhysicsParameters, mask: Array, bodies: BodyState) -> BodyState:
        """See `Engine.forward`."""
        # Friction and centre of mass move no body's origin.
        with jax.default_matmul_precision("highest"):
            return select_rows(mask, self._bodies(state, jnp.zeros_like(bodies.contact_force)), bodies)

    def _start(self, num_envs: int) -> mjx.Data:
        """The data of one environment at rest, with Warp's contact arrays large enough for all of them."""
        if self._implementation == "jax":
            return self._body_data
        return _warp_data(self._robot, num_envs, self._room)

    def _full(self, data: mjx.Data) -> Array:
        """Which of FULL a physics step ran out of, as bits []."""
        return data._impl.overflow if self._implementation == "warp" else jnp.zeros((), jnp.int32)

    def _bodies(self, state: PhysicsState, force: Array) -> BodyState:
        """Key bodies at `state`, with the contact forces [env, key_body, 3] given."""

        def one(qpos: Array, qvel: Array) -> tuple[Array, ...]:
            data = self._body_data.replace(qpos=qpos, qvel=qvel)
            for stage in (mjx.kinematics, mjx.com_pos, mjx.com_vel):
                data = stage(self._body_model, data)
            keys = self._keys
            return data.xpos[keys], data.xquat[keys], data.cvel[keys], data.subtree_com[1]

        xpos, xquat, cvel, com = jax.vmap(one)(state.qpos, state.qvel)
        return body_state(xpos, xquat, cvel, com, force)

    def _contact_force(self, model: mjx.Model, data: mjx.Data) -> Array:
        """Force [key_body, 3] N of the floor on each key body in one environment's last physics step."""
        if self._implementation == "warp":
            return -data.sensordata[contact_sensor_columns(self._robot)]
        contact = data._impl.contact
        total = jnp.zeros((len(self._keys), 3))
        for dim in np.unique(contact.dim):
            force, ids = support.contact_force_dim(model, data, dim)  # [contact, 6], normal first
            force = jnp.einsum("cij,ci->cj", contact.frame[ids], force[:, :3])
            # A plane comes first in MJX's pairs, and the normal points from the first shape to the second.
            floor, geom = contact.geom[ids].T
            body = jnp.asarray(model.geom_bodyid)[geom]
            mine = (body == self._keys[:, None]) & (floor == self._floor)
            total += mine.astype(force.dtype) @ force
        return total


def _step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.step` for implicitfast, with the other engines' rule for saturated motors.

    A motor at its torque limit does not answer to velocity, so C and Warp leave its damping out of the implicit
    integration; `mjx.step` keeps it, which slows a saturated joint by rad/s within a control step.

    On a CPU, LAPACK's part of the step comes in one order: the integrator's factorisation needs the solver's result.
    jaxlib's batched LAPACK calls hold a thread of XLA's pool while they wait for the other threads to do the work. Two
    calls at once hold both threads of two cores, and wait forever.
    """
    data = mjx.forward(model, data)
    lower, upper = model.actuator_forcerange.T
    saturated = model.actuator_forcelimited & ((data.actuator_force <= lower) | (data.actuator_force >= upper))
    damping = jnp.where(saturated, 0.0, model.actuator_biasprm[:, 2])
    damping = jnp.where(jnp.isfinite(data.qacc).all(), damping, jnp.nan)  # the order above; diverged stays diverged
    return mjx.implicit(model.tree_replace({"actuator_biasprm": model.actuator_biasprm.at[:, 2].set(damping)}), data)


def _without_contact_sensors(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """The model without its contact sensors, which the jax implementation lacks; forces come from the contacts."""
    spec = spec.copy()
    for sensor in list(spec.sensors):
        if sensor.type == mujoco.mjtSensor.mjSENS_CONTACT:
            spec.delete(sensor)
    return spec.compile()


def _warp_model(robot: Robot) -> mjx.Model:
    """Warp's model, which leaves it to `_say_where_full` to say that its arrays are full."""
    import warp

    warp.config.quiet = True  # type: ignore[attr-defined]
    model = mjx.put_model(robot.model, impl="warp")
    return model.replace(opt=model.opt.replace(_impl=model.opt._impl.replace(warn_overflow=0)))


def _say_where_full(full: Array, room: Room) -> None:
    """Warn, once for each setting of FULL, if any of the bits `full` is set: a contact was left out of a step."""

    def say(bits: np.ndarray) -> None:
        for setting, mask in FULL.items():
            if (bits & mask).any():
                _say_full(setting, getattr(room, setting.removeprefix("warp_")))

    masks = sum(FULL.values())
    jax.lax.cond(((full & masks) != 0).any(), lambda: jax.debug.callback(say, full), lambda: None)


@functools.cache
def _say_full(setting: str, room: int) -> None:
    warn(
        f"physics.{setting}: {room} is too few, so contacts were left out of the simulation and the robot moved "
        f"wrongly; give more with --set physics.{setting}={2 * room}"
    )


def _warp_data(robot: Robot, num_envs: int, room: Room) -> mjx.Data:
    """Warp's data for one of `num_envs` environments."""
    with jax.ensure_compile_time_eval():
        data = mjx.make_data(robot.model, impl="warp", naconmax=room.contacts * num_envs, njmax=room.constraints)
    return jax.tree.map(_broadcast_constant, data)


def _broadcast_constant(leaf: Array) -> Array:
    """`leaf`, as a broadcast where it holds one value only: large scratch is then not stored in the executable."""
    values = np.asarray(leaf)
    if values.size > 1 and (values == values.flat[0]).all():
        return jnp.full(values.shape, values.flat[0], values.dtype)
    return leaf
