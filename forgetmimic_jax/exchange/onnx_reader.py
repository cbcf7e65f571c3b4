"""An ONNX actor as plain arrays: normaliser, linear layers, ELU. What else a file holds, a motion, is not read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from onnx import numpy_helper
from onnx.reference import ReferenceEvaluator

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.exchange.imported import ImportedActor
from forgetmimic_jax.exchange.onnx_actor import INPUT, OUTPUT, metadata
from forgetmimic_jax.policy.normalizer import OBSERVATION_LIMIT
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.settings.config import Config

METADATA_TOLERANCE = 2e-3  # mjlab writes three decimals


# What an operation with a constant c makes of z = scale · observation + shift.
_AFFINE: dict[str, Callable] = {
    "Sub": lambda scale, shift, c: (scale, shift - c),
    "Add": lambda scale, shift, c: (scale, shift + c),
    "Mul": lambda scale, shift, c: (scale * c, shift * c),
    "Div": lambda scale, shift, c: (scale / c, shift / c),
}


def read_onnx(path: Path, robot: Robot, config: Config) -> ImportedActor:
    """The actor of an ONNX file: the chain of operations from the input `obs` to the output `actions`.

    Args:
        path: the file.
        robot: that the policy must be for.
        config: with the layout that the policy must see.

    Raises:
        InputError: not a model, other operations, or metadata that tell of another robot or observation.
    """
    try:
        model = onnx.load(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (DecodeError, onnx.checker.ValidationError, ValueError) as error:
        raise InputError(f"{path}: not a readable ONNX model: {str(error).splitlines()[0]}") from None
    _check_metadata({entry.key: entry.value for entry in model.metadata_props}, robot, config, path)
    chain = _Chain(model.graph, path)
    scale, shift = np.ones(1), np.zeros(1)
    layers: list[tuple[np.ndarray, np.ndarray]] = []
    linear = False  # whether the last operation was a linear layer
    for node, constants in chain.steps():
        match node.op_type:
            case "Identity":
                pass
            case "Sub" | "Add" | "Mul" | "Div" if not layers:
                with np.errstate(all="ignore"):  # a scale of zero is refused with all that is not finite
                    scale, shift = _AFFINE[node.op_type](scale, shift, constants[0].astype(np.float64).reshape(-1))
            case "Clip" if not layers and [np.abs(c).tolist() for c in constants] == [OBSERVATION_LIMIT] * 2:
                pass
            case "Gemm" | "MatMul" if not linear:
                layers.append(_linear(node, constants))
                linear = True
            case "Add" if linear:  # the bias after a MatMul
                layers[-1] = (layers[-1][0], layers[-1][1] + constants[0].reshape(-1))
            case "Elu" if linear and _attribute(node, "alpha", 1.0) == 1.0:
                linear = False
            case other:
                raise InputError(
                    f"{path}: operation {other}: accepted, in this order: a normaliser (Sub, Add, Mul, Div, Clip to "
                    f"±{OBSERVATION_LIMIT:g}), then linear layers (Gemm, MatMul) with Elu of alpha 1 between two"
                )
    if not linear:
        raise InputError(f"{path}: the last operation is no linear layer; an actor's mean action is needed")
    if np.all(scale == 1.0) and np.all(shift == 0.0):
        return ImportedActor(tuple(layers))
    features = len(layers[0][0])
    with np.errstate(all="ignore"):
        mean, divisor = (np.array(np.broadcast_to(x, features), np.float32) for x in (-shift / scale, 1.0 / scale))
    return ImportedActor(tuple(layers), mean=mean, scale=divisor)


class _Chain:
    """The operations between input and output, each with constants but for the value that is passed on."""

    def __init__(self, graph: onnx.GraphProto, path: Path):
        self._path = path
        self._constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
        self._producers = {name: node for node in graph.node for name in node.output}
        inputs, outputs = ([value.name for value in values] for values in (graph.input, graph.output))
        for what, found, needed in (("inputs", inputs, INPUT), ("outputs", outputs, OUTPUT)):
            if needed not in found:
                raise InputError(f"{path}: {what}: found {', '.join(found) or 'none'}; '{needed}' is needed")

    def steps(self) -> list[tuple[onnx.NodeProto, list[np.ndarray]]]:
        """Each operation with its constants, from the input on."""
        name, steps = OUTPUT, []
        while name != INPUT:
            node = self._producers.get(name)
            if node is None:
                raise InputError(f"{self._path}: {OUTPUT} depends on '{name}'; accepted: on '{INPUT}' alone")
            values = [(given, self._constant(given)) for given in node.input if given]
            passed = [given for given, constant in values if constant is None]
            first = node.input[0] == passed[0] if passed else False
            if len(passed) != 1 or not (first or node.op_type in ("Add", "Mul")):
                raise InputError(
                    f"{self._path}: operation {node.op_type}: found {', '.join(passed) or 'no value'} as input; "
                    f"accepted: one value, then constants"
                )
            steps.append((node, [constant for _, constant in values if constant is not None]))
            name = passed[0]
        return steps[::-1]

    def _constant(self, name: str) -> np.ndarray | None:
        """The value of what depends on no input, else None."""
        if name not in self._constants and name in self._producers:
            node = self._producers[name]
            given = {each: self._constant(each) for each in node.input if each}
            if all(value is not None for value in given.values()):
                self._constants |= dict(zip(node.output, ReferenceEvaluator(node).run(None, given), strict=True))
        return self._constants.get(name)


def _linear(node: onnx.NodeProto, constants: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Kernel [in, out] and bias [out]."""
    kernel = constants[0].T if _attribute(node, "transB", 0) else constants[0]
    kernel = kernel * np.float32(_attribute(node, "alpha", 1.0))
    bias = constants[1].reshape(-1) * np.float32(_attribute(node, "beta", 1.0)) if len(constants) > 1 else 0.0
    return kernel, bias + np.zeros(kernel.shape[-1], np.float32)


def _attribute(node: onnx.NodeProto, name: str, default: float) -> float:
    return next((onnx.helper.get_attribute_value(each) for each in node.attribute if each.name == name), default)


def _check_metadata(found: dict[str, str], robot: Robot, config: Config, path: Path) -> None:
    """What the file says of its robot must be so here. A file may say nothing."""
    for key, here in metadata(robot, config, run_path="").items():
        there = found.get(key, here)
        if key in ("joint_names", "observation_names", "anchor_body_name", "action_mode") and there != here:
            raise InputError(f"{path}: {key}: {_difference(there.split(','), here.split(','))}")
        if key in ("joint_stiffness", "joint_damping", "default_joint_pos", "action_scale"):
            _check_numbers(key, there, here, robot, path)


def _difference(there: list[str], here: list[str]) -> str:
    """The first place where two lists differ."""
    if len(there) != len(here):
        return f"found {len(there)}; {len(here)} are needed: {', '.join(here)}"
    place = next(i for i, (one, other) in enumerate(zip(there, here, strict=True)) if one != other)
    where = f" at place {place}" if len(here) > 1 else ""
    return f"found '{there[place]}'{where}; '{here[place]}' is needed"


def _check_numbers(key: str, there: str, here: str, robot: Robot, path: Path) -> None:
    try:
        found = np.array([float(item) for item in there.split(",")])
    except ValueError:
        raise InputError(f"{path}: {key}: found '{there[:40]}'; numbers are needed") from None
    needed = np.array([float(item) for item in here.split(",")])
    if found.size == 1:  # mjlab's scale, where it is the same for all
        found = np.full(needed.size, found[0])
    if found.size != needed.size:
        raise InputError(f"{path}: {key}: found {found.size} numbers; {needed.size} are needed")
    joint = int(np.argmax(np.abs(found - needed)))
    if not abs(found[joint] - needed[joint]) <= METADATA_TOLERANCE:
        raise InputError(
            f"{path}: {key}: {robot.policy_joint_names[joint]}: found {found[joint]:.4g}; {robot.name} here has "
            f"{needed[joint]:.4g}: a policy works with the gains and scales it was trained with"
        )
