"""MJX against the native engine, which test_native.py holds to plain MuJoCo."""

import contextlib
import faulthandler
import itertools
import re
import sys

import jax
import jax.numpy as jnp
import mujoco
import mujoco.mjx.warp
import numpy as np
import pytest
from physics_cases import CASES, FLIGHT, SUBSTEPS
from trees import assert_same

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.physics.mjx import PAPER_ROOM, MjxEngine, _say_full
from forgetmimic_jax.robot.model import load_robot
from forgetmimic_jax.settings.config import PhysicsConfig
from forgetmimic_jax.tracking.layouts import LAYOUTS, Moment
from forgetmimic_jax.tracking.observation import actor_observation
from forgetmimic_jax.tracking.stand import stand_frame

HANG = 600  # s: far above any compilation here
# Half the compilation, the same program.
QUICK_COMPILATION = {"xla_backend_optimization_level": 0}

# Single against double precision over one control step: about ten times the differences found (CPU, jax 0.10.2,
# MuJoCo 4.0.0, mujoco-mjx 3.17), all of them float32's rounding. qpos m and rad, velocities m/s and rad/s,
# accelerations of up to 970 rad/s^2, forces of up to 163 N.
TOLERANCE = {"qpos": 5e-6, "qvel": 3e-4, "warmstart": 0.05, "contact_force": 0.03}
TOLERANCE |= {"pos": 2e-6, "quat": 2e-6, "lin_vel": 1e-4, "ang_vel": 3e-4}


@contextlib.contextmanager
def no_hang():
    """A hang of XLA's CPU thread pool ends the test run, where nothing else would."""
    faulthandler.dump_traceback_later(HANG, exit=True, file=sys.__stderr__)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def has_gpu() -> bool:
    return jax.default_backend() == "gpu"


@pytest.fixture(scope="module")
def engine(robot):
    return MjxEngine(robot, SUBSTEPS)


@pytest.fixture(scope="module")
def step(engine, inputs):
    """The compiled control step, shared by all tests."""
    with no_hang():
        function = jax.jit(engine.step, compiler_options=None if has_gpu() else QUICK_COMPILATION)
        return function.lower(*inputs).compile()


@pytest.fixture(scope="module")
def result(step, inputs):
    with no_hang():
        return jax.block_until_ready(step(*inputs))


def assert_close(name, actual, expected):
    np.testing.assert_allclose(actual, expected, rtol=0, atol=TOLERANCE[name], err_msg=name)


@pytest.mark.parametrize("row", CASES.values(), ids=CASES)
def test_step_equals_the_native_engines(result, native_result, row):
    for part, expected in zip(result, native_result, strict=True):
        for name, values in vars(part).items():
            assert_close(name, values[row], getattr(expected, name)[row])


def test_forward_equals_the_native_engines_and_keeps_other_rows(engine, native, inputs, native_result):
    mask = jnp.asarray([True, False, True, False, True])
    old = jax.tree.map(lambda x: x + 1.0, native_result[1])
    forward = jax.jit(engine.forward, compiler_options=None if has_gpu() else QUICK_COMPILATION)
    with no_hang():
        actual = jax.block_until_ready(forward(inputs.state, inputs.parameters, mask, old))
    expected = native.forward(inputs.state, inputs.parameters, mask, old)
    for name, values in vars(actual).items():
        assert_close(name, values, getattr(expected, name))
    assert not np.any(actual.contact_force[mask])
    assert_same(*(jax.tree.map(lambda x: x[~mask], bodies) for bodies in (actual, old)))


def test_the_state_keeps_its_types(inputs, result):
    """A weak type or another dtype would compile the training iteration twice."""
    state = result[0]
    for before, after in zip(jax.tree.leaves(inputs.state), jax.tree.leaves(state), strict=True):
        assert after.dtype == before.dtype == jnp.float32
        assert after.shape == before.shape
        assert not after.weak_type


def test_a_diverged_row_is_not_finite_and_alone(step, inputs, result):
    state = inputs.state.replace(qvel=inputs.state.qvel.at[FLIGHT, 9].set(jnp.nan))
    with no_hang():
        diverged = jax.block_until_ready(step(state, *inputs[1:]))
    sound = np.delete(np.arange(len(CASES)), FLIGHT)
    assert_same(*(jax.tree.map(lambda x: x[sound], r) for r in (diverged, result)))
    assert np.isnan(diverged[0].qpos[FLIGHT]).any()


@pytest.mark.skipif(has_gpu(), reason="a GPU does not call LAPACK")
def test_no_two_calls_of_lapack_can_run_at_once(step):
    """On two cores the two would wait for each other forever: see `physics.mjx._step`."""
    graphs = lapack_graphs(step.as_text())
    assert max(map(len, graphs)) == 10  # three factorisations, two triangular solutions of each, the solver's loop
    for calls in graphs:
        for first, second in itertools.combinations(calls, 2):
            assert first in calls[second] or second in calls[first], f"nothing orders {first} and {second}"


def lapack_graphs(hlo: str) -> list[dict[str, set[str]]]:
    """Of each computation of a compiled program, the instructions that call LAPACK, or a computation that does.

    Each comes with the names of all instructions that it waits for.
    """
    header, instruction = (
        re.compile(r"^(?:ENTRY )?%?([\w.-]+) \(.*\{$"),
        re.compile(r"^\s+(?:ROOT )?%?([\w.-]+) = (.*)$"),
    )
    graphs: dict[str, dict[str, set[str]]] = {}
    for line in hlo.splitlines():
        if found := header.match(line):
            waits_for: dict[str, set[str]] = {}
            calls = graphs[found[1]] = {}
        elif found := instruction.match(line):
            name, rest = found[1], found[2].partition(", metadata=")[0]
            words = re.findall(r"[\w.-]+", rest)
            operands = waits_for.keys() & set(words)
            waits_for[name] = operands.union(*(waits_for[operand] for operand in operands))
            if "lapack_" in rest or any(graphs.get(word) for word in words):  # a computation stands before its callers
                calls[name] = waits_for[name]
    return list(graphs.values())


def test_many_steps_on_a_cpu_end(step, inputs, result):
    state = inputs.state
    with no_hang():
        for _ in range(20):
            state, _ = step(state, *inputs[1:])
        assert np.isfinite(jax.block_until_ready(state).qpos).all()
        assert_same(step(*inputs), result)


def test_only_pairs_of_floor_and_robot_make_contacts(robot, engine):
    model = robot.model
    touches = (model.geom_conaffinity != 0) & (np.arange(model.ngeom) != model.geom("floor").id)
    spheres = int((touches & (model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE)).sum())
    capsules = int((touches & (model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE)).sum())
    assert spheres + capsules == touches.sum()
    assert engine.num_contacts == spheres + 2 * capsules  # a capsule lies on a plane with both ends
    assert (
        MjxEngine(load_robot(robot.name, PhysicsConfig(self_collision=True)), SUBSTEPS).num_contacts
        > engine.num_contacts
    )


def test_warp_has_room_for_every_contact_and_joint_limit(robot, engine):
    rows_of_a_contact = 4  # a pyramid of two tangents
    assert engine.num_contacts <= PAPER_ROOM.contacts
    assert rows_of_a_contact * engine.num_contacts + robot.num_joints <= PAPER_ROOM.constraints
    assert (PhysicsConfig().warp_contacts, PhysicsConfig().warp_constraints) == PAPER_ROOM


CAPSULE = """
<mujoco><worldbody><geom type="plane" size="1 1 1"/>
<body><freejoint/><geom type="capsule" size="0.05 0.2"/></body></worldbody></mujoco>
"""


def test_only_the_friction_of_a_capsule_within_30_degrees_of_upright_is_turned_by_another_rule():
    """docs/architecture.md says so; a robot that crawls has such capsules. It stands on the floor, 1 mm deep."""
    model = mujoco.MjModel.from_xml_string(CAPSULE)
    data, tilts = mujoco.MjData(model), np.radians([0, 20, 29, 31, 60])
    poses, native = np.zeros((len(tilts), 7)), []
    for pose, tilt in zip(poses, tilts, strict=True):
        pose[2:] = 0.049 + 0.2 * np.cos(tilt), np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        native.append(data.contact.frame[0].reshape(3, 3))
    on_mjx, start = mujoco.mjx.put_model(model), mujoco.mjx.put_data(model, data)

    @jax.jit
    @jax.vmap
    def contacts(qpos):
        return mujoco.mjx.collision(on_mjx, mujoco.mjx.kinematics(on_mjx, start.replace(qpos=qpos)))._impl.contact

    found = contacts(jnp.asarray(poses))
    lower = np.argmin(found.dist, axis=1)
    frames = np.asarray(found.frame)[np.arange(len(tilts)), lower]
    np.testing.assert_allclose(frames[:, 0], np.array(native)[:, 0], atol=1e-6)  # the normal
    turned = np.abs(frames[:, 1:] - np.array(native)[:, 1:]).max(axis=(1, 2)) > 0.1
    assert turned.tolist() == [True, True, True, False, False]


def test_warp_that_is_not_installed_is_refused_in_one_line(robot, monkeypatch):
    monkeypatch.setattr(mujoco.mjx.warp, "WARP_INSTALLED", False)
    with pytest.raises(InputError, match=r"mjx-warp.*pip install 'mujoco-mjx\[warp\]'") as error:
        MjxEngine(robot, SUBSTEPS, implementation="warp")
    assert "\n" not in str(error.value)


needs_warp = pytest.mark.skipif(not mujoco.mjx.warp.WARP_INSTALLED, reason="needs warp-lang: no wheel for this machine")


@pytest.fixture(scope="module")
def warp_result(robot, inputs):
    return jax.block_until_ready(jax.jit(MjxEngine(robot, SUBSTEPS, implementation="warp").step)(*inputs))


@needs_warp
def test_warp_step_equals_the_native_engines(warp_result, native_result, capfd):
    for part, expected in zip(warp_result, native_result, strict=True):
        for name, values in vars(part).items():
            assert_close(name, values, getattr(expected, name))
    assert capfd.readouterr() == ("", "")


@needs_warp
@pytest.mark.parametrize(("what", "least"), [("constraints", 20), ("contacts", 1)])
def test_warp_says_once_which_room_is_too_small(robot, inputs, warp_result, native_result, capfd, what, least):
    """`warp_result` has started Warp, which says on a machine without CUDA that it has none."""
    engine = MjxEngine(robot, SUBSTEPS, implementation="warp", room=PAPER_ROOM._replace(**{what: least}))
    _say_full.cache_clear()
    step = jax.jit(engine.step)
    for _ in range(2):
        state, _ = jax.block_until_ready(step(*inputs))
    assert np.abs(state.qvel - native_result[0].qvel).max() > 1.0
    jax.effects_barrier()
    said = " ".join(capfd.readouterr().err.split())
    assert said == (
        f"warning: physics.warp_{what}: {least} is too few, so contacts were left out of the simulation and the robot "
        f"moved wrongly; give more with --set physics.warp_{what}={2 * least}"
    )


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("outcome", ["result", pytest.param("warp_result", marks=needs_warp)])
def test_a_policy_of_any_layout_sees_the_same_with_every_engine(robot, request, native_result, outcome, name):
    """Each robot after its step, whose reference is a robot that stands at rest."""
    still = jax.tree.map(lambda values: jnp.broadcast_to(values, (len(CASES), *values.shape)), stand_frame(robot))
    nothing = jnp.zeros((len(CASES), robot.num_joints))

    def seen(physics, bodies):
        moment = Moment(robot.arrays, still, physics, bodies, nothing, robot.anchor, robot.root)
        return actor_observation(LAYOUTS[name], robot.policy_joints, moment)

    found, expected = (np.asarray(seen(*step)) for step in (request.getfixturevalue(outcome), native_result))
    assert found.shape == (len(CASES), LAYOUTS[name].size(robot.num_joints))
    np.testing.assert_allclose(found, expected, rtol=0, atol=TOLERANCE["ang_vel"])
