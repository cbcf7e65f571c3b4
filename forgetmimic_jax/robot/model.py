"""A robot: its MJCF and a YAML of roles, resolved by name into a MuJoCo model and arrays.

Every order (joints, bodies) is the model's own, looked up by name, never by position.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import yaml
from flax import struct
from jax import Array

from forgetmimic_jax.basics.errors import InputError, nearest
from forgetmimic_jax.basics.places import shipped

ROBOTS_DIR = shipped("robots")
CONTACT_SENSOR = "contact_"
VISUAL_GROUP = 2  # the geom group of the shapes that are only seen
G1_ROOT_HEIGHT, G1_MASS = 0.793, 33.341142  # m, of the G1's pelvis in its MJCF; kg


@struct.dataclass
class RobotArrays:
    """The robot's constants as traced arguments of the jitted functions. `joint` is the number of actuated joints."""

    stiffness: Array  # kp [joint] N m/rad
    damping: Array  # kd [joint] N m s/rad
    effort: Array  # torque limit [joint] N m
    action_scale: Array  # [joint] rad per unit of action: 0.25 effort / kp
    default_joint_pos: Array  # [joint] rad
    soft_lower: Array  # [joint] rad, soft joint limits
    soft_upper: Array  # [joint] rad
    mass: Array  # [] kg, the whole robot
    inertia: Array  # [3, 3] kg m^2 of the whole robot about its centre of mass, default pose, root frame
    gravity: Array  # [3] m/s^2


@dataclass(frozen=True)
class Robot:
    """What the host knows of a robot: the compiled model, names and indices."""

    name: str
    spec: mujoco.MjSpec  # what `model` is compiled from
    model: mujoco.MjModel
    joint_names: tuple[str, ...]
    joint_velocity_limit: np.ndarray  # [joint] rad/s, the motor's no-load speed
    joint_lower: np.ndarray  # [joint] rad
    joint_upper: np.ndarray  # [joint] rad
    default_height: float  # root height of the default pose, m
    key_bodies: tuple[str, ...]
    key_body_ids: np.ndarray  # [key_body] rows of the model's bodies
    anchor: int  # index into key_bodies
    root: int  # index into key_bodies of the floating base
    end_effectors: np.ndarray  # indices into key_bodies
    feet: np.ndarray  # indices into key_bodies
    anchor_body_id: int
    foot_geom_ids: np.ndarray
    arrays: RobotArrays

    @property
    def num_joints(self) -> int:
        return len(self.joint_names)


def robot_names(robots_dir: Path = ROBOTS_DIR) -> list[str]:
    """Names of the robots that have a folder with a YAML of roles."""
    return sorted(path.parent.name for path in robots_dir.glob("*/*.yaml") if path.stem == path.parent.name)


def roles_file(name: str, robots_dir: Path = ROBOTS_DIR) -> Path:
    """The YAML of a robot's roles.

    Raises:
        InputError: unknown robot.
    """
    known = robot_names(robots_dir)
    if name not in known:
        raise InputError(f"robot '{name}': no robots/{name}/{name}.yaml; {nearest(name, known)}")
    return robots_dir / name / f"{name}.yaml"


def load_robot(
    name: str,
    *,
    timestep: float = 0.005,
    solver_iterations: int = 10,
    line_search_iterations: int = 20,
    self_collision: bool = False,
    robots_dir: Path = ROBOTS_DIR,
) -> Robot:
    """Compile a robot from `robots/NAME/`.

    Args:
        name: folder under robots/.
        timestep: physics step, s.
        solver_iterations: upper limit of the constraint solver's Newton iterations.
        line_search_iterations: upper limit of each iteration's line search.
        self_collision: let the robot's shapes touch each other, not the floor alone.

    Raises:
        InputError: unknown robot, or a role that names a joint or body the model lacks.
    """
    path = roles_file(name, robots_dir)
    roles = _read_roles(path)
    spec = read_spec(name, robots_dir)
    spec.compiler.discardvisual = True  # shapes that are only seen would cost every step a little
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.iterations = solver_iterations
    spec.option.ls_iterations = line_search_iterations
    # Euler's own damping term is unused by implicitfast; MJX reads the flag.
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)

    joints = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_HINGE]
    bodies = [body.name for body in spec.bodies]
    for field in ("key_bodies", "end_effectors", "feet"):
        for body in roles[field]:
            if body not in bodies:
                raise InputError(f"{path}: {field}: no body '{body}' in {roles['model']}; {nearest(body, bodies)}")
    joint_names = tuple(joint.name for joint in joints)
    for joint in roles["default_pose"]:
        if joint not in joint_names:
            raise InputError(f"{path}: default_pose: no joint '{joint}'; {nearest(joint, joint_names)}")
    for field in ("end_effectors", "feet"):
        missing = set(roles[field]) - set(roles["key_bodies"])
        if missing:
            raise InputError(f"{path}: {field}: {sorted(missing)} must be among key_bodies")
    if roles["anchor"] not in roles["key_bodies"]:
        raise InputError(f"{path}: anchor: '{roles['anchor']}' must be among key_bodies")

    motors = [_motor_of(joint.name, roles, path) for joint in joints]
    omega = 2.0 * np.pi * roles["natural_frequency_hz"]
    armature = np.array([motor["armature"] for motor in motors])
    effort = np.array([motor["effort"] for motor in motors])
    stiffness = armature * omega**2
    damping = 2.0 * roles["damping_ratio"] * armature * omega
    for joint, motor, kp, kd in zip(joints, motors, stiffness, damping, strict=True):
        joint.armature = motor["armature"]
        actuator = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=kp, kv=kd)
        actuator.forcerange = [-motor["effort"], motor["effort"]]
        actuator.forcelimited = True
    if self_collision:
        for geom in spec.geoms:
            if geom.name != "floor" and geom.conaffinity:
                geom.contype = 1
    for body in roles["key_bodies"]:
        sensor = spec.add_sensor(
            name=CONTACT_SENSOR + body,
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=body,
        )
        sensor.refname, sensor.reftype = "floor", mujoco.mjtObj.mjOBJ_GEOM
        sensor.intprm[:3] = [1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 3, 1]  # data, reduce=netforce, num
    model = spec.compile()

    joint_ids = np.array([model.joint(joint).id for joint in joint_names])
    if not np.array_equal(model.jnt_qposadr[joint_ids], 7 + np.arange(len(joint_ids))):
        raise InputError(f"{path}: {roles['model']} must have one free joint first and hinge joints only")
    key_bodies = tuple(roles["key_bodies"])
    key_body_ids = np.array([model.body(body).id for body in key_bodies])
    root_name = model.body(1).name
    if root_name not in key_bodies:
        raise InputError(f"{path}: key_bodies: the floating base '{root_name}' must be among them")
    lower, upper = model.jnt_range[joint_ids].T
    centre, half = 0.5 * (lower + upper), 0.5 * (upper - lower) * roles["soft_limit_factor"]
    default = np.array([roles["default_pose"].get(joint, 0.0) for joint in joint_names])
    foot_ids = {model.body(foot).id for foot in roles["feet"]}
    arrays = RobotArrays(
        stiffness=jnp.asarray(stiffness, jnp.float32),
        damping=jnp.asarray(damping, jnp.float32),
        effort=jnp.asarray(effort, jnp.float32),
        action_scale=jnp.asarray(0.25 * effort / stiffness, jnp.float32),
        default_joint_pos=jnp.asarray(default, jnp.float32),
        soft_lower=jnp.asarray(centre - half, jnp.float32),
        soft_upper=jnp.asarray(centre + half, jnp.float32),
        mass=jnp.asarray(model.body_subtreemass[1], jnp.float32),
        inertia=jnp.asarray(_whole_body_inertia(model, default), jnp.float32),
        gravity=jnp.asarray(model.opt.gravity, jnp.float32),
    )
    return Robot(
        name=name,
        spec=spec,
        model=model,
        joint_names=joint_names,
        joint_velocity_limit=np.array([motor["velocity"] for motor in motors]),
        joint_lower=lower,
        joint_upper=upper,
        default_height=float(roles["default_height"]),
        key_bodies=key_bodies,
        key_body_ids=key_body_ids,
        anchor=key_bodies.index(roles["anchor"]),
        root=key_bodies.index(root_name),
        end_effectors=np.array([key_bodies.index(body) for body in roles["end_effectors"]]),
        feet=np.array([key_bodies.index(body) for body in roles["feet"]]),
        anchor_body_id=model.body(roles["anchor"]).id,
        foot_geom_ids=np.array(
            [g for g in range(model.ngeom) if model.geom_bodyid[g] in foot_ids and model.geom_conaffinity[g]]
        ),
        arrays=arrays,
    )


def read_spec(name: str, robots_dir: Path = ROBOTS_DIR) -> mujoco.MjSpec:
    """A robot's MJCF as it is in its folder, with the shapes that are only seen.

    Raises:
        InputError: unknown robot, or no such file.
    """
    path = roles_file(name, robots_dir)
    file = path.parent / _read_roles(path)["model"]
    if not file.is_file():
        raise InputError(f"{path}: model: no file '{file.name}'")
    return mujoco.MjSpec.from_file(str(file))


def relative_height(model: mujoco.MjModel) -> float:
    """How tall a robot is beside the G1, by the height of its root in its MJCF: what views of it scale by."""
    return float(model.body_pos[1, 2]) / G1_ROOT_HEIGHT


def relative_mass(model: mujoco.MjModel) -> float:
    """How heavy a robot is beside the G1, to six digits."""
    return round(float(model.body_subtreemass[1]) / G1_MASS, 6)


def _read_roles(path: Path) -> dict[str, Any]:
    try:
        roles = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise InputError(f"{path}: not YAML: {' '.join(str(error).split())}") from None
    required = ["model", "anchor", "key_bodies", "end_effectors", "feet", "natural_frequency_hz", "damping_ratio"]
    required += ["soft_limit_factor", "default_height", "motors", "joint_motors", "default_pose"]
    for field in required:
        if not isinstance(roles, dict) or field not in roles:
            raise InputError(f"{path}: missing field '{field}'")
    for name, motor in roles["motors"].items():
        for field in ("armature", "effort", "velocity"):
            if field not in motor:
                raise InputError(f"{path}: motors: {name}: missing '{field}'")
    return roles


def _motor_of(joint: str, roles: dict[str, Any], path: Path) -> dict[str, float]:
    for pattern, motor in roles["joint_motors"]:
        if re.fullmatch(pattern, joint):
            if motor not in roles["motors"]:
                raise InputError(f"{path}: joint_motors: no motor '{motor}'; {nearest(motor, roles['motors'])}")
            return roles["motors"][motor]
    raise InputError(f"{path}: joint_motors: no pattern matches joint '{joint}'")


def _whole_body_inertia(model: mujoco.MjModel, joint_pos: np.ndarray) -> np.ndarray:
    """Inertia [3, 3] kg m^2 of the whole robot about its centre of mass, in the root's frame."""
    data = mujoco.MjData(model)
    data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    data.qpos[7:] = joint_pos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    com = data.subtree_com[1]
    total = np.zeros((3, 3))
    for body in range(1, model.nbody):
        rotation = data.ximat[body].reshape(3, 3)
        offset = data.xipos[body] - com
        total += rotation @ np.diag(model.body_inertia[body]) @ rotation.T
        total += model.body_mass[body] * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    return total
