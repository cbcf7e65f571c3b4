"""What the network's output does: by the names of the joints, whatever their order and whatever it is added to."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from orders import isaac_order

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.robot.model import load_robot
from forgetmimic_jax.settings.config import ActionConfig, ObservationConfig
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.action import to_action
from forgetmimic_jax.tracking.env import Environment, make_assets
from forgetmimic_jax.tracking.layouts import LAYOUTS
from forgetmimic_jax.tracking.rsi import Start
from forgetmimic_jax.tracking.setup import Setup, make_setup

KEY = jax.random.PRNGKey(0)
CLIP, FRAME = 1, 7
POSE = {"left_knee_joint": 0.3, "left_hip_pitch_joint": -0.1}
SCALE = {"left_knee_joint": 0.33, "waist_yaw_joint": 0.5}


@pytest.fixture(scope="module", params=["residual", "offset"])
def mode(request):
    return request.param


@pytest.fixture(scope="module", params=["the robot's order", "Isaac Lab's order"])
def step(request, robot, library, tiny_config, mode):
    """A function: a step with an action, of a robot with another pose and scales; the joint targets, and what is seen
    afterwards."""
    order = isaac_order(robot) if request.param == "Isaac Lab's order" else ()
    action = ActionConfig(mode, order, default_pose=POSE, scale=SCALE)
    config = dataclasses.replace(tiny_config, observation=ObservationConfig("mjlab154"), action=action)
    mine = load_robot("g1", action=action)
    assets = make_assets(Setup(config, mine, library, ""))
    sent = {}

    def stay(state, parameters, target, wrench):
        sent["target"] = np.asarray(target)[0]
        return state, sent["bodies"]

    env = Environment(config, mine, SimpleNamespace(step=stay), 1, noisy=False)

    def step(output: dict[str, float], bias: float = 0.0):
        clip, frame, gain = jnp.array([CLIP]), jnp.array([FRAME]), jnp.zeros(1)
        state = tracking.start_episodes(env, assets, KEY, Start(clip, clip, frame), gain)
        state = dataclasses.replace(state, encoder_bias=jnp.full((1, 29), bias))
        sent["bodies"] = state.bodies
        raw = np.array([output.get(name, 0.0) for name in order or robot.joint_names], np.float32)
        after, _ = tracking.step(env, assets, state, jnp.asarray(raw)[None], KEY)
        seen, _ = tracking.observe(env, assets, after, None)
        targets = dict(zip(robot.joint_names, sent["target"], strict=True))
        return targets, raw, np.asarray(seen)[0, LAYOUTS["mjlab154"].places(29)["actions"]]

    return step


@pytest.fixture(scope="module")
def origin(robot, library, mode):
    """Joint targets of the action 0, by name: of the next frame, or of the default pose."""
    if mode == "residual":
        pose = library.clip(CLIP).joint_pos[FRAME + 1]
        return dict(zip(robot.joint_names, pose, strict=True))
    knees_bent = {"hip_pitch": -0.312, "knee": 0.669, "ankle_pitch": -0.363, "shoulder_pitch": 0.2, "elbow": 0.6}
    pose = {f"{side}_{joint}_joint": angle for side in ("left", "right") for joint, angle in knees_bent.items()}
    pose |= {"left_shoulder_roll_joint": 0.2, "right_shoulder_roll_joint": -0.2, **POSE}
    return {name: pose.get(name, 0.0) for name in robot.joint_names}


def test_the_zero_action_asks_for_the_origin(step, origin):
    targets, *_ = step({})
    assert targets == pytest.approx(origin, abs=1e-6)


def test_an_action_moves_the_target_of_its_joint_by_its_scale(step, origin):
    output = {"left_knee_joint": 2.0, "waist_yaw_joint": -1.0, "right_wrist_yaw_joint": 3.0}
    moved = {"left_knee_joint": 0.66, "waist_yaw_joint": -0.5, "right_wrist_yaw_joint": 3.0 * 0.25 * 5.0 / 16.77832}
    targets, *_ = step(output)
    assert targets == pytest.approx({name: angle + moved.get(name, 0.0) for name, angle in origin.items()}, abs=1e-5)


def test_the_bias_of_the_encoders_moves_the_target_the_other_way(step, origin):
    targets, *_ = step({}, bias=0.02)
    assert targets == pytest.approx({name: angle - 0.02 for name, angle in origin.items()}, abs=1e-6)


def test_the_last_action_seen_is_the_networks_raw_output(step, robot):
    output = {name: 0.1 * place - 1.0 for place, name in enumerate(robot.joint_names)}
    _, raw, seen = step(output)
    np.testing.assert_array_equal(seen, raw)


# What a policy expects of its robot.


def test_a_policys_gains_and_armature_are_the_models(robot):
    action = ActionConfig(
        stiffness={"left_knee_joint": 80.0}, damping={"left_knee_joint": 3.0}, armature={"left_knee_joint": 0.03}
    )
    mine, knee = load_robot("g1", action=action), robot.joint_names.index("left_knee_joint")
    model, own = mine.model, robot.model
    assert model.actuator_gainprm[knee, 0] == 80.0
    assert list(model.actuator_biasprm[knee, :3]) == [0.0, -80.0, -3.0]
    assert model.dof_armature[6 + knee] == 0.03
    assert (float(mine.arrays.stiffness[knee]), float(mine.arrays.damping[knee])) == (80.0, 3.0)
    assert mine.arrays.action_scale[knee] == robot.arrays.action_scale[knee]  # which was not given
    for name, columns in (("actuator_gainprm", 0), ("actuator_biasprm", slice(3)), ("actuator_forcerange", slice(2))):
        others = [np.delete(getattr(of, name)[:, columns], knee, axis=0) for of in (model, own)]
        np.testing.assert_array_equal(*others)
    np.testing.assert_array_equal(np.delete(model.dof_armature, 6 + knee), np.delete(own.dof_armature, 6 + knee))


def test_a_setup_has_the_robot_that_its_policy_expects(tiny_config, library_folder, robot):
    action = ActionConfig(joint_order=isaac_order(robot), default_pose=POSE)
    setup = make_setup(dataclasses.replace(tiny_config, library=str(library_folder), action=action))
    assert setup.robot.policy_joint_names == isaac_order(robot)
    assert setup.robot.joint_names == robot.joint_names
    knee = robot.joint_names.index("left_knee_joint")
    assert float(setup.robot.arrays.default_joint_pos[knee]) == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (ActionConfig(stiffness={"left_kne_joint": 1.0}), "action.stiffness: no joint 'left_kne_joint' in g1; did you "
         "mean 'left_knee_joint'?"),
        (ActionConfig(default_pose={"tail": 1.0}), "action.default_pose: no joint 'tail' in g1; "),
        (ActionConfig(joint_order=("left_knee_joint", "tail")), "action.joint_order: found 2 joints (unknown: tail; "
         "missing: left_ankle_pitch_joint, "),
        (ActionConfig(joint_order=("left_knee_joint",) * 29), "action.joint_order: found 29 joints (unknown: none; "),
    ],
)  # fmt: skip
def test_joints_that_are_not_the_robots_are_refused(action, message):
    with pytest.raises(InputError) as error:
        load_robot("g1", action=action)
    assert str(error.value).startswith(message)


def test_a_joint_target_as_an_action(robot, mode):
    """The left knee, whose default pose here is 0.3 rad and scale 0.33, with a reference of 0.5 rad."""
    mine = load_robot("g1", action=ActionConfig(mode, default_pose=POSE, scale=SCALE))
    knee = robot.joint_names.index("left_knee_joint")
    reference = SimpleNamespace(joint_pos=jnp.full((1, robot.num_joints), 0.5))
    target = jnp.full((1, robot.num_joints), 0.83)
    expected = (0.83 - 0.5) / 0.33 if mode == "residual" else (0.83 - 0.3) / 0.33
    assert float(to_action(mode, mine.arrays, reference, target)[0, knee]) == pytest.approx(expected, rel=1e-5)
