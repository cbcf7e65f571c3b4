"""What the files of a policy say of it: an ONNX file's metadata, deploy.yaml, config.yaml, and the user's flags.

Every source gives `Facts`, by mjlab's names. A table is of joints by name, whatever order its file has it in.

observation_names          the terms, by the names of `tracking.layouts`
observation_scale          numbers by term, which the term is multiplied by
anchor_body_name           the body that terms of one body are of
body_names                 bodies of the clip inside the file
joint_names                the joints, in the order of inputs and outputs
default_joint_pos, action_offset, action_scale, joint_stiffness, joint_damping    tables of joints
action_mode                residual or offset
step_dt                    s between two actions
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import yaml

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.exchange.onnx_actor import ACTION_MODES
from forgetmimic_jax.motion.converting import breadth_first
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.tracking.layouts import LAYOUTS, UNSUPPORTED

Facts = dict[str, Any]
TABLES = ("default_joint_pos", "action_offset", "action_scale", "joint_stiffness", "joint_damping")
# Of the tables whose numbers cannot be any: what is accepted, and whether a number is.
BOUNDS: dict[str, tuple[str, Callable[[float], bool]]] = {
    "action_scale": ("more than 0", lambda value: value > 0.0),
    "joint_stiffness": ("more than 0", lambda value: value > 0.0),
    "joint_damping": ("0 or more", lambda value: value >= 0.0),
}
DEPLOY, CONFIG = "deploy.yaml", "config.yaml"
# Isaac Lab's names of the same terms, in unitree_rl_lab and unitree_rl_mjlab.
ISAAC_TERMS = {"motion_command": "command", "joint_pos_rel": "joint_pos", "joint_vel_rel": "joint_vel"}
ISAAC_TERMS |= {"last_action": "actions"}
_MODES = {name: mode for mode, name in ACTION_MODES.items()}


def beside(policy: Path) -> tuple[str, Path, Mapping[str, Any]] | None:
    """The kind, path and content of the YAML that describes a policy file.

    It is in the policy's folder, in params/ there, or in params/ beside that folder, as unitree_rl_lab has it.

    Raises:
        InputError: it is not YAML, or is HumanoidVerse's.
    """
    for folder in _folders(policy):
        for kind in (DEPLOY, CONFIG):
            path = folder / kind
            if not path.is_file():
                continue
            try:
                content = yaml.safe_load(path.read_text())
            except (yaml.YAMLError, UnicodeDecodeError) as error:
                raise InputError(f"{path}: not YAML: {str(error).splitlines()[0]}") from None
            content = content if isinstance(content, dict) else {}
            if "obs_dict" in (content.get("obs") or {}):
                raise InputError(f"{path}: obs.obs_dict: HumanoidVerse's layouts are not supported: they need "
                                 f"{UNSUPPORTED['humanoidverse']}")  # fmt: skip
            if kind == DEPLOY or "actor_observations" in content:  # other projects have a config.yaml too, as we have
                return kind, path, content
    return None


def motion_beside(policy: Path) -> Path | None:
    """The one motion file in the folders of a policy's YAML, if there is just one."""
    found = [
        path for folder in _folders(policy) for path in sorted(folder.glob("*")) if path.suffix in (".csv", ".npz")
    ]
    return found[0] if len(found) == 1 else None


def _folders(policy: Path) -> list[Path]:
    here = policy.resolve().parent
    folders = [policy.parent, policy.parent / "params"]
    return [*folders, here.parent / "params"] if here.name != "params" else folders


def from_metadata(metadata: Mapping[str, str], robot: Robot, where: str) -> Facts:
    """Of an ONNX file: mjlab's, BeyondMimic's and wbc-mjlab's keys, lists joined by commas.

    Raises:
        InputError: holosoma's keys, a history, another robot's joints, or what are no numbers.
    """
    if "dof_names" in metadata:
        raise InputError(f"{where}: dof_names: holosoma's layout is not supported: it needs {UNSUPPORTED['holosoma']}")
    for key, value in metadata.items():
        if "history" in key:
            _check_no_history(value.split(","), f"{where}: {key}")
    facts: Facts = {key: metadata[key] for key in ("anchor_body_name",) if key in metadata}
    for key in ("observation_names", "body_names"):
        if key in metadata:
            facts[key] = tuple(metadata[key].split(","))
    if "action_mode" in metadata:
        facts["action_mode"] = _mode(metadata["action_mode"], f"{where}: action_mode")
    joints = robot.joint_names
    if "joint_names" in metadata:
        joints = facts["joint_names"] = _joints(metadata["joint_names"].split(","), robot, f"{where}: joint_names")
    for key in TABLES:
        if key in metadata:
            facts[key] = _table(key, metadata[key].split(","), joints, f"{where}: {key}")
    if "step_dt" in metadata:
        facts["step_dt"] = _numbers([metadata["step_dt"]], 1, f"{where}: step_dt")[0]
    return facts


def from_deploy_yaml(content: Mapping[str, Any], robot: Robot, where: str) -> Facts:
    """Of unitree_rl_lab and unitree_rl_mjlab.

    `joint_ids_map` has the place of each joint of the policy in the robot's own order. Pose, scale and offset are in
    the policy's order, stiffness and damping in the robot's.

    Raises:
        InputError: a key of another form, a history, a clip, or another action than JointPositionAction.
    """
    facts: Facts = {}
    joints = robot.joint_names
    if "joint_ids_map" in content:
        places, field = content["joint_ids_map"], f"{where}: joint_ids_map"
        if not isinstance(places, list) or sorted(map(str, places)) != sorted(map(str, range(robot.num_joints))):
            found = f"{len(places)} places" if isinstance(places, list) else repr(places)
            raise InputError(f"{field}: found {found}; the {robot.num_joints} joints of {robot.name} are needed, each "
                             f"once: a policy of another robot?")  # fmt: skip
        joints = facts["joint_names"] = tuple(robot.joint_names[place] for place in places)
    if "default_joint_pos" in content:
        pose = content["default_joint_pos"]
        facts["default_joint_pos"] = _table("default_joint_pos", pose, joints, f"{where}: default_joint_pos")
    for key in ("stiffness", "damping"):
        if key in content:
            facts[f"joint_{key}"] = _table(f"joint_{key}", content[key], robot.joint_names, f"{where}: {key}")
    actions = content.get("actions") or {}
    if actions:
        if list(actions) != ["JointPositionAction"]:
            raise InputError(f"{where}: actions: found {', '.join(map(str, actions))}; accepted: JointPositionAction")
        action, field = actions["JointPositionAction"], f"{where}: actions.JointPositionAction"
        facts["action_mode"] = "offset"
        _check_unclipped(action.get("clip"), f"{field}.clip")
        for key in ("scale", "offset"):
            if action.get(key) is not None:
                facts[f"action_{key}"] = _table(f"action_{key}", action[key], joints, f"{field}.{key}")
    if content.get("observations"):
        facts |= _terms(content["observations"], f"{where}: observations")
    if "step_dt" in content:
        facts["step_dt"] = _numbers(content["step_dt"], 1, f"{where}: step_dt")[0]
    return facts


def from_config_yaml(content: Mapping[str, Any], robot: Robot, where: str) -> Facts:
    """Of wbc-g1-deploy (wbc_tracking_params_v1); every table is in the order of `joint_names`.

    Raises:
        InputError: a key of another form, a history, or another robot's joints.
    """
    facts: Facts = {}
    joints = robot.joint_names
    if "joint_names" in content:
        joints = facts["joint_names"] = _joints(content["joint_names"], robot, f"{where}: joint_names")
    for key in ("default_joint_pos", "stiffness", "damping"):
        if key in content:
            name = key if key in TABLES else f"joint_{key}"
            facts[name] = _table(name, content[key], joints, f"{where}: {key}")
    action, tracking = content.get("action") or {}, content.get("tracking") or {}
    if "action_mode" in action:
        facts["action_mode"] = _mode(action["action_mode"], f"{where}: action.action_mode")
    for key in ("scale", "offset"):
        if action.get(key) is not None:
            facts[f"action_{key}"] = _table(f"action_{key}", action[key], joints, f"{where}: action.{key}")
    if content.get("actor_observations"):
        facts |= _terms(content["actor_observations"], f"{where}: actor_observations")
    if "anchor_body_name" in tracking:
        facts["anchor_body_name"] = str(tracking["anchor_body_name"])
    _check_no_history([tracking.get("actor_history_length", 1)], f"{where}: tracking.actor_history_length")
    if "policy_step_dt" in content:
        facts["step_dt"] = _numbers(content["policy_step_dt"], 1, f"{where}: policy_step_dt")[0]
    return facts


def from_flags(layout: str | None, mode: str | None, order: Literal["robot", "isaac"] | None, robot: Robot) -> Facts:
    """Of the flags --layout, --action-mode and --joint-order."""
    facts: Facts = {}
    if order is not None:
        facts["joint_names"] = breadth_first(robot) if order == "isaac" else robot.joint_names
    if layout is not None:
        facts["observation_names"] = tuple(LAYOUTS[layout].sensor_noise)
    if mode is not None:
        facts["action_mode"] = mode
    return facts


def _terms(content: Any, where: str) -> Facts:
    """Names and scales of terms, in their order."""
    if not isinstance(content, dict) or not all(isinstance(term, dict) for term in content.values()):
        raise InputError(f"{where}: a table of terms is needed")
    names = {name: ISAAC_TERMS.get(str(name), str(name)) for name in content}
    scales = {}
    for name, term in content.items():
        _check_no_history([term.get("history_length", 1)], f"{where}.{name}.history_length")
        _check_unclipped(term.get("clip"), f"{where}.{name}.clip")
        if term.get("scale") is not None:
            scale = term["scale"] if isinstance(term["scale"], list) else [term["scale"]]
            scales[names[name]] = _numbers(scale, len(scale), f"{where}.{name}.scale")
    return {"observation_names": tuple(names.values()), "observation_scale": scales}


def _joints(found: Sequence[Any], robot: Robot, where: str) -> tuple[str, ...]:
    names = tuple(map(str, found)) if isinstance(found, list) else ()
    if sorted(names) != sorted(robot.joint_names):
        missing, unknown = set(robot.joint_names) - set(names), set(names) - set(robot.joint_names)
        raise InputError(
            f"{where}: found {len(names)} joints that are not {robot.name}'s {robot.num_joints} (missing: "
            f"{_some(missing)}; unknown: {_some(unknown)}): a policy of another robot?"
        )
    return names


def _some(names: Iterable[str]) -> str:
    names = sorted(names)
    return ", ".join(names[:3] + ["…"] * (len(names) > 3)) or "none"


def _table(key: str, values: Any, joints: Sequence[str], where: str) -> dict[str, float]:
    """The table `key` of a number for each joint; one number stands for every joint."""
    values = values if isinstance(values, list) else [values]
    values = values * len(joints) if len(values) == 1 else values
    table = dict(zip(joints, _numbers(values, len(joints), where), strict=True))
    accepted, is_possible = BOUNDS.get(key, ("", lambda value: True))
    for joint, value in table.items():
        if not is_possible(value):
            raise InputError(f"{where}: {joint}: found {value:g}; accepted: {accepted}")
    return table


def _numbers(values: Any, count: int, where: str) -> list[float]:
    values = values if isinstance(values, list) else [values]
    if len(values) != count:
        raise InputError(f"{where}: found {len(values)} numbers; {count} are needed")
    try:
        numbers = [float(value) for value in values]
    except (TypeError, ValueError):
        raise InputError(f"{where}: found {str(values)[:40]}; numbers are needed") from None
    if not all(map(math.isfinite, numbers)):
        raise InputError(
            f"{where}: found {next(x for x in numbers if not math.isfinite(x))}; finite numbers are needed"
        )
    return numbers


def _mode(name: Any, where: str) -> str:
    if name not in _MODES:
        raise InputError(f"{where}: found '{name}'; accepted: {', '.join(_MODES)}")
    return _MODES[name]


def _check_no_history(lengths: Iterable[Any], where: str) -> None:
    for length in lengths:
        if str(length).strip() not in ("0", "1"):
            raise InputError(f"{where}: found {length}: not supported: it needs {UNSUPPORTED['history']}")


def _check_unclipped(bounds: Any, where: str) -> None:
    if bounds is not None:
        raise InputError(f"{where}: found {bounds}; accepted: null: nothing here is clipped")
