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
import re
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
ROBOT_KEYS = ("robot_id", "robot_name", "robot")  # of a YAML
# Isaac Lab's names of the same terms, in unitree_rl_lab and unitree_rl_mjlab.
ISAAC_TERMS = {"motion_command": "command", "joint_pos_rel": "joint_pos", "joint_vel_rel": "joint_vel"}
ISAAC_TERMS |= {"last_action": "actions"}
GYM_HISTORY = "use_gym_history"  # a switch among unitree_rl_lab's terms
_MODES = {name: mode for mode, name in ACTION_MODES.items()}


def beside(policy: Path, robot: Robot) -> list[tuple[str, Facts]]:
    """The facts of every YAML that describes a policy file, and the YAML's name.

    They are in the policy's folder, in params/ there, or in params/ beside that folder, as unitree_rl_lab has it.

    Raises:
        InputError: one is not YAML, is HumanoidVerse's or of another robot, or has a key of another form.
    """
    found = []
    paths = [folder / kind for folder in _folders(policy) for kind in (DEPLOY, CONFIG)]
    for path in filter(Path.is_file, paths):
        content = _yaml(path)
        # Other projects have a config.yaml too, as we have.
        if path.name == DEPLOY or "actor_observations" in content:
            _check_robot(content, robot, path)
            read = from_deploy_yaml if path.name == DEPLOY else from_config_yaml
            found.append((path, read(content, robot, str(path))))
    names = [path.name for path, _ in found]
    return [(path.name if names.count(path.name) == 1 else str(path), facts) for path, facts in found]


def _yaml(path: Path) -> Mapping[str, Any]:
    try:
        content = yaml.safe_load(path.read_text())
    except (yaml.YAMLError, ValueError) as error:  # ValueError: not UTF-8, or a date that is none
        raise InputError(f"{path}: not YAML: {str(error).splitlines()[0]}") from None
    content = content if isinstance(content, dict) else {}
    if isinstance(content.get("obs"), dict) and "obs_dict" in content["obs"]:
        raise InputError(f"{path}: obs.obs_dict: HumanoidVerse's layouts are not supported: they need "
                         f"{UNSUPPORTED['humanoidverse']}")  # fmt: skip
    return content


def _check_robot(content: Mapping[str, Any], robot: Robot, path: Path) -> None:
    """InputError for a name of another robot; `unitree_g1_29dof` is a name of g1, and g1 one of my_g1."""
    ours = robot.name.lower()
    for key in (key for key in ROBOT_KEYS if isinstance(content.get(key), str)):
        words = re.findall(r"[a-z0-9]+", content[key].lower())
        if not any(word in ours or ours in word for word in words):
            raise InputError(f"{path}: {key}: found '{content[key]}'; accepted: {robot.name}: a policy of another "
                             f"robot?")  # fmt: skip


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
    facts: Facts = {key: metadata[key].strip() for key in ("anchor_body_name",) if key in metadata}
    for key in ("observation_names", "body_names"):
        if key in metadata:
            facts[key] = tuple(_split(metadata[key]))
    if "action_mode" in metadata:
        facts["action_mode"] = _mode(metadata["action_mode"].strip(), f"{where}: action_mode")
    joints = robot.joint_names
    if "joint_names" in metadata:
        joints = facts["joint_names"] = _joints(_split(metadata["joint_names"]), robot, f"{where}: joint_names")
    for key in TABLES:
        if key in metadata:
            facts[key] = _table(key, metadata[key].split(","), joints, f"{where}: {key}")
    if "step_dt" in metadata:
        facts["step_dt"] = _number(metadata["step_dt"], f"{where}: step_dt")
    return facts


def _split(names: str) -> list[str]:
    """Names joined by commas, with or without spaces."""
    return [name.strip() for name in names.split(",")]


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
        numbers = isinstance(places, list) and all(type(place) is int for place in places)
        if not numbers or sorted(places) != list(range(robot.num_joints)):
            found = f"{len(places)} places" if numbers else str(places)[:40]
            raise InputError(f"{field}: found {found}; the {robot.num_joints} joints of {robot.name} are needed, each "
                             f"once: a policy of another robot?")  # fmt: skip
        joints = facts["joint_names"] = tuple(robot.joint_names[place] for place in places)
    if "default_joint_pos" in content:
        pose = content["default_joint_pos"]
        facts["default_joint_pos"] = _table("default_joint_pos", pose, joints, f"{where}: default_joint_pos")
    for key in ("stiffness", "damping"):
        if key in content:
            facts[f"joint_{key}"] = _table(f"joint_{key}", content[key], robot.joint_names, f"{where}: {key}")
    actions = _part(content, "actions", where)
    if actions:
        if list(actions) != ["JointPositionAction"]:
            raise InputError(f"{where}: actions: found {', '.join(map(str, actions))}; accepted: JointPositionAction")
        field = f"{where}: actions.JointPositionAction"
        action = _mapping(actions["JointPositionAction"], field)
        facts["action_mode"] = "offset"
        _check_unclipped(action.get("clip"), f"{field}.clip")
        for key in ("scale", "offset"):
            if action.get(key) is not None:
                facts[f"action_{key}"] = _table(f"action_{key}", action[key], joints, f"{field}.{key}")
    if content.get("observations"):
        facts |= _terms(content["observations"], f"{where}: observations")
    if "step_dt" in content:
        facts["step_dt"] = _number(content["step_dt"], f"{where}: step_dt")
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
    action, tracking = _part(content, "action", where), _part(content, "tracking", where)
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
        facts["step_dt"] = _number(content["policy_step_dt"], f"{where}: policy_step_dt")
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


def _part(content: Mapping[str, Any], key: str, where: str) -> Mapping[str, Any]:
    """A table in a YAML; an empty one where the key is missing or null."""
    return {} if content.get(key) is None else _mapping(content[key], f"{where}: {key}")


def _mapping(value: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise InputError(f"{where}: found {str(value)[:40]}; a table is needed")
    return value


def _terms(content: Any, where: str) -> Facts:
    """Names and scales of terms, in their order."""
    if isinstance(content, dict) and GYM_HISTORY in content:
        if content[GYM_HISTORY] is not False:
            raise InputError(f"{where}.{GYM_HISTORY}: found {content[GYM_HISTORY]}; accepted: false: its order is not "
                             f"supported: it needs {UNSUPPORTED['history']}")  # fmt: skip
        content = {name: term for name, term in content.items() if name != GYM_HISTORY}
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


def _numbers(values: Sequence[Any], count: int, where: str) -> list[float]:
    if len(values) != count:
        raise InputError(f"{where}: found {len(values)} numbers; {count} are needed")
    return [_number(value, where) for value in values]


def _number(value: Any, where: str) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InputError(f"{where}: found {str(value)[:40]}; a number is needed") from None
    if not math.isfinite(number):
        raise InputError(f"{where}: found {number}; a finite number is needed")
    return number


def _mode(name: Any, where: str) -> str:
    if str(name) not in _MODES:
        raise InputError(f"{where}: found '{name}'; accepted: {', '.join(_MODES)}")
    return _MODES[str(name)]


def _check_no_history(lengths: Iterable[Any], where: str) -> None:
    for length in lengths:
        if str(length).strip() not in ("0", "1"):
            raise InputError(f"{where}: found {length}: not supported: it needs {UNSUPPORTED['history']}")


def _check_unclipped(bounds: Any, where: str) -> None:
    if bounds is not None:
        raise InputError(f"{where}: found {bounds}; accepted: null: nothing here is clipped")
