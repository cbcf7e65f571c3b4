"""Simulation behind one protocol, with two engines: MuJoCo's own C engine and MJX.

What a robot is to do is in `tracking`; the robot itself is in `robot`.
"""

from forgetmimic_jax.physics.engine import BodyState, Engine, PhysicsParameters, PhysicsState

__all__ = ["BodyState", "Engine", "PhysicsParameters", "PhysicsState"]
