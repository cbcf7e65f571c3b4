"""The actor as an ONNX graph, its normaliser included, with the metadata that deploy tools read.

Keys and names are those of mjlab's exporter (mjlab/rl/exporter_utils.py, Apache-2.0) and of wbc-mjlab's policy-only
export (wbc_mjlab/rl/runner.py): a list is its items joined by commas. The graph holds weights and nothing of a motion.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.policy.normalizer import OBSERVATION_LIMIT, VARIANCE_FLOOR
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.layouts import find_layout

INPUT, OUTPUT = "obs", "actions"
# wbc-mjlab's names. PD target = action_scale · action + reference joints of the next frame, or + default_joint_pos.
ACTION_MODES = {"residual": "reference_residual", "offset": "default_relative"}
OPSET, IR_VERSION = 13, 8  # old enough for the runtimes on robots


def to_onnx(policy: Policy, robot: Robot, config: Config, *, run_path: str) -> onnx.ModelProto:
    """The actor's mean action as a model from `obs` [1, features] to `actions` [1, joint].

    Args:
        policy: whose actor and normaliser are written.
        robot: for the metadata.
        config: of the policy: its layout and control step.
        run_path: what the policy says it is.
    """
    normalizer = policy.actor_normalizer
    constants = {
        "mean": np.asarray(normalizer.mean),
        "scale": 1.0 / np.sqrt(np.asarray(normalizer.variance) + np.float32(VARIANCE_FLOOR)),
        "low": np.float32(-OBSERVATION_LIMIT),
        "high": np.float32(OBSERVATION_LIMIT),
    }
    nodes = [
        helper.make_node("Sub", [INPUT, "mean"], ["centred"]),
        helper.make_node("Mul", ["centred", "scale"], ["scaled"]),
        helper.make_node("Clip", ["scaled", "low", "high"], ["layer_0"]),
    ]
    layers = dense_layers(policy)
    for i, (kernel, bias) in enumerate(layers):
        constants |= {f"kernel_{i}": kernel, f"bias_{i}": bias}
        last = i == len(layers) - 1
        result = OUTPUT if last else f"dense_{i}"
        nodes.append(helper.make_node("Gemm", [f"layer_{i}", f"kernel_{i}", f"bias_{i}"], [result]))
        if not last:
            nodes.append(helper.make_node("Elu", [result], [f"layer_{i + 1}"]))
    graph = helper.make_graph(
        nodes,
        "actor",
        # A batch of one, as deploy tools take the sizes of their buffers from here.
        [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, [1, normalizer.mean.size])],
        [helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, [1, robot.num_joints])],
        [numpy_helper.from_array(np.asarray(value, np.float32), name) for name, value in constants.items()],
    )
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="forgetmimic-jax",
    )
    helper.set_model_props(model, metadata(robot, config, run_path=run_path))
    onnx.checker.check_model(model, full_check=True)
    return model


def metadata(robot: Robot, config: Config, *, run_path: str) -> dict[str, str]:
    """What a deploy tool must know beside the weights; all that is of joints is in the order of `joint_names`.

    Numbers have all their digits, where mjlab rounds to three.
    """
    arrays, order, layout = robot.arrays, robot.policy_joints, find_layout(config.observation.layout)
    body = {"anchor": robot.anchor, "root": robot.root}[layout.body]
    return {
        "run_path": run_path,
        "policy_only_export": "true",
        "action_mode": ACTION_MODES[config.action.mode],
        "joint_names": _csv(robot.policy_joint_names),
        "joint_stiffness": _csv(np.asarray(arrays.stiffness)[order]),
        "joint_damping": _csv(np.asarray(arrays.damping)[order]),
        "default_joint_pos": _csv(np.asarray(arrays.default_joint_pos)[order]),
        "action_scale": _csv(np.asarray(arrays.action_scale)[order]),
        "command_names": "motion",
        "observation_names": _csv(term.name for term in layout.terms),
        "anchor_body_name": robot.key_bodies[body],  # whose motion the terms of the reference show
        "body_names": _csv(robot.key_bodies),
        "step_dt": _csv([config.physics.control_step]),
    }


def dense_layers(policy: Policy) -> list[tuple[np.ndarray, np.ndarray]]:
    """Kernel [in, out] and bias [out] of the actor's layers, in their order."""
    layers = policy.actor["params"]["MLP_0"]
    return [
        (np.asarray(layers[f"Dense_{i}"]["kernel"]), np.asarray(layers[f"Dense_{i}"]["bias"]))
        for i in range(len(layers))
    ]


class OnnxActor:
    """An ONNX policy under onnxruntime, with its metadata. Knows no JAX."""

    def __init__(self, source: Path | bytes):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # so small a network is slower on several
        try:
            self._session = onnxruntime.InferenceSession(
                source if isinstance(source, bytes) else str(source), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime has a type of its own for each trouble
            raise InputError(f"{source!s:.200}: not a readable ONNX model: {str(error).splitlines()[0]}") from None
        # A tracking policy of mjlab also takes the time step of the motion it holds, which no action depends on.
        others = [value for value in self._session.get_inputs() if value.name != INPUT]
        self._feed = {value.name: np.zeros([1] * len(value.shape), np.float32) for value in others}
        self.metadata: dict[str, str] = self._session.get_modelmeta().custom_metadata_map

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Mean action f32[joint] at an observation [features]."""
        return self._session.run([OUTPUT], self._feed | {INPUT: observation[None].astype(np.float32)})[0][0]

    def names(self, key: str) -> list[str]:
        """A metadata list of names."""
        return self.metadata[key].split(",")

    def numbers(self, key: str) -> np.ndarray:
        """A metadata list of numbers."""
        return np.array([float(item) for item in self.names(key)])


def _csv(items: Iterable[Any]) -> str:
    return ",".join(str(item) for item in items)
