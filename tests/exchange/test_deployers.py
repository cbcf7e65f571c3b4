"""What an export is for each deploy tool: a loop from its files alone moves the robot as the environment does."""

import dataclasses

import jax
import numpy as np
import onnx
import pytest
import yaml
from invented import invented_policy
from loops import from_config_yaml, from_deploy_yaml, from_metadata, in_its_own_loop, in_the_environment
from orders import ISAAC, isaac_order

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.exchange.deployers import check_free, deployer_file
from forgetmimic_jax.exchange.foreign import PolicyReading, read_policy
from forgetmimic_jax.exchange.onnx_actor import to_onnx
from forgetmimic_jax.robot.model import load_robot
from forgetmimic_jax.settings.config import ActionConfig, ObservationConfig
from forgetmimic_jax.tracking.setup import Setup

STEPS = 12
# Layout, action mode, whether the policy has Isaac Lab's order of joints, and the YAML beside the ONNX.
CASES = [
    ("wbc132", "residual", False, "config.yaml"),
    ("wbc132", "offset", True, "config.yaml"),
    ("mjlab160", "offset", False, None),
    ("mjlab154", "offset", True, "deploy.yaml"),
    ("mjlab154", "residual", False, None),
    ("root132", "residual", False, None),
]


@pytest.fixture(scope="module", params=CASES, ids=lambda case: f"{case[0]}-{case[1]}")
def exported(request, tiny_config, library, tmp_path_factory):
    """The setup of a policy with its own pose, scale and gains, the policy, its ONNX and the YAML beside it."""
    layout, mode, isaac, beside = request.param
    tables = {"default_pose": {"left_knee_joint": 0.5}, "scale": {"waist_yaw_joint": 0.3}}
    tables |= {"stiffness": {"left_elbow_joint": 10.0}, "damping": {"left_elbow_joint": 1.5}}
    robot = load_robot("g1")
    action = ActionConfig(mode, isaac_order(robot) if isaac else (), **tables)
    config = dataclasses.replace(tiny_config, observation=ObservationConfig(layout), action=action)
    setup = Setup(config, load_robot("g1", config.physics, action), library, "invented")
    policy = invented_policy(config)
    actor = policy.actor["params"]
    last = jax.tree.map(lambda x: 0.1 * x, actor["MLP_0"]["Dense_2"])  # gentle: the robot stays up for a while
    policy = dataclasses.replace(policy, actor={"params": actor | {"MLP_0": actor["MLP_0"] | {"Dense_2": last}}})
    file = tmp_path_factory.mktemp("export") / "policy.onnx"
    onnx.save(to_onnx(policy, setup.robot, config, run_path=""), file)
    found = deployer_file(setup.robot, config)
    assert (found[0] if found else None) == beside
    if found:
        (file.parent / found[0]).write_text(yaml.safe_dump(found[1], sort_keys=False))
    return setup, policy, file, beside


def test_its_deployers_loop_moves_the_robot_as_the_environment(exported, robot, library):
    setup, policy, file, beside = exported
    found = in_the_environment(setup, lambda assets, state, seen: policy.mean_action(seen), STEPS)
    assert np.ptp(found, axis=0).max() > 0.02
    deployments = [from_metadata(file)]
    if beside == "deploy.yaml":
        deployments.append(from_deploy_yaml(file, file.parent / beside, robot))
    if beside == "config.yaml":
        deployments.append(from_config_yaml(file, file.parent / beside))
    for deployment in deployments:
        np.testing.assert_allclose(in_its_own_loop(deployment, robot, library, STEPS), found, atol=1e-5)


def test_it_comes_back_as_it_went(exported, robot, tiny_config):
    setup, policy, file, _ = exported
    back = read_policy(file, robot, 0.02, PolicyReading())
    config = back.config(tiny_config)
    assert config.observation == setup.config.observation
    assert config.action.mode == setup.config.action.mode
    there, here = load_robot("g1", action=config.action), setup.robot
    np.testing.assert_array_equal(there.policy_joints, here.policy_joints)
    for name in ("default_joint_pos", "action_scale", "stiffness", "damping"):
        np.testing.assert_array_equal(getattr(there.arrays, name), getattr(here.arrays, name))
    np.testing.assert_allclose(back.actor.mean, policy.actor_normalizer.mean, atol=1e-5)


def test_unitree_rl_labs_yaml_has_gains_in_the_robots_order_and_all_else_in_the_policys(robot, tiny_config):
    action = ActionConfig(
        "offset", isaac_order(robot), stiffness={"left_knee_joint": 77.0}, scale={"waist_yaw_joint": 0.3}
    )
    config = dataclasses.replace(tiny_config, observation=ObservationConfig("mjlab154"), action=action)
    name, table = deployer_file(load_robot("g1", action=action), config)
    assert name == "deploy.yaml"
    assert table["joint_ids_map"] == list(ISAAC)
    assert table["stiffness"][3] == 77.0  # the left knee is the robot's fourth joint
    assert table["actions"]["JointPositionAction"]["scale"][2] == 0.3  # the waist's yaw is Isaac Lab's third
    assert list(table["observations"]) == [
        *("motion_command", "motion_anchor_ori_b", "base_ang_vel", "joint_pos_rel", "joint_vel_rel", "last_action"),
    ]
    assert len(table["observations"]["motion_command"]["scale"]) == 58


def test_a_runs_own_config_yaml_is_never_replaced(tmp_path):
    check_free(tmp_path, "config.yaml")
    (tmp_path / "config.yaml").write_text("schema_version: wbc_tracking_params_v1\n")
    check_free(tmp_path, "config.yaml")
    (tmp_path / "config.yaml").write_text("preset: cpu\n")
    with pytest.raises(
        InputError, match=r"config\.yaml: exists and is another file; the export writes its config\.yaml"
    ):
        check_free(tmp_path, "config.yaml")
