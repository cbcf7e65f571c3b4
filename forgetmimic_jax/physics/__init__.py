"""Physics behind one protocol, with two engines: MuJoCo's own C engine and MJX."""

from forgetmimic_jax.physics.engine import BodyState, Engine, PhysicsParameters, PhysicsState, make_engine

__all__ = ["BodyState", "Engine", "PhysicsParameters", "PhysicsState", "make_engine"]
