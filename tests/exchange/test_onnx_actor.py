import dataclasses

import numpy as np
import onnx
import pytest
from orders import isaac_order

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.exchange.onnx_actor import OnnxActor, metadata, to_onnx
from forgetmimic_jax.robot.model import load_robot
from forgetmimic_jax.settings.config import ActionConfig, ObservationConfig
from forgetmimic_jax.tracking.layouts import LAYOUTS


@pytest.fixture(scope="module")
def model(policy, robot, tiny_config) -> onnx.ModelProto:
    return to_onnx(policy, robot, tiny_config, run_path="g1/0123456789abcdef")


@pytest.fixture(scope="module")
def actor(model) -> OnnxActor:
    return OnnxActor(model.SerializeToString())


def test_its_actions_are_the_policys(actor, policy, tiny_config):
    observations = np.random.default_rng(0).normal(0.0, 3.0, (50, 132)).astype(np.float32)
    observations[:5] *= 100.0  # beyond what the normaliser lets through
    expected = np.asarray(policy.mean_action(observations))
    found = np.stack([actor(observation) for observation in observations])
    assert np.abs(expected).max() > 1.0
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_one_observation_goes_in_and_one_action_comes_out(model):
    (given,), (result,) = model.graph.input, model.graph.output
    for value, name, size in ((given, "obs", 132), (result, "actions", 29)):
        assert value.name == name
        assert [dimension.dim_value for dimension in value.type.tensor_type.shape.dim] == [1, size]


def test_it_holds_the_network_and_nothing_of_a_motion(model):
    shapes = {tensor.name: list(tensor.dims) for tensor in model.graph.initializer}
    assert shapes == {
        **{"mean": [132], "scale": [132], "low": [], "high": []},
        **{"kernel_0": [132, 16], "kernel_1": [16, 16], "kernel_2": [16, 29]},
        **{"bias_0": [16], "bias_1": [16], "bias_2": [29]},
    }
    assert not any(node.op_type == "Constant" for node in model.graph.node)


def test_the_metadata_is_mjlabs(actor, robot):
    assert set(actor.metadata) == {
        *("run_path", "joint_names", "joint_stiffness", "joint_damping", "default_joint_pos", "command_names"),
        *("observation_names", "action_scale", "anchor_body_name", "body_names"),  # mjlab's tracking tasks
        *("policy_only_export", "action_mode"),  # wbc-mjlab's
        "step_dt",
    }
    message = actor.metadata
    assert message["joint_names"].split(",") == list(robot.joint_names)
    assert message["body_names"].split(",")[0] == "pelvis"
    assert (message["anchor_body_name"], message["command_names"]) == ("torso_link", "motion")
    assert message["observation_names"] == (
        "ref_base_height,ref_base_lin_vel_b,ref_base_ang_vel_b,ref_gravity_b,ref_joint_pos,"
        "base_ang_vel,projected_gravity,joint_pos,joint_vel,actions"
    )
    assert message["action_mode"] == "reference_residual"


WBC = "base_ang_vel,projected_gravity,joint_pos,joint_vel,actions"
NAMES_AND_BODY = {
    "wbc132": (
        f"ref_base_height,ref_base_lin_vel_b,ref_base_ang_vel_b,ref_gravity_b,ref_joint_pos,{WBC}",
        "torso_link",
    ),
    "root132": (
        f"ref_root_height,ref_root_lin_vel_b,ref_root_ang_vel_b,ref_root_gravity_b,ref_joint_pos,{WBC}",
        "pelvis",
    ),
    "mjlab160": (
        "command,motion_anchor_pos_b,motion_anchor_ori_b,base_lin_vel,base_ang_vel,joint_pos,joint_vel,actions",
        "torso_link",
    ),
    "mjlab154": ("command,motion_anchor_ori_b,base_ang_vel,joint_pos,joint_vel,actions", "torso_link"),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_metadata_name_the_terms_of_the_layout_and_the_body_that_they_are_of(robot, tiny_config, layout):
    config = dataclasses.replace(tiny_config, observation=ObservationConfig(layout))
    meta = metadata(robot, config, run_path="")
    assert (meta["observation_names"], meta["anchor_body_name"]) == NAMES_AND_BODY[layout]


def test_the_metadata_are_in_the_policys_order_and_say_what_its_actions_are_added_to(robot, tiny_config):
    order = isaac_order(robot)
    action = ActionConfig("offset", order, default_pose={"left_knee_joint": 0.5}, stiffness={"waist_yaw_joint": 77.0})
    mine = load_robot("g1", action=action)
    meta = metadata(mine, dataclasses.replace(tiny_config, action=action), run_path="")
    assert meta["action_mode"] == "default_relative"
    # Isaac Lab: left hip pitch, right hip pitch, waist yaw; the tenth is the left knee.
    assert meta["joint_names"].split(",")[:3] == [
        "left_hip_pitch_joint",
        "right_hip_pitch_joint",
        "waist_yaw_joint",
    ]
    values = {key: [float(item) for item in meta[key].split(",")] for key in ("default_joint_pos", "joint_stiffness")}
    assert values["default_joint_pos"][:3] == pytest.approx([-0.312, -0.312, 0.0])
    assert values["default_joint_pos"][9:11] == pytest.approx([0.5, 0.669])
    assert values["joint_stiffness"][2] == 77.0
    assert [float(item) for item in meta["action_scale"].split(",")][-2:] == pytest.approx([0.0745, 0.0745], abs=1e-4)


def test_gains_and_scales_read_back_to_the_last_digit(actor, robot):
    model = robot.model
    np.testing.assert_allclose(actor.numbers("joint_stiffness"), model.actuator_gainprm[:, 0], rtol=1e-6)
    np.testing.assert_allclose(actor.numbers("joint_damping"), -model.actuator_biasprm[:, 2], rtol=1e-6)
    effort = model.actuator_forcerange[:, 1]
    np.testing.assert_allclose(actor.numbers("action_scale"), 0.25 * effort / model.actuator_gainprm[:, 0], rtol=1e-6)
    for key in ("action_scale", "default_joint_pos"):
        arrays = np.asarray(getattr(robot.arrays, {"default_joint_pos": key}.get(key, key)))
        np.testing.assert_array_equal(actor.numbers(key).astype(np.float32), arrays)


def test_a_file_that_is_no_model_is_refused(tmp_path):
    path = tmp_path / "policy.onnx"
    path.write_bytes(b"not a model")
    with pytest.raises(InputError, match=f"^{path}: not a readable ONNX model: "):
        OnnxActor(path)
