"""What the critic sees beside the actor's observation, whose terms `test_layouts.py` checks."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scene import as_reference, body_velocity, key_bodies, on_reference, physics_state, posed

from forgetmimic_jax.motion.library import Frames
from forgetmimic_jax.physics import BodyState
from forgetmimic_jax.tracking.layouts import Moment
from forgetmimic_jax.tracking.observation import critic_observation
from forgetmimic_jax.tracking.reference import lookup


@pytest.fixture(scope="module")
def scene(robot):
    """A robot in one random pose and a reference in another, both by MuJoCo."""
    return posed(robot, seed=1), posed(robot, seed=2)


def in_pelvis_frame(robot, data, vector) -> np.ndarray:
    return data.xmat[robot.model.body("pelvis").id].reshape(3, 3).T @ vector


def critic_of(robot, reference: Frames, bodies: BodyState, **changes) -> np.ndarray:
    arguments = dict(wrench=jnp.zeros((1, 6)), wrench_gain=jnp.zeros(1), phase=jnp.zeros(1), terms=jnp.ones((1, 10)))
    clean = jnp.zeros((1, 132))
    physics = physics_state(posed(robot, seed=3))  # of which the critic sees what the actor does
    moment = Moment(robot.arrays, reference, physics, bodies, jnp.zeros((1, 29)), robot.anchor, robot.root)
    return np.asarray(critic_observation(clean, moment, **arguments | changes))[0]


# After the actor's 132: 3 + 6 anchor error, 14 bodies × (3 + 6 + 3 + 3) of reference and robot, 3 base velocity,
# 6 wrench, gain, phase, 10 terms, 14 × 3 contact forces.
ANCHOR, REFERENCE, ROBOT, BASE = slice(132, 141), slice(141, 351), slice(351, 561), slice(561, 564)
WRENCH, GAIN, PHASE, TERMS, CONTACT = slice(564, 570), 570, 571, slice(572, 582), slice(582, 624)


def test_the_critic_sees_624_numbers_on_the_g1(robot, library):
    reference = lookup(library, jnp.array([0]), jnp.array([5]))
    assert critic_of(robot, reference, on_reference(reference)).size == CONTACT.stop


def test_the_critic_sees_no_error_when_the_robot_is_the_reference(robot, library):
    reference = lookup(library, jnp.array([0]), jnp.array([5]))
    critic = critic_of(robot, reference, on_reference(reference))
    np.testing.assert_allclose(critic[ANCHOR], [0, 0, 0, 1, 0, 0, 0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(critic[REFERENCE], critic[ROBOT], atol=1e-6)


def test_the_critics_body_features_are_mujocos_in_each_ones_own_torso_frame(robot, scene):
    here, there = scene
    critic = critic_of(robot, as_reference(robot, there), key_bodies(robot, here))
    torso = robot.model.body("torso_link").id
    for part, data in ((REFERENCE, there), (ROBOT, here)):
        frame = data.xmat[torso].reshape(3, 3).T
        ids = robot.key_body_ids
        pos = [frame @ (data.xpos[body] - data.xpos[torso]) for body in ids]
        columns = [(frame @ data.xmat[body].reshape(3, 3))[:, :2].T for body in ids]
        velocity = [body_velocity(robot, data, body) for body in ids]
        linear, angular = ([frame @ vector for vector in column] for column in zip(*velocity, strict=True))
        expected = np.concatenate([np.ravel(values) for values in (pos, columns, linear, angular)])
        np.testing.assert_allclose(critic[part], expected, atol=1e-4)


def test_the_critics_anchor_error_is_in_the_robots_torso_frame(robot, scene):
    here, there = scene
    critic = critic_of(robot, as_reference(robot, there), key_bodies(robot, here))
    torso = robot.model.body("torso_link").id
    frame = here.xmat[torso].reshape(3, 3).T
    relative = frame @ there.xmat[torso].reshape(3, 3)
    expected = [*(frame @ (there.xpos[torso] - here.xpos[torso])), *relative[:, 0], *relative[:, 1]]
    np.testing.assert_allclose(critic[ANCHOR], expected, atol=1e-5)


def test_the_critics_base_velocity_is_in_the_pelvis_frame(robot, scene):
    here, there = scene
    critic = critic_of(robot, as_reference(robot, there), key_bodies(robot, here))
    linear, _ = body_velocity(robot, here, robot.model.body("pelvis").id)
    np.testing.assert_allclose(critic[BASE], in_pelvis_frame(robot, here, linear), atol=1e-5)


def test_the_critics_other_features_stand_where_they_belong(robot, library):
    reference = lookup(library, jnp.array([0]), jnp.array([5]))
    force = jnp.zeros((1, 14, 3)).at[0, 3].set(jnp.array([np.e - 1.0, -(np.e**2 - 1.0), 0.0]))
    bodies = dataclasses.replace(on_reference(reference), contact_force=force)
    wrench, terms = jnp.arange(6.0)[None], jnp.linspace(0.1, 1.0, 10)[None]
    critic = critic_of(
        robot, reference, bodies, wrench=wrench, wrench_gain=jnp.array([0.3]), phase=jnp.array([0.7]), terms=terms
    )
    np.testing.assert_allclose(critic[WRENCH], np.arange(6.0))
    np.testing.assert_allclose(critic[[GAIN, PHASE]], [0.3, 0.7], rtol=1e-6)
    np.testing.assert_allclose(critic[TERMS], np.linspace(0.1, 1.0, 10), rtol=1e-5)
    contact = critic[CONTACT].reshape(14, 3)
    np.testing.assert_allclose(contact[3], [1.0, -2.0, 0.0], rtol=1e-5)
    assert not np.delete(contact, 3, axis=0).any()
