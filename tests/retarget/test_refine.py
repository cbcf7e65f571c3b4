"""The refinement of a retargeted clip: derivatives, the solver and the floor's forces against independent answers."""

import json

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from forgetmimic_jax.motion.contact import floor_points, floor_positions
from forgetmimic_jax.motion.dynamics import FRICTION, RADIUS, floor_answer
from forgetmimic_jax.motion.kinematics import generalized_velocity, heading
from forgetmimic_jax.motion.motors import InverseDynamics, motor_loads
from forgetmimic_jax.retarget.contact import human_contact
from forgetmimic_jax.retarget.cycle import resampled
from forgetmimic_jax.retarget.deepmimic import LEG_LENGTH, forward_kinematics, read_deepmimic
from forgetmimic_jax.retarget.dynamics import floor_wrench, motor_torque
from forgetmimic_jax.retarget.least_squares import Residuals, gauss_newton_step
from forgetmimic_jax.retarget.planar import PlanarTransform
from forgetmimic_jax.retarget.pose import pose_of
from forgetmimic_jax.retarget.refine import Problem, Weights, refine
from forgetmimic_jax.retarget.retarget import inverse_kinematics, leg_scale, make_goals
from forgetmimic_jax.retarget.timeline import Timeline

FPS = 50.0


def human(tmp_path, frames, *, loop="none", yaw=0.0, height=LEG_LENGTH, pitch=0.0, wave=0.1, travel=0.0):
    """A human at 50 frames per s who turns by `yaw` rad and moves by `travel` m in all, limbs waving by `wave` rad."""
    rows = []
    for row in range(frames):
        angle = wave * np.sin(2.0 * np.pi * row / (frames - 1))
        turn = Rotation.from_rotvec([0.0, yaw * row / (frames - 1), 0.0]) * Rotation.from_rotvec([0.0, 0.0, pitch])
        limb = Rotation.from_rotvec([0.3 * angle, angle, angle]).as_quat(scalar_first=True).tolist()
        unit = [1.0, 0.0, 0.0, 0.0]
        leg, arm = [*limb, -abs(angle), *unit], [*limb, abs(angle)]
        root = [1 / FPS, travel * row / (frames - 1), height, 0.0, *turn.as_quat(scalar_first=True)]
        rows.append([*root, *limb, *unit, *leg, *arm, *leg, *arm])
    path = tmp_path / "humanoid3d_made.txt"
    path.write_text(json.dumps({"Loop": loop, "Frames": rows}))
    return read_deepmimic(path)


def problem_of(robot, motion):
    moved, step = resampled(motion, FPS, 1.0)
    pose = forward_kinematics(moved)
    goals = make_goals(robot, pose)
    if step is not None:
        step = PlanarTransform(step.yaw, step.shift * leg_scale(robot))
    timeline = Timeline(goals.num_frames, step, FPS)
    problem = Problem.of(robot, goals, human_contact(pose, FPS), timeline, Weights())
    return problem, inverse_kinematics(robot, goals)


@pytest.mark.parametrize("loop", ["none", "wrap"])
def test_jacobians_are_the_residuals_slopes(robot, tmp_path, loop):
    """Along a random direction, by central differences; on a circle whose cycle turns by 60 degrees, too."""
    problem, qpos = problem_of(robot, human(tmp_path, 9, loop=loop, yaw=np.radians(60.0), travel=0.2))
    rng = np.random.default_rng(0)
    qpos = problem.moved(qpos, 0.002 * rng.normal(size=(len(qpos), robot.model.nv)))
    direction = rng.normal(size=(len(qpos), robot.model.nv))
    size = 1e-6
    here = problem.terms(qpos)
    plus, minus = (problem.terms(problem.moved(qpos, sign * size * direction)) for sign in (1.0, -1.0))
    checked = 0
    for term, after, before in zip(here, plus, minus, strict=True):
        slope = (after.residual - before.residual) / (2.0 * size)
        steps = [direction[(term.frame + offset) % len(qpos)] for offset in term.jacobians]
        found = sum(
            np.einsum("tmi,ti->tm", jacobian, step)
            for jacobian, step in zip(term.jacobians.values(), steps, strict=True)
        )
        if not np.any(slope):
            continue
        # Orientation errors of some 0.1 rad and the momentum matrix are linearised, and the weight of what the floor
        # and the motors lack is held; the rest is exact.
        exact = np.linalg.norm(found - slope) / np.linalg.norm(slope)
        assert exact < (0.5 if set(term.jacobians) == {0, 1, 2} else 0.1)
        checked += exact < 1e-4
    assert checked >= 15


@pytest.mark.parametrize("cyclic", [False, True])
@pytest.mark.parametrize("frames", [7, 8, 12])
def test_banded_step_is_the_dense_least_squares_solution(cyclic, frames):
    rng = np.random.default_rng(frames)
    nv, damping = 3, 0.1
    terms, rows, residuals = [], [], []
    for reach in (0, 1, 3):
        first = np.arange(frames if cyclic else frames - reach)
        jacobians = {offset: rng.normal(size=(len(first), 2, nv)) for offset in range(reach + 1)}
        term = Residuals(first, rng.normal(size=(len(first), 2)), jacobians)
        terms.append(term)
        for row, frame in enumerate(first):
            for line in range(2):
                dense = np.zeros((frames, nv))
                for offset, jacobian in jacobians.items():
                    dense[(frame + offset) % frames] += jacobian[row, line]
                rows.append(dense.reshape(-1))
                residuals.append(term.residual[row, line])
    stacked = np.concatenate([rows, np.sqrt(damping) * np.eye(frames * nv)])
    expected = np.linalg.lstsq(stacked, -np.concatenate([residuals, np.zeros(frames * nv)]), rcond=None)[0]
    step = gauss_newton_step(terms, frames, nv, cyclic, damping)
    np.testing.assert_allclose(step.reshape(-1), expected, atol=1e-9)


def test_the_floor_carries_what_stands_over_its_points():
    """Four corners 0.1 m around, the centre of mass 0.6 m up: the pyramid and the lever settle each case by hand."""
    corners = np.array([[0.1, 0.1], [0.1, -0.1], [-0.1, 0.1], [-0.1, -0.1]])

    def missing(force, offset=0.0, touching=True):
        levers = np.concatenate([corners - [offset, 0.0], np.full((4, 1), -0.6)], axis=1)[None]
        needed = np.array([[*force, 0.0, 0.0, 0.0]])
        given, project = floor_answer(needed, levers, np.full((1, 4), touching))
        assert np.abs(project[0] @ given[0]).max() < 1e-9
        return needed[0] - given[0]

    np.testing.assert_allclose(missing([0, 0, 9.81]), 0.0, atol=1e-9)
    np.testing.assert_allclose(missing([0, 0, 9.81], offset=0.09), 0.0, atol=1e-9)
    assert np.linalg.norm(missing([0, 0, 9.81], offset=0.15)) > 0.5
    np.testing.assert_allclose(missing([0, 0, 9.81], touching=False), [0, 0, 9.81, 0, 0, 0])
    # A push of a_x needs the pressure a_x z / g behind the centre of mass: 0.098 m at 1.6, past the edge at 2.
    np.testing.assert_allclose(missing([1.6, 0, 9.81]), 0.0, atol=1e-9)
    assert np.linalg.norm(missing([2.0, 0, 9.81])) > 0.02
    # Beyond friction, whatever the lever.
    low = np.concatenate([corners, np.full((4, 1), -1e-6)], axis=1)[None]
    for share, possible in ((0.9, True), (1.5, False)):
        needed = np.array([[share * FRICTION * 9.81, 0.0, 9.81, 0.0, 0.0, 0.0]])
        left = np.linalg.norm(needed - floor_answer(needed, low, np.ones((1, 4), bool))[0])
        assert (left < 1e-3) == possible


def wrench_of(robot, qpos, *, flight):
    pose = pose_of(robot, floor_points(robot), qpos)
    return floor_wrench(robot, Timeline(len(qpos), None, FPS), pose, np.full(len(qpos), flight), 1e-3)


def standing(robot, frames):
    """qpos [frame, nq] of the default pose with its soles on the floor."""
    qpos = np.zeros((frames, robot.model.nq))
    qpos[:, 3] = 1.0
    qpos[:, 7:] = np.asarray(robot.arrays.default_joint_pos)
    points = floor_points(robot)
    qpos[:, 2] -= floor_positions(robot, points, qpos)[:, points.is_sole, 2].min()
    return qpos


def tumbling(robot, rng, frames, *, wave, speed):
    """qpos [frame, nq] in the air, turning, every joint waving by `wave` rad at `speed` rad/s."""
    time = np.arange(frames)[:, None] / FPS
    joints = wave * np.sin(speed * time + rng.normal(size=(1, robot.num_joints)))
    turns = Rotation.from_rotvec(time * [0.3, 1.0, 0.5]).as_quat(scalar_first=True)
    return np.concatenate([np.tile([0.0, 0.0, 2.0], (frames, 1)), turns, joints], axis=1)


def loads_of(robot, qpos):
    points = floor_points(robot)
    return motor_loads(robot, points, floor_positions(robot, points, qpos), qpos, FPS)


def test_free_fall_and_standing_need_nothing(robot):
    time = np.arange(10) / FPS
    qpos = standing(robot, 10)
    np.testing.assert_allclose(wrench_of(robot, qpos, flight=False).residual, 0.0, atol=1e-9)
    assert np.abs(wrench_of(robot, qpos, flight=True).residual).max() > 1e-3  # nothing holds it up
    qpos[:, 0] += 1.5 * time
    qpos[:, 2] += 0.5 + 2.0 * time - 0.5 * 9.81 * time**2
    falling = wrench_of(robot, qpos, flight=True)
    np.testing.assert_allclose(falling.residual, 0.0, atol=1e-9)


def test_the_momentum_is_mujocos(robot):
    """The wrench's moment is the change of mj_subtreeVel's angular momentum."""
    qpos = tumbling(robot, np.random.default_rng(1), 40, wave=0.3, speed=3.0)
    term = wrench_of(robot, qpos, flight=True)
    qvel = generalized_velocity(qpos, FPS)
    data, momentum = mujoco.MjData(robot.model), []
    for row in range(40):
        data.qpos[:], data.qvel[:] = qpos[row], qvel[row]
        mujoco.mj_forward(robot.model, data)
        mujoco.mj_subtreeVel(robot.model, data)
        momentum.append(data.subtree_angmom[1].copy())
    expected = np.gradient(momentum, 1.0 / FPS, axis=0)[term.frame + 1] / robot.model.body_subtreemass[1] / RADIUS
    residual = term.residual / np.linalg.norm(term.residual, axis=1, keepdims=True)  # the robust weight is a factor
    force = residual[:, 2:3]
    # The vertical force on a body whose centre of mass hardly accelerates is g: it sets the scale.
    com_acc = wrench_scale(robot, qpos)[term.frame]
    np.testing.assert_allclose((residual[:, 3:] / force * com_acc)[2:-2], expected[2:-2], atol=0.02)


def wrench_scale(robot, qpos):
    """Vertical acceleration that holds up each inner frame's centre of mass [row, 1], by differences."""
    data, heights = mujoco.MjData(robot.model), []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(robot.model, data)
        mujoco.mj_comPos(robot.model, data)
        heights.append(data.subtree_com[1][2])
    return (np.diff(heights, n=2) * FPS**2 + 9.81)[:, None]


def test_a_held_arm_weighs_on_the_motors_above_it(robot):
    """By lever and weight: a motor that holds a body up in stance gives -axis . (lever x m g) of all beyond it."""
    qpos = standing(robot, 6)
    qpos[:, 7:] += 0.3 * robot.motor_counts * np.array(["arm" not in name for name in robot.joint_names])
    qpos[:, 7:][:, ["shoulder_pitch" in name for name in robot.joint_names]] -= 1.2
    loads = loads_of(robot, qpos)
    data = mujoco.MjData(robot.model)
    data.qpos[:] = qpos[0]
    mujoco.mj_kinematics(robot.model, data)
    mujoco.mj_comPos(robot.model, data)
    checked = 0
    for column, name in enumerate(robot.joint_names):
        if not any(part in name for part in ("shoulder", "elbow", "waist")):
            continue  # a leg's share is the floor's choice
        joint = robot.model.joint(name)
        body = int(robot.model.jnt_bodyid[joint.id])
        weight = robot.model.body_subtreemass[body] * np.array([0.0, 0.0, -9.81])
        torque = -data.xaxis[joint.id] @ np.cross(data.subtree_com[body] - data.xanchor[joint.id], weight)
        effort = float(robot.arrays.effort[column])
        np.testing.assert_allclose(loads[:, column], torque / effort, atol=1e-4)
        checked += abs(torque) > 0.5
    assert checked >= 5


def test_the_motors_jacobian_is_the_lacks_slope(robot):
    """In the air, turning and waving, by central differences; little is lacking, so the robust weight hardly moves."""
    rng = np.random.default_rng(4)
    qpos = tumbling(robot, rng, 8, wave=0.4, speed=12.0)
    problem = Problem.of(robot, None, None, Timeline(8, None, FPS), Weights())
    share = 0.9 * np.abs(loads_of(robot, qpos)).max()

    def term(moved):
        pose = pose_of(robot, problem.floor, moved)
        return motor_torque(robot, problem.timeline, pose, np.ones(8, bool), share=share, weight=1.0)

    direction = rng.normal(size=(8, robot.model.nv))
    here, size = term(qpos), 1e-7
    plus, minus = (term(problem.moved(qpos, sign * size * direction)).residual for sign in (1.0, -1.0))
    found = sum(np.einsum("tmi,ti->tm", jac, direction[here.frame + ahead]) for ahead, jac in here.jacobians.items())
    slope = (plus - minus) / (2.0 * size)
    assert np.linalg.norm(slope) > 1.0
    assert np.linalg.norm(found - slope) < 0.05 * np.linalg.norm(slope)


def test_falling_freely_needs_no_motor(robot):
    time = np.arange(10) / FPS
    qpos = standing(robot, 10)
    qpos[:, 2] += 1.0 + 2.0 * time - 0.5 * 9.81 * time**2
    np.testing.assert_allclose(loads_of(robot, qpos), 0.0, atol=1e-6)


def test_standing_legs_carry_the_robot(robot):
    """What the floor pushes reaches the root through the legs: both alike, and far from their limits."""
    loads = loads_of(robot, standing(robot, 6))
    knees = loads[:, ["knee" in name for name in robot.joint_names]]
    np.testing.assert_allclose(knees[:, 0], knees[:, 1], atol=1e-3)
    assert 0.02 < np.abs(loads).max() < 0.5


def test_inverse_dynamics_undo_mujocos_own(robot):
    """The acceleration that forward dynamics gives to a force asks for that force again."""
    rng = np.random.default_rng(3)
    inverse, data = InverseDynamics(robot), mujoco.MjData(robot.model)
    data.qpos[:] = standing(robot, 1)[0]
    data.qpos[2] += 2.0
    data.qvel[:] = rng.normal(size=robot.model.nv)
    data.ctrl[:] = 0.0
    mujoco.mj_forward(robot.model, data)
    found = inverse.force(data.qpos, data.qvel, data.qacc)
    np.testing.assert_allclose(found, data.qfrc_actuator + data.qfrc_passive, atol=1e-8)


def test_a_motor_counts_beyond_its_share(robot):
    """The residual is what the load has over the share, and a share that no load reaches leaves nothing."""
    qpos = standing(robot, 6)
    pose, timeline = pose_of(robot, floor_points(robot), qpos), Timeline(6, None, FPS)
    loads = loads_of(robot, qpos)

    def lack(share):
        return motor_torque(robot, timeline, pose, np.zeros(6, bool), share=share, weight=1e-3).residual / 1e-3

    np.testing.assert_allclose(lack(1.0), 0.0)
    share = 0.5 * np.abs(loads).max()
    expected = np.sign(loads) * np.maximum(np.abs(loads) - share, 0.0)
    robust = (1.0 + np.sum(expected**2, axis=-1, keepdims=True)) ** -0.25
    np.testing.assert_allclose(lack(share), robust * expected, atol=1e-6)


def test_contacts_of_a_human_who_stands_floats_and_lies(tmp_path):
    standing = human_contact(forward_kinematics(human(tmp_path, 6, wave=0.0)), FPS)
    assert not standing.flight.any()
    np.testing.assert_allclose(standing.planted["left_heel"], 1.0)
    assert not standing.planted["left_hand"].any()
    floating = human_contact(forward_kinematics(human(tmp_path, 6, wave=0.0, height=LEG_LENGTH + 0.2)), FPS)
    assert floating.flight.all()
    assert not any(weight.any() for weight in floating.planted.values())
    lying = human_contact(forward_kinematics(human(tmp_path, 6, wave=0.0, height=0.12, pitch=np.pi / 2)), FPS)
    assert not lying.flight.any()
    assert (lying.planted["torso"] > 0.1).all()


@pytest.mark.parametrize(("degrees", "carried"), [(10.0, 0.0), (60.0, 60.0)])
def test_a_cycle_closes(tmp_path, degrees, carried):
    """A small turn is a recording's fault and is spread; a large one is carried from cycle to cycle."""
    moved, step = resampled(human(tmp_path, 41, loop="wrap", yaw=np.radians(degrees), travel=0.2), FPS, 1.0)
    assert len(moved.times) == 40
    assert np.degrees(step.yaw) == pytest.approx(carried, abs=1e-6)
    root = moved.rotations["root"]
    turned = np.degrees(np.unwrap(heading(root.as_quat(scalar_first=True))))
    assert turned[-1] - turned[0] == pytest.approx(carried * 39 / 40, abs=0.6)
    seam = (step.turn(root[0]) * root[-1].inv()).magnitude()
    inside = (root[1:] * root[:-1].inv()).magnitude().max()
    assert seam < 1.5 * inside + 1e-3


def test_a_standing_human_makes_a_standing_robot(robot, tmp_path):
    """Both soles on the floor and still, the centre of mass over them, joints inside their limits."""
    problem, start = problem_of(robot, human(tmp_path, 12, wave=0.005))
    qpos = refine(robot, problem.goals, problem.contact, start, problem.timeline, iterations=15)
    soles = floor_positions(robot, problem.floor, qpos)[:, problem.floor.is_sole]
    assert np.abs(soles[..., 2]).max() < 0.005
    assert (qpos[:, 7:] > robot.joint_lower).all()
    assert (qpos[:, 7:] < robot.joint_upper).all()
    com = pose_of(robot, problem.floor, qpos).com
    assert (com[:, :2] > soles[..., :2].min(axis=1)).all()
    assert (com[:, :2] < soles[..., :2].max(axis=1)).all()
