from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.exchange.onnx_actor import OnnxActor, to_onnx
from forgetmimic_jax.exchange.onnx_reader import read_onnx

RSL_RL = Path(__file__).parent / "rsl_rl" / "rsl_rl_5.5.1.onnx"
OBSERVATIONS = np.random.default_rng(0).normal(size=(10, 132)).astype(np.float32)


def close(actor, observations, expected):
    np.testing.assert_allclose(actor(observations), expected, rtol=1e-5, atol=1e-5)


def test_rsl_rls_own_export_acts_as_rsl_rl(robot, tiny_config):
    actor, original = read_onnx(RSL_RL, robot, tiny_config), np.load(RSL_RL.with_suffix(".npz"))
    close(actor, original["observations"], original["actions"])
    assert (actor.hidden_layers, actor.std) == ((8, 6), None)


@pytest.fixture
def exported(policy, robot, tiny_config) -> onnx.ModelProto:
    return to_onnx(policy, robot, tiny_config, run_path="")


@pytest.fixture
def save(tmp_path):
    def save(model: onnx.ModelProto) -> Path:
        onnx.save(model, tmp_path / "policy.onnx")
        return tmp_path / "policy.onnx"

    return save


def test_what_this_project_exports_is_read_back(exported, save, policy, robot, tiny_config):
    path = save(exported)
    actor = read_onnx(path, robot, tiny_config)
    close(actor, OBSERVATIONS, np.stack([OnnxActor(path)(each) for each in OBSERVATIONS]))
    np.testing.assert_allclose(actor.mean, policy.actor_normalizer.mean, rtol=1e-5)
    np.testing.assert_allclose(actor.scale**2, policy.actor_normalizer.variance + 1e-6, rtol=1e-5)


def test_a_motion_beside_the_actor_is_not_read(exported, save, robot, tiny_config):
    """Mjlab's tracking tasks put the clip into the graph, looked up by a second input."""
    graph = exported.graph
    expected = np.stack([OnnxActor(exported.SerializeToString())(each) for each in OBSERVATIONS])
    graph.initializer.append(numpy_helper.from_array(np.zeros((50, 29), np.float32), "motion"))
    graph.node.append(helper.make_node("Cast", ["time_step"], ["frame"], to=TensorProto.INT64))
    graph.node.append(helper.make_node("Gather", ["motion", "frame"], ["joint_pos"]))
    graph.input.append(helper.make_tensor_value_info("time_step", TensorProto.FLOAT, [1, 1]))
    graph.output.append(helper.make_tensor_value_info("joint_pos", TensorProto.FLOAT, [1, 1, 29]))
    path = save(exported)
    close(read_onnx(path, robot, tiny_config), OBSERVATIONS, expected)
    close(lambda x: np.stack([OnnxActor(path)(each) for each in x]), OBSERVATIONS, expected)


def network(robot, *middle: onnx.NodeProto, **constants: np.ndarray) -> onnx.ModelProto:
    """A network from `obs` to `actions` by way of nodes, the first of which takes `obs`."""
    graph = helper.make_graph(
        list(middle),
        "actor",
        [helper.make_tensor_value_info("obs", TensorProto.FLOAT, [1, 132])],
        [helper.make_tensor_value_info("actions", TensorProto.FLOAT, [1, 29])],
        [numpy_helper.from_array(np.asarray(value, np.float32), name) for name, value in constants.items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)


KERNELS = {"k0": np.full((132, 4), 0.01), "b0": np.arange(4.0) - 2.0, "k1": np.ones((4, 29)), "b1": np.ones(29)}
FIRST = [helper.make_node("MatMul", ["x", "k0"], ["m0"]), helper.make_node("Add", ["b0", "m0"], ["d0"])]
LAST = [helper.make_node("Elu", ["d0"], ["e0"]), helper.make_node("Gemm", ["e0", "k1", "b1"], ["actions"])]


def test_other_spellings_of_the_same_network_are_read(robot, save, tiny_config):
    # (obs + 1) · 2 / (√4 + 1), the divisor computed in the graph; a matrix product and its bias apart.
    model = network(
        robot,
        helper.make_node("Add", ["obs", "one"], ["a"]),
        helper.make_node("Mul", ["two", "a"], ["b"]),
        helper.make_node("Sqrt", ["four"], ["root"]),
        helper.make_node("Add", ["root", "one"], ["three"]),
        helper.make_node("Div", ["b", "three"], ["c"]),
        helper.make_node("Identity", ["c"], ["x"]),
        *FIRST,
        *LAST,
        **{"one": [1.0], "two": [2.0], "four": [4.0], **KERNELS},
    )
    actor = read_onnx(save(model), robot, tiny_config)
    z = (OBSERVATIONS + 1.0) * 2.0 / 3.0
    hidden = z.sum(1, keepdims=True) * 0.01 + KERNELS["b0"]
    hidden = np.where(hidden > 0, hidden, np.exp(hidden) - 1.0)
    close(actor, OBSERVATIONS, np.repeat(hidden.sum(1, keepdims=True) + 1.0, 29, axis=1))


START = helper.make_node("Identity", ["obs"], ["x"])


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ([START, *FIRST, helper.make_node("Relu", ["d0"], ["e0"]), LAST[1]], "operation Relu: accepted, in this "),
        ([START, *FIRST, helper.make_node("Elu", ["d0"], ["e0"], alpha=0.5), LAST[1]], "operation Elu: accepted, "),
        ([START, *FIRST, helper.make_node("Tanh", ["d0"], ["actions"])], "operation Tanh: accepted, in this order: "),
        ([START, *FIRST, helper.make_node("Gemm", ["d0", "k1", "b1"], ["actions"])], "operation Gemm: accepted, in "),
        ([helper.make_node("Clip", ["obs", "five", "five"], ["x"]), *FIRST, *LAST], "operation Clip: accepted, in "),
        ([helper.make_node("Sub", ["five", "obs"], ["x"]), *FIRST, *LAST], "operation Sub: found obs as input; "),
        ([helper.make_node("Mul", ["obs", "obs"], ["x"]), *FIRST, *LAST], "operation Mul: found obs, obs as input; "),
        ([START, *FIRST, helper.make_node("Elu", ["d0"], ["actions"])], "the last operation is no linear layer; an "),
        ([helper.make_node("Sub", ["state", "five"], ["x"]), *FIRST, *LAST], "actions depends on 'state'; accepted: "),
        ([helper.make_node("Identity", ["five"], ["actions"])], "operation Identity: found no value as input; "),
    ],
)
def test_another_network_is_told(robot, save, nodes, message, tiny_config):
    path = save(network(robot, *nodes, five=[5.0], **KERNELS))
    with pytest.raises(InputError) as error:
        read_onnx(path, robot, tiny_config)
    assert str(error.value).removeprefix(f"{path}: ").startswith(message)


def test_other_inputs_or_outputs_are_told(robot, save, exported, tiny_config):
    exported.graph.output[0].name = "mu"
    path = save(exported)
    with pytest.raises(InputError, match=rf"^{path}: outputs: found mu; 'actions' is needed$"):
        read_onnx(path, robot, tiny_config)
    exported.graph.input[0].name = "observation"
    with pytest.raises(InputError, match=rf"^{path}: inputs: found observation; 'obs' is needed$"):
        read_onnx(save(exported), robot, tiny_config)


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        (
            "joint_names",
            lambda x: x.replace("left_knee", "knee_left"),
            "found 'knee_left_joint' at place 3; 'left_knee",
        ),
        ("joint_names", lambda x: x + ",head_joint", "found 30; 29 are needed: left_hip_pitch_joint, "),
        (
            "observation_names",
            lambda x: x.replace("joint_pos,joint_vel", "joint_vel,joint_pos"),
            "found 'joint_vel' at",
        ),
        ("observation_names", lambda x: x.replace("ref_", "motion_"), "found 'motion_base_height' at place 0; 'ref_b"),
        ("anchor_body_name", lambda x: "pelvis", "found 'pelvis'; 'torso_link' is needed"),
        ("action_mode", lambda x: "default_relative", "found 'default_relative'; 'reference_residual' is needed"),
        ("action_scale", lambda x: "0.25", "left_hip_pitch_joint: found 0.25; g1 here has 0.5475: a policy works with"),
        ("action_scale", lambda x: "0.25,0.25", "found 2 numbers; 29 are needed"),
        ("joint_stiffness", lambda x: "stiff", "found 'stiff'; numbers are needed"),
        (
            "joint_damping",
            lambda x: x.replace("6.3", "7.3", 1),
            "left_hip_roll_joint: found 7.309; g1 here has 6.309: ",
        ),
        (
            "default_joint_pos",
            lambda x: x.replace("0.669", "0.3", 1),
            "left_knee_joint: found 0.3; g1 here has 0.669: ",
        ),
        (
            "default_joint_pos",
            lambda x: x.replace("0.669", "nan", 1),
            "left_knee_joint: found nan; g1 here has 0.669: ",
        ),
    ],
)
def test_metadata_of_another_robot_or_observation_is_told(robot, save, exported, key, change, message, tiny_config):
    for entry in exported.metadata_props:
        if entry.key == key:
            entry.value = change(entry.value)
    path = save(exported)
    with pytest.raises(InputError) as error:
        read_onnx(path, robot, tiny_config)
    assert str(error.value).startswith(f"{path}: {key}: {message}")


def test_metadata_with_mjlabs_three_decimals_or_none_is_accepted(robot, save, exported, tiny_config):
    for entry in exported.metadata_props:
        if entry.key in ("joint_stiffness", "joint_damping", "default_joint_pos", "action_scale"):
            entry.value = ",".join(f"{float(number):.3f}" for number in entry.value.split(","))
    assert read_onnx(save(exported), robot, tiny_config).hidden_layers == (16, 16)
    del exported.metadata_props[:]
    assert read_onnx(save(exported), robot, tiny_config).hidden_layers == (16, 16)


def test_what_is_no_model_is_told(robot, tmp_path, tiny_config):
    path = tmp_path / "policy.onnx"
    with pytest.raises(InputError, match=rf"^{path}: no such file$"):
        read_onnx(path, robot, tiny_config)
    path.write_bytes(b"not a model")
    with pytest.raises(InputError, match=rf"^{path}: not a readable ONNX model: "):
        read_onnx(path, robot, tiny_config)
    path.write_bytes(b"")
    with pytest.raises(InputError, match=rf"^{path}: "):
        read_onnx(path, robot, tiny_config)
