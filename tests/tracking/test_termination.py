import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scene import on_reference, turned, upright_scene
from scipy.spatial.transform import Rotation

from forgetmimic_jax.robot.model import load_robot
from forgetmimic_jax.settings.config import TerminationConfig
from forgetmimic_jax.tracking.reference import align_to_anchor, lookup
from forgetmimic_jax.tracking.termination import terminations

LITERAL_ANGLE = TerminationConfig(orientation_rule="angle")


def causes(robot, reference, bodies, config=TerminationConfig()) -> set[str]:  # noqa: B008 (a frozen dataclass)
    aligned = align_to_anchor(reference, robot.anchor, bodies.pos[:, robot.anchor], bodies.quat[:, robot.anchor])
    result = terminations(config, reference, aligned, bodies, robot)
    return {name for name, value in result.items() if bool(value[0])}


def lifted(bodies, body: int, metres: float):
    return dataclasses.replace(bodies, pos=bodies.pos.at[0, body, 2].add(metres))


def tilted(bodies, body: int, axis: str, radians: float):
    turn = jnp.asarray(Rotation.from_euler(axis, radians).as_quat(scalar_first=True), jnp.float32)
    return dataclasses.replace(bodies, quat=bodies.quat.at[0, body].set(turn))


def pushed(bodies, body: int, force: tuple[float, float, float]):
    return dataclasses.replace(bodies, contact_force=bodies.contact_force.at[0, body].set(jnp.array(force)))


def test_a_robot_on_the_reference_goes_on(robot, library):
    reference = lookup(library, jnp.array([1]), jnp.array([30]))
    assert causes(robot, reference, on_reference(reference)) == set()
    assert causes(robot, reference, on_reference(reference), LITERAL_ANGLE) == set()


@pytest.mark.parametrize("sign", [1, -1])
def test_anchor_height_ends_beyond_35_cm(robot, sign):
    reference, bodies = upright_scene(robot)
    assert causes(robot, reference, lifted(bodies, robot.anchor, sign * 0.349)) == set()
    assert causes(robot, reference, lifted(bodies, robot.anchor, sign * 0.351)) == {"anchor_height"}


@pytest.mark.parametrize("sign", [1, -1])
def test_any_end_effectors_height_ends_beyond_25_cm(robot, sign):
    reference, bodies = upright_scene(robot)
    for body in robot.end_effectors:
        assert causes(robot, reference, lifted(bodies, body, sign * 0.249)) == set()
        assert causes(robot, reference, lifted(bodies, body, sign * 0.251)) == {"end_effector_height"}


def test_no_other_bodys_height_matters(robot):
    reference, bodies = upright_scene(robot)
    for body in set(range(14)) - set(robot.end_effectors) - {robot.anchor}:
        assert causes(robot, reference, lifted(bodies, body, 0.6)) == set()


@pytest.mark.parametrize("axis", ["x", "y"])
def test_gravity_rule_ends_where_the_cosine_has_fallen_by_0_8(robot, axis):
    edge = np.arccos(1.0 - 0.8)  # 1.369 rad from upright
    reference, bodies = upright_scene(robot)
    assert causes(robot, reference, tilted(bodies, robot.anchor, axis, edge - 0.01)) == set()
    assert causes(robot, reference, tilted(bodies, robot.anchor, axis, edge + 0.01)) == {"orientation"}


def test_gravity_rule_does_not_see_yaw(robot):
    reference, bodies = upright_scene(robot)
    assert causes(robot, reference, tilted(bodies, robot.anchor, "z", 3.0)) == set()


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_angle_rule_ends_beyond_0_8_rad_about_any_axis(robot, axis):
    reference, bodies = upright_scene(robot)
    assert causes(robot, reference, tilted(bodies, robot.anchor, axis, 0.79), LITERAL_ANGLE) == set()
    assert causes(robot, reference, tilted(bodies, robot.anchor, axis, -0.81), LITERAL_ANGLE) == {"orientation"}


def test_contact_force_ends_beyond_2000_n_on_any_key_body(robot):
    reference, bodies = upright_scene(robot)
    for body in range(14):
        assert causes(robot, reference, pushed(bodies, body, (1199.0, 0.0, -1599.0))) == set()
        assert causes(robot, reference, pushed(bodies, body, (1201.0, 0.0, -1601.0))) == {"contact_force"}


def test_the_contact_force_that_ends_an_episode_grows_with_the_robot_s_mass(robot):
    # 6.1148 weights of 75.5875 kg: 4534 N.
    reference, bodies = upright_scene(robot)
    h2 = dataclasses.replace(robot, model=load_robot("h2").model)
    assert causes(h2, reference, pushed(bodies, 0, (0.0, 0.0, 4533.0))) == set()
    assert causes(h2, reference, pushed(bodies, 0, (0.0, 0.0, 4535.0))) == {"contact_force"}


def test_place_and_heading_end_nothing_by_themselves(robot, library):
    reference = lookup(library, jnp.array([0]), jnp.array([10]))
    assert causes(robot, reference, turned(on_reference(reference), 2.0, (8.0, -3.0))) == set()
