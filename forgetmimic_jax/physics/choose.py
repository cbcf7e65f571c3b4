"""Which engine a config means, and how it is made."""

from __future__ import annotations

import jax

from forgetmimic_jax.physics.engine import Engine
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.settings.config import EngineName, PhysicsConfig


def resolve_engine(name: EngineName) -> str:
    """`auto` becomes native on a CPU and mjx on a GPU or TPU."""
    if name != "auto":
        return name
    return "native" if jax.default_backend() == "cpu" else "mjx"


def make_engine(robot: Robot, config: PhysicsConfig, num_envs: int, shards: int = 1) -> Engine:
    """The engine that `config.engine` names, for a batch of `num_envs` robots on each of this process's shards."""
    name = resolve_engine(config.engine)
    if name == "native":
        from forgetmimic_jax.physics.native import NativeEngine

        return NativeEngine(robot, config.substeps, num_envs, shards=shards)
    from forgetmimic_jax.physics.mjx import MjxEngine, Room

    if name == "mjx":
        return MjxEngine(robot, config.substeps)
    room = Room(config.warp_contacts, config.warp_constraints)
    return MjxEngine(robot, config.substeps, implementation="warp", room=room)
