"""The YAML beside an exported ONNX, for the deploy tools that read one: unitree_rl_lab's and wbc-g1-deploy's.

mjlab's tools read the metadata inside the ONNX (`exchange.onnx_actor`) and need no file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.exchange.onnx_actor import ACTION_MODES
from forgetmimic_jax.exchange.sources import CONFIG, DEPLOY, ISAAC_TERMS
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.layouts import find_layout

SCHEMA = "wbc_tracking_params_v1"


def deployer_file(robot: Robot, config: Config) -> tuple[str, dict[str, Any]] | None:
    """Name and content of the YAML that the deploy tool of a policy's layout and action reads, if there is such a tool.

    unitree_rl_lab deploys mjlab154 with actions on the default pose, wbc-g1-deploy deploys wbc132.
    """
    layout = config.observation.layout
    if layout == "mjlab154" and config.action.mode == "offset":
        return DEPLOY, _deploy(robot, config)
    return (CONFIG, _config(robot, config)) if layout == "wbc132" else None


def check_free(folder: Path, name: str) -> None:
    """InputError where a folder has a file of that name that is not this one's, such as a run's own config.yaml."""
    path = folder / name
    key = {DEPLOY: "joint_ids_map", CONFIG: "schema_version"}[name]
    if path.is_file() and key not in (yaml.safe_load(path.read_text()) or {}):
        raise InputError(
            f"{path}: exists and is another file; the export writes its {name} there; choose another --output"
        )


def _deploy(robot: Robot, config: Config) -> dict[str, Any]:
    """unitree_rl_lab's: pose and scale in the policy's order, gains in the robot's."""
    order, arrays = robot.policy_joints, robot.arrays
    pose = _numbers(arrays.default_joint_pos, order)
    names = {ours: theirs for theirs, ours in ISAAC_TERMS.items()}
    terms = {
        names.get(term.name, term.name): {
            "params": {"command_name": "motion"} if term.of_reference else {},
            "clip": None,
            "scale": [1.0] * term.size(robot.num_joints),
            "history_length": 1,
        }
        for term in find_layout(config.observation.layout).terms
    }
    action = {"clip": None, "joint_names": [".*"], "scale": _numbers(arrays.action_scale, order), "offset": list(pose)}
    return {
        "joint_ids_map": [int(joint) for joint in order],
        "step_dt": config.physics.control_step,
        "stiffness": _numbers(arrays.stiffness),
        "damping": _numbers(arrays.damping),
        "default_joint_pos": pose,
        "commands": {},
        "actions": {"JointPositionAction": {**action, "joint_ids": None}},
        "observations": terms,
    }


def _config(robot: Robot, config: Config) -> dict[str, Any]:
    """wbc-g1-deploy's: every table in the policy's order of joints."""
    order, arrays = robot.policy_joints, robot.arrays
    terms = find_layout(config.observation.layout).terms
    tables = {name: _numbers(getattr(arrays, name), order) for name in ("default_joint_pos", "stiffness", "damping")}
    reference = [term.name for term in terms if term.of_reference]
    return {
        "schema_version": SCHEMA,
        "robot_id": robot.name,
        "policy_step_dt": config.physics.control_step,
        "joint_names": list(robot.policy_joint_names),
        **tables,
        "action": {
            "action_mode": ACTION_MODES[config.action.mode],
            "scale": _numbers(arrays.action_scale, order),
            "command_name": "motion",
        },
        "actor_observations": {
            term.name: {
                "dim": term.size(robot.num_joints),
                "scale": [1.0] * term.size(robot.num_joints),
                "params": {"command_name": "motion"} if term.of_reference else {},
            }
            for term in terms
        },
        "tracking": {
            "anchor_body_name": robot.key_bodies[robot.anchor],
            "has_state_estimation": False,
            "wbc_command_dim": sum(term.size(robot.num_joints) for term in terms if term.of_reference),
            "reference_observation_names": reference,
            "actor_observation_names": [term.name for term in terms],
            "actor_history_length": 1,
        },
    }


def _numbers(values: Any, order: np.ndarray | None = None) -> list[float]:
    """Numbers with all digits of float32, in an order of joints."""
    values = np.asarray(values)
    return [float(str(value)) for value in (values if order is None else values[order])]
