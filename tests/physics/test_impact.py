"""Falls, head and hand contacts and saturated motors, against plain MuJoCo and by hand."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from physics_cases import GRAVITY, SUBSTEPS, TIMESTEP, make_state, pose, rest_qpos, single

from forgetmimic_jax.physics import PhysicsParameters
from forgetmimic_jax.physics.impact import ImpactEngine
from forgetmimic_jax.physics.native import NativeEngine
from forgetmimic_jax.robot.model import load_robot, touching_bodies, with_every_contact

ON_BACK, HEAD_FIRST, ON_HANDS, UPRIGHT = range(4)
STEPS = 30
FOOT = {"g1": "ankle_roll_link", "h2": "ankle_pitch_link"}
DROP = 0.5  # m, of the pelvis above where it first touches on its back


@pytest.fixture(scope="module")
def starts(robot) -> np.ndarray:
    """Four robots in the air or on their feet, as rows of qpos."""
    qpos = np.tile(rest_qpos(robot), (4, 1))
    quarter = np.sqrt(0.5)
    qpos[ON_BACK, 2:7] = [0.09 + DROP, quarter, 0.0, -quarter, 0.0]  # the torso's capsule is 9 cm thick
    qpos[HEAD_FIRST, 2:7] = [0.7, 0.0, 1.0, 0.0, 0.0]
    qpos[ON_HANDS, 2:7] = [0.5, quarter, 0.0, quarter, 0.0]
    qpos[ON_HANDS, 7:] = pose(robot, shoulder_pitch=-1.57, elbow=1.57)
    return qpos


@pytest.fixture(scope="module")
def seen(robot, starts) -> dict[str, np.ndarray]:
    """Fields of `Impact`, [step, row], while the joints are held."""
    engine = ImpactEngine(robot, SUBSTEPS, len(starts))
    step = jax.jit(engine.step)
    state = make_state(starts, np.zeros((len(starts), robot.model.nv)))
    parameters = PhysicsParameters(jnp.full((len(starts),), 0.6), jnp.zeros((len(starts), 3)))
    steps = []
    for _ in range(STEPS):
        state, bodies = step(state, parameters, single(starts[:, 7:]), jnp.zeros((len(starts), 6)))
        steps.append(bodies)
    names = ("impact_force", "impact_speed", "head_contact", "hand_contact", "torque_saturation")
    return {name: np.stack([getattr(bodies, name) for bodies in steps]) for name in names}


def floor_forces(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """The floor's force [body, 3] N on every body, from the contacts one by one."""
    total, force, floor = np.zeros((model.nbody, 3)), np.zeros(6), model.geom("floor").id
    for index, contact in enumerate(data.contact):
        if floor in contact.geom:
            mujoco.mj_contactForce(model, data, index, force)
            other = contact.geom[0] if contact.geom[1] == floor else contact.geom[1]
            total[model.geom_bodyid[other]] += contact.frame.reshape(3, 3).T @ force[:3]
    return total


@pytest.mark.parametrize("row", [ON_BACK, HEAD_FIRST, ON_HANDS])
def test_an_impact_is_the_largest_force_on_a_body_that_is_no_foot(robot, starts, seen, row):
    """Plain MuJoCo, a physics step at a time, with the robot's shapes touching each other."""
    spec = robot.spec.copy()
    for geom in spec.geoms:
        if geom.name != "floor":
            geom.contype = 1
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:] = starts[row], starts[row, 7:]
    feet = [model.body(f"{side}_{FOOT[robot.name]}").id for side in ("left", "right")]
    largest = np.zeros(STEPS)
    for step in range(SUBSTEPS * STEPS):
        mujoco.mj_step(model, data)
        force = np.linalg.norm(floor_forces(model, data), axis=-1)
        force[feet] = 0.0
        largest[step // SUBSTEPS] = max(largest[step // SUBSTEPS], force.max())
    first = int(np.flatnonzero(largest)[0])
    assert largest[first] > robot.weight
    # Both compute in float64, but the state is float32 between control steps, which contacts enlarge.
    np.testing.assert_allclose(seen["impact_force"][: first + 2, row], largest[: first + 2], rtol=2e-2)
    assert seen["impact_force"][:, row].max() == pytest.approx(largest.max(), rel=5e-2)


def test_the_speed_before_the_impact_is_that_of_a_free_fall(seen):
    """From a drop of 0.5 m: √(2 g h), but for a physics step's fall and what the limbs touch before the torso."""
    landed = np.flatnonzero(seen["impact_speed"][:, ON_BACK])[0]
    assert seen["impact_speed"][landed, ON_BACK] == pytest.approx(np.sqrt(2.0 * GRAVITY * DROP), rel=0.05)
    falls = SUBSTEPS * landed + np.arange(SUBSTEPS)
    assert np.isclose(falls * TIMESTEP * GRAVITY, seen["impact_speed"][landed, ON_BACK], rtol=1e-3).any()


def test_the_momentum_of_the_fall_is_taken_by_the_impact(robot, seen):
    """It stops the torso within 40 ms, so the force is above m v / t at times, and below the whole robot's M v / dt."""
    torso = robot.model.body_mass[robot.anchor_body_id]
    speed = np.sqrt(2.0 * GRAVITY * DROP)
    assert seen["impact_force"][:, ON_BACK].max() > torso * speed / (2 * SUBSTEPS * TIMESTEP)
    assert seen["impact_force"][:, ON_BACK].max() < robot.arrays.mass * speed / TIMESTEP


def test_head_and_hands_touch_the_floor_where_they_do(seen):
    head, hand = (seen[name].max(0) for name in ("head_contact", "hand_contact"))
    assert (head[HEAD_FIRST], head[ON_HANDS], head[UPRIGHT]) == (1.0, 0.0, 0.0)
    assert (hand[ON_HANDS], hand[UPRIGHT]) == (1.0, 0.0)


def test_a_robot_on_its_feet_meets_nothing(seen):
    for values in seen.values():
        assert not values[:, UPRIGHT].any()


def test_a_motor_is_saturated_beyond_95_percent_of_its_torque(robot):
    """At the joint's own angle and at rest, the torque of the first physics step is the gain times the target's way."""
    qpos = np.tile(rest_qpos(robot), (2, 1))
    qpos[:, 2] = 2.0
    way = np.asarray(robot.arrays.effort / robot.arrays.stiffness)
    shares = np.ones(robot.num_joints)
    shares[:7], shares[7:9] = 0.94, -0.96
    engine = ImpactEngine(robot, 1, 2)
    target = qpos[:, 7:] + np.stack([shares * way, 0.5 * way])
    parameters = PhysicsParameters(jnp.full((2,), 0.6), jnp.zeros((2, 3)))
    _, bodies = jax.jit(engine.step)(
        make_state(qpos, np.zeros((2, robot.model.nv))), parameters, single(target), jnp.zeros((2, 6))
    )
    np.testing.assert_allclose(bodies.torque_saturation, [1 - 7 / robot.num_joints, 0.0], atol=1e-6)


def test_without_a_contact_it_is_the_training_s_engine(robot):
    qpos = np.tile(rest_qpos(robot), (2, 1))
    qpos[1, 2] = 1.5
    arguments = (
        make_state(qpos, np.full((2, robot.model.nv), 0.1)),
        PhysicsParameters(jnp.full((2,), 0.6), jnp.zeros((2, 3))),
        single(qpos[:, 7:] + 0.1),
        jnp.zeros((2, 6)),
    )
    engines = [make(robot, SUBSTEPS, 2) for make in (NativeEngine, ImpactEngine)]
    states = [jax.jit(engine.step)(*arguments)[0] for engine in engines]
    for one, other in zip(*map(jax.tree.leaves, states), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", ["g1", "h2"])
def test_every_shape_of_the_robot_has_a_sensor_and_touches_the_others(name):
    robot = load_robot(name)
    assert not robot.model.geom_contype[1:].any()
    model = with_every_contact(robot).model
    assert (model.geom_contype[1:] == 1).all()
    sensors = {model.sensor(sensor).name for sensor in range(model.nsensor)}
    assert {f"contact_{body}" for body in touching_bodies(robot)} <= sensors
    assert {model.geom_bodyid[geom] for geom in range(1, model.ngeom)} == {
        model.body(body).id for body in touching_bodies(robot)
    }
    assert "head_contact_head" in sensors
    assert robot.model.nsensor == len(robot.key_bodies)  # the training's robot stays as it was


def test_arms_do_not_pass_through_the_body(robot):
    """In training a forearm inside the torso has no contact with it."""
    inwards = {"left_shoulder_roll": -0.3, "left_shoulder_yaw": -1.5, "left_elbow": 0.0, "left_shoulder_pitch": 0.0}
    qpos = rest_qpos(robot)
    qpos[2], qpos[7:] = 1.5, pose(robot, **inwards)
    contacts = []
    for model in (robot.model, with_every_contact(robot).model):
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        contacts.append(data.ncon)
    assert contacts[0] == 0
    assert contacts[1] > 0
