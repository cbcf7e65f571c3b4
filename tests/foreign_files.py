"""Files of other projects' policies, invented: an ONNX with metadata and a clip, deploy.yaml, config.yaml."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
import yaml
from onnx import TensorProto, helper, numpy_helper
from orders import ISAAC

from forgetmimic_jax.robot.model import Robot

SIZES = {"wbc132": 132, "mjlab160": 160, "mjlab154": 154}
TERMS = {
    "wbc132": "ref_base_height,ref_base_lin_vel_b,ref_base_ang_vel_b,ref_gravity_b,ref_joint_pos,base_ang_vel,"
    "projected_gravity,joint_pos,joint_vel,actions",
    "mjlab160": "command,motion_anchor_pos_b,motion_anchor_ori_b,base_lin_vel,base_ang_vel,joint_pos,joint_vel,actions",
    "mjlab154": "command,motion_anchor_ori_b,base_ang_vel,joint_pos,joint_vel,actions",
}
WIDTHS = {"command": 58, "motion_anchor_ori_b": 6, "joint_pos": 29, "joint_vel": 29, "actions": 29, "ref_joint_pos": 29}
WIDTHS["ref_base_height"] = 1


def numbers(low: float, high: float, seed: int, count: int = 29) -> list[float]:
    """Of a table of joints: three digits, as projects write them."""
    return [round(float(x), 3) for x in np.random.default_rng(seed).uniform(low, high, count)]


def weights(features: int, seed: int) -> dict[str, np.ndarray]:
    """A network 16 wide whose actions are some tenths."""
    rng = np.random.default_rng(seed)
    shapes = {"w0": (16, features), "b0": (16,), "w1": (29, 16), "b1": (29,)}
    size = {"w0": 0.5 / features**0.5, "b0": 0.1, "w1": 0.3, "b1": 0.1}
    return {name: (size[name] * rng.standard_normal(shape)).astype(np.float32) for name, shape in shapes.items()}


def network(
    path: Path,
    features: int,
    *,
    seed: int = 0,
    normaliser: bool = True,
    metadata: Mapping[str, str] | None = None,
    tables: Mapping[str, np.ndarray] | None = None,
    inputs: Sequence[str] = ("obs",),
    external: bool = False,
    opset: int = 11,
) -> Path:
    """Write an ONNX actor.

    Args:
        path: the file.
        features: numbers of the observation.
        seed: of the weights.
        normaliser: whether observations are normalised in it.
        metadata: what it says of itself.
        tables: a clip by the names of the outputs; looked up by `time_step`, the tables as Constants.
        inputs: names.
        external: the weights in PATH.data.
        opset: version.
    """
    constants = weights(features, seed)
    rng, nodes, first = np.random.default_rng(seed + 100), [], inputs[0]
    if normaliser:
        constants["mean"] = 0.1 * rng.standard_normal((1, features)).astype(np.float32)
        constants["std"] = rng.uniform(0.5, 2.0, (1, features)).astype(np.float32)
        nodes = [helper.make_node("Sub", [first, "mean"], ["c"]), helper.make_node("Div", ["c", "std"], ["x"])]
        first = "x"
    nodes += [
        helper.make_node("Gemm", [first, "w0", "b0"], ["h"], transB=1),
        helper.make_node("Elu", ["h"], ["e"]),
        helper.make_node("Gemm", ["e", "w1", "b1"], ["actions"], transB=1),
    ]
    given = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, features]) for name in inputs]
    results = [helper.make_tensor_value_info("actions", TensorProto.FLOAT, [1, 29])]
    if tables:
        given.append(helper.make_tensor_value_info("time_step", TensorProto.FLOAT, [1, 1]))
        nodes.append(helper.make_node("Cast", ["time_step"], ["step"], to=TensorProto.INT64))
        nodes.append(helper.make_node("Squeeze", ["step"], ["frame"], axes=[1]))
        for name, table in tables.items():
            value = numpy_helper.from_array(table.astype(np.float32))
            nodes.append(helper.make_node("Constant", [], [f"all_{name}"], value=value))
            nodes.append(helper.make_node("Gather", [f"all_{name}", "frame"], [name], axis=0))
            results.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, *table.shape[1:]]))
    initializers = [numpy_helper.from_array(value, name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, "actor", given, results, initializers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
    helper.set_model_props(model, dict(metadata or {}))
    path.parent.mkdir(parents=True, exist_ok=True)
    if external:
        onnx.save(model, path, save_as_external_data=True, location=f"{path.name}.data", size_threshold=0)
    else:
        onnx.save(model, path)
    return path


def metadata(robot: Robot, layout: str, seed: int = 0) -> dict[str, str]:
    """Mjlab's keys, with a pose and gains that are not the robot's."""
    default = np.asarray(robot.arrays.default_joint_pos)
    tables = {
        "joint_stiffness": numbers(30.0, 60.0, seed),
        "joint_damping": numbers(2.0, 4.0, seed + 1),
        "default_joint_pos": [round(float(x), 3) for x in default + numbers(-0.05, 0.05, seed + 2)],
        "action_scale": numbers(0.2, 0.4, seed + 3),
    }
    return {
        "joint_names": ",".join(robot.joint_names),
        "observation_names": TERMS[layout],
        "anchor_body_name": "torso_link",
        "body_names": ",".join(robot.key_bodies),
        **{key: ",".join(map(str, values)) for key, values in tables.items()},
    }


def clip_tables(library, clip: int = 0) -> dict[str, np.ndarray]:
    """A clip as mjlab's exporter writes it, in the robot's order."""
    frames = library.clip(clip)
    bodies = frames.bodies
    found = {"joint_pos": frames.joint_pos, "joint_vel": frames.joint_vel, "body_pos_w": bodies.pos}
    found |= {"body_quat_w": bodies.quat, "body_lin_vel_w": bodies.lin_vel, "body_ang_vel_w": bodies.ang_vel}
    return {name: np.array(values) for name, values in found.items()}


def mjlab_file(path: Path, robot: Robot, library, layout: str = "mjlab160", **changes: str | None) -> Path:
    """An ONNX with metadata, some of it changed or left out (None), and the library's first clip, opset 11."""
    said = {key: value for key, value in (metadata(robot, layout) | changes).items() if value is not None}
    return network(path, SIZES[layout], metadata=said, tables=clip_tables(library))


def deploy_table(robot: Robot, layout: str = "mjlab154") -> dict:
    """unitree_rl_lab's deploy.yaml: Isaac Lab's order of joints."""
    default = np.asarray(robot.arrays.default_joint_pos)[ISAAC]
    pose = [round(float(x), 3) for x in default + numbers(-0.05, 0.05, 7)]
    isaac = {"command": "motion_command", "joint_pos": "joint_pos_rel", "joint_vel": "joint_vel_rel"}
    isaac["actions"] = "last_action"
    terms = {
        isaac.get(name, name): {"params": {}, "clip": None, "scale": [1.0] * WIDTHS.get(name, 3), "history_length": 1}
        for name in TERMS[layout].split(",")
    }
    return {
        "joint_ids_map": list(ISAAC),
        "step_dt": 0.02,
        "stiffness": numbers(30.0, 60.0, 8),
        "damping": numbers(2.0, 4.0, 9),
        "default_joint_pos": pose,
        "commands": {},
        "actions": {"JointPositionAction": {"clip": None, "joint_names": [".*"], "scale": numbers(0.2, 0.4, 10),
                                            "offset": list(pose), "joint_ids": None}},
        "observations": terms,
    }  # fmt: skip


def lab_folder(folder: Path, robot: Robot, table: dict | None = None) -> Path:
    """unitree_rl_lab's folder of a policy: exported/policy.onnx without normaliser, params/deploy.yaml."""
    file = network(folder / "exported" / "policy.onnx", 154, seed=1, normaliser=False)
    (folder / "params").mkdir(exist_ok=True)
    (folder / "params" / "deploy.yaml").write_text(yaml.safe_dump(table or deploy_table(robot), sort_keys=False))
    return file


def config_table(robot: Robot) -> dict:
    """wbc-g1-deploy's config.yaml: residual actions, another default pose."""
    terms = {
        name: {"dim": WIDTHS.get(name, 3), "scale": [1.0] * WIDTHS.get(name, 3), "params": {}}
        for name in TERMS["wbc132"].split(",")
    }
    return {
        "schema_version": "wbc_tracking_params_v1",
        "robot_id": "g1",
        "policy_step_dt": 0.02,
        "joint_names": list(robot.joint_names),
        "default_joint_pos": numbers(-0.3, 0.3, 11),
        "stiffness": numbers(30.0, 60.0, 12),
        "damping": numbers(2.0, 4.0, 13),
        "action": {"action_mode": "reference_residual", "scale": numbers(0.2, 0.4, 14), "command_name": "motion"},
        "actor_observations": terms,
        "tracking": {"anchor_body_name": "torso_link", "actor_history_length": 1},
    }


def wbc_folder(folder: Path, robot: Robot, table: dict | None = None, **changes: str) -> Path:
    """wbc-g1-deploy's folder of a policy: policy.onnx with weights in policy.onnx.data, config.yaml beside it."""
    said = {"action_mode": "reference_residual", "observation_names": TERMS["wbc132"], **changes}
    file = network(folder / "policy.onnx", 132, seed=2, metadata=said, external=True)
    (folder / "config.yaml").write_text(yaml.safe_dump(table or config_table(robot), sort_keys=False))
    return file


def reference_file(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path
