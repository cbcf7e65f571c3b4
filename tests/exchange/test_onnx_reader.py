from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.exchange.onnx_actor import OnnxActor, to_onnx
from forgetmimic_jax.exchange.onnx_reader import read_onnx

RSL_RL = Path(__file__).parent / "rsl_rl" / "rsl_rl_5.5.1.onnx"
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n"
OBSERVATIONS = np.random.default_rng(0).normal(size=(10, 132)).astype(np.float32)


def close(actor, observations, expected):
    np.testing.assert_allclose(actor(observations), expected, rtol=1e-5, atol=1e-5)


def test_rsl_rls_own_export_acts_as_rsl_rl():
    actor, original = read_onnx(RSL_RL).actor, np.load(RSL_RL.with_suffix(".npz"))
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


def test_what_this_project_exports_is_read_back(exported, save, policy):
    path = save(exported)
    actor = read_onnx(path).actor
    close(actor, OBSERVATIONS, np.stack([OnnxActor(path)(each) for each in OBSERVATIONS]))
    np.testing.assert_allclose(actor.mean, policy.actor_normalizer.mean, rtol=1e-5)
    np.testing.assert_allclose(actor.scale**2, policy.actor_normalizer.variance + 1e-6, rtol=1e-5)


def test_a_motion_beside_the_actor_is_no_part_of_it(exported, save):
    """Mjlab's tracking tasks put the clip into the graph, looked up by a second input."""
    graph = exported.graph
    expected = np.stack([OnnxActor(exported.SerializeToString())(each) for each in OBSERVATIONS])
    graph.initializer.append(numpy_helper.from_array(np.full((50, 29), 3.0, np.float32), "motion"))
    graph.node.append(helper.make_node("Cast", ["time_step"], ["frame"], to=TensorProto.INT64))
    graph.node.append(helper.make_node("Gather", ["motion", "frame"], ["joint_pos"]))
    graph.input.append(helper.make_tensor_value_info("time_step", TensorProto.FLOAT, [1, 1]))
    graph.output.append(helper.make_tensor_value_info("joint_pos", TensorProto.FLOAT, [1, 1, 29]))
    path = save(exported)
    content = read_onnx(path)
    close(content.actor, OBSERVATIONS, expected)
    assert {name: (table.shape, table[7, 3]) for name, table in content.clip.items()} == {"joint_pos": ((50, 29), 3.0)}
    close(lambda x: np.stack([OnnxActor(path)(each) for each in x]), OBSERVATIONS, expected)


def network(*middle: onnx.NodeProto, **constants: np.ndarray) -> onnx.ModelProto:
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


def test_other_spellings_of_the_same_network_are_read(save):
    # (obs + 1) · 2 / (√4 + 1), the divisor computed in the graph; a matrix product and its bias apart.
    model = network(
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
    actor = read_onnx(save(model)).actor
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
def test_another_network_is_refused(save, nodes, message):
    path = save(network(*nodes, five=[5.0], **KERNELS))
    with pytest.raises(InputError) as error:
        read_onnx(path)
    assert str(error.value).removeprefix(f"{path}: ").startswith(message)


def test_other_inputs_or_outputs_are_refused(save, exported):
    exported.graph.output[0].name = "mu"
    path = save(exported)
    with pytest.raises(InputError, match=rf"^{path}: outputs: found mu; 'actions' is needed$"):
        read_onnx(path)
    exported.graph.input[0].name = "observation"
    with pytest.raises(InputError, match=rf"^{path}: inputs: found observation; 'obs' is needed, and no other "):
        read_onnx(save(exported))


def test_what_is_no_model_is_refused(tmp_path):
    path = tmp_path / "policy.onnx"
    with pytest.raises(InputError, match=rf"^{path}: no such file$"):
        read_onnx(path)
    path.write_bytes(b"not a model")
    with pytest.raises(InputError, match=rf"^{path}: not a readable ONNX model: "):
        read_onnx(path)
    path.write_bytes(b"")
    with pytest.raises(InputError, match=rf"^{path}: an empty file; an ONNX model is needed$"):
        read_onnx(path)
    path.write_bytes(POINTER)
    with pytest.raises(InputError, match=rf"^{path}: this is a Git LFS pointer, not the file: run git lfs pull$"):
        read_onnx(path)


def test_weights_of_their_own_that_are_a_git_lfs_pointer_are_refused(exported, tmp_path):
    path, weights = tmp_path / "policy.onnx", tmp_path / "policy.onnx.data"
    onnx.save(exported, path, save_as_external_data=True, location=weights.name, size_threshold=0)
    assert read_onnx(path).actor.layers
    weights.write_bytes(POINTER)
    with pytest.raises(InputError, match=rf"^{weights}: this is a Git LFS pointer, not the file: run git lfs pull$"):
        read_onnx(path)
