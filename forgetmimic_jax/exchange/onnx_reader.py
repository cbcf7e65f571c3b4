"""An ONNX file as plain arrays: the actor (normaliser, linear layers, ELU), its metadata, and the clip inside."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from onnx import numpy_helper
from onnx.external_data_helper import load_external_data_for_model
from onnx.reference import ReferenceEvaluator

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.files import check_no_pointer
from forgetmimic_jax.exchange.imported import ImportedActor
from forgetmimic_jax.exchange.onnx_actor import INPUT, OUTPUT
from forgetmimic_jax.policy.normalizer import OBSERVATION_LIMIT
from forgetmimic_jax.tracking.layouts import UNSUPPORTED

TIME_STEP = "time_step"  # mjlab's second input: the frame of the clip inside
CLIP = ("joint_pos", "joint_vel", "body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w")  # its outputs
HUMANOIDVERSE = "actor_obs"  # the input of its exports

# What an operation with a constant c makes of z = scale · observation + shift.
_AFFINE: dict[str, Callable] = {
    "Sub": lambda scale, shift, c: (scale, shift - c),
    "Add": lambda scale, shift, c: (scale, shift + c),
    "Mul": lambda scale, shift, c: (scale * c, shift * c),
    "Div": lambda scale, shift, c: (scale / c, shift / c),
}


@dataclass(frozen=True)
class OnnxContent:
    """What an ONNX file holds: the actor, its metadata, and the clip that it looks up by `time_step`."""

    actor: ImportedActor
    metadata: dict[str, str]
    clip: dict[str, np.ndarray]  # [frame, ...] by the name of the output; empty without a clip


def read_onnx(path: Path) -> OnnxContent:
    """The chain of operations from the input `obs` to the output `actions`, and what the file says of itself.

    Raises:
        InputError: not a model, a missing file of weights, other inputs or other operations.
    """
    model = _load(path)
    chain = _Chain(model.graph, path)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    return OnnxContent(_actor(chain, path), metadata, chain.tables(CLIP))


def _load(path: Path) -> onnx.ModelProto:
    check_no_pointer(path)
    if path.is_file() and path.stat().st_size == 0:
        raise InputError(f"{path}: an empty file; an ONNX model is needed")
    try:
        model = onnx.load(path, load_external_data=False)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (DecodeError, onnx.checker.ValidationError, ValueError) as error:
        raise InputError(f"{path}: not a readable ONNX model: {str(error).splitlines()[0]}") from None
    weights = {
        entry.value
        for tensor in model.graph.initializer
        if tensor.data_location == onnx.TensorProto.EXTERNAL
        for entry in tensor.external_data
        if entry.key == "location"
    }
    for name in sorted(weights):
        if not (path.parent / name).is_file():
            raise InputError(f"{path}: its weights are in {name}, and there is no such file beside it")
        check_no_pointer(path.parent / name)
    try:
        load_external_data_for_model(model, str(path.parent))
    except (onnx.checker.ValidationError, ValueError, OSError) as error:
        raise InputError(f"{path}: weights in {', '.join(sorted(weights))}: {str(error).splitlines()[0]}") from None
    return model


def _actor(chain: _Chain, path: Path) -> ImportedActor:
    """The actor that a chain of operations computes."""
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
        mean = np.array(np.broadcast_to(-shift / scale, features), np.float32)
        divisor = np.array(np.broadcast_to(1.0 / scale, features), np.float32)
    return ImportedActor(tuple(layers), mean=mean, scale=divisor)


class _Chain:
    """The operations between input and output, each with constants but for the value that is passed on."""

    def __init__(self, graph: onnx.GraphProto, path: Path):
        self._path = path
        self._constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
        self._producers = {name: node for node in graph.node for name in node.output}
        inputs = [value.name for value in graph.input if value.name not in self._constants]
        outputs = [value.name for value in graph.output]
        if HUMANOIDVERSE in inputs:
            raise InputError(f"{path}: inputs: found {', '.join(inputs)}: HumanoidVerse's layouts are not supported: "
                             f"they need {UNSUPPORTED['humanoidverse']}")  # fmt: skip
        unknown = [name for name in inputs if name not in (INPUT, TIME_STEP)]
        if INPUT not in inputs or unknown:
            raise InputError(f"{path}: inputs: found {', '.join(inputs) or 'none'}; '{INPUT}' is needed, and no other "
                             f"is accepted but mjlab's '{TIME_STEP}'")  # fmt: skip
        if OUTPUT not in outputs:
            raise InputError(f"{path}: outputs: found {', '.join(outputs) or 'none'}; '{OUTPUT}' is needed")
        self._outputs = outputs

    def tables(self, names: Sequence[str]) -> dict[str, np.ndarray]:
        """The constant tables [row, ...] that outputs of these names are rows of; initialisers or Constants."""
        found = {}
        for name in names:
            node = self._producers.get(name) if name in self._outputs else None
            while node is not None and node.op_type in ("Identity", "Cast", "Squeeze", "Unsqueeze", "Reshape"):
                node = self._producers.get(node.input[0])
            table = self._constant(node.input[0]) if node is not None and node.op_type == "Gather" else None
            if table is not None:
                found[name] = table
        return found

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
                with np.errstate(all="ignore"):  # what is not finite is refused by its name, later
                    self._constants |= dict(zip(node.output, ReferenceEvaluator(node).run(None, given), strict=True))
        return self._constants.get(name)


def _linear(node: onnx.NodeProto, constants: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Kernel [in, out] and bias [out]."""
    kernel = constants[0].T if _attribute(node, "transB", 0) else constants[0]
    with np.errstate(all="ignore"):  # what is not finite is refused by its name, later
        kernel = kernel * np.float32(_attribute(node, "alpha", 1.0))
        bias = constants[1].reshape(-1) * np.float32(_attribute(node, "beta", 1.0)) if len(constants) > 1 else 0.0
        return kernel, bias + np.zeros(kernel.shape[-1], np.float32)


def _attribute(node: onnx.NodeProto, name: str, default: float) -> float:
    return next((onnx.helper.get_attribute_value(each) for each in node.attribute if each.name == name), default)
