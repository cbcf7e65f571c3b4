import pytest
from physics_cases import CASES, SUBSTEPS, Inputs, make_inputs

from forgetmimic_jax.physics.native import NativeEngine
from forgetmimic_jax.robot.model import Robot, load_robot


@pytest.fixture(scope="session", params=["g1", "h2"])
def robot(request) -> Robot:
    return load_robot(request.param)


@pytest.fixture(scope="session")
def native(robot) -> NativeEngine:
    return NativeEngine(robot, SUBSTEPS, len(CASES))


@pytest.fixture(scope="session")
def inputs(robot, native) -> Inputs:
    return make_inputs(robot, native)


@pytest.fixture(scope="session")
def native_result(native, inputs):
    return native.step(*inputs)
