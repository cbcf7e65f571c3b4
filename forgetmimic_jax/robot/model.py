"""A robot: its MJCF and its roles, resolved by name into a MuJoCo model and arrays.

Every order (joints, bodies) is the model's own, looked up by name, never by position.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jax import Array

from forgetmimic_jax.basics.errors import InputError, nearest
from forgetmimic_jax.basics.places import shipped
from forgetmimic_jax.robot.check import FLOOR
from forgetmimic_jax.robot.roles import Roles, read_roles
from forgetmimic_jax.robot.sides import Pairs, body_ids, counterparts, sides_of_bodies
from forgetmimic_jax.robot.vendor import compiled
from forgetmimic_jax.settings.config import ActionConfig, PhysicsConfig

ROBOTS_DIR = shipped("robots")
CONTACT_SENSOR, HEAD_SENSOR = "contact_", "head_contact_"
VISUAL_GROUP = 2  # the geom group of the shapes that are only seen
G1_ROOT_HEIGHT = 0.793  # m, of the G1's pelvis in its MJCF


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
    policy_joints: np.ndarray  # [joint] index of each joint of the policy's order
    joint_velocity_limit: np.ndarray  # [joint] rad/s, the motor's no-load speed
    joint_lower: np.ndarray  # [joint] rad
    joint_upper: np.ndarray  # [joint] rad
    motor_counts: np.ndarray  # bool[joint]: the motor's load counts when a clip is judged
    counterpart: np.ndarray  # [joint] place of the other side's joint, or the joint's own
    variants: Mapping[str, tuple[str, ...]]  # the joints that a variant of the robot lacks, by its name
    default_height: float  # root height of the default pose, m
    key_bodies: tuple[str, ...]
    key_body_ids: np.ndarray  # [key_body] rows of the model's bodies
    anchor: int  # index into key_bodies
    root: int  # index into key_bodies of the floating base
    end_effectors: np.ndarray  # indices into key_bodies
    feet: np.ndarray  # indices into key_bodies: left, right
    anchor_body_id: int
    pairs: Pairs[int]  # body ids
    body_sides: tuple[str, ...]  # of every body of the model: 'left', 'right' or ''
    foot_geom_ids: np.ndarray
    head_geom_ids: np.ndarray
    arrays: RobotArrays

    @property
    def num_joints(self) -> int:
        return len(self.joint_names)

    @property
    def policy_joint_names(self) -> tuple[str, ...]:
        """The joints in the order of a policy's inputs and outputs."""
        return tuple(self.joint_names[joint] for joint in self.policy_joints)

    def beyond(self, joint_pos: np.ndarray) -> np.ndarray:
        """How far joint angles [..., joint] are beyond the joints' ranges, rad; below 0 inside them."""
        return np.maximum(joint_pos - self.joint_upper, self.joint_lower - joint_pos)

    @property
    def weight(self) -> float:
        """Of the whole robot, N."""
        return float(self.model.body_subtreemass[1]) * 9.81


@dataclass(frozen=True)
class Drive:
    """One joint's motor and PD gains."""

    joint: str
    armature: float  # kg m^2
    effort: float  # N m
    velocity: float  # rad/s
    stiffness: float  # kp, N m/rad
    damping: float  # kd, N m s/rad
    action_scale: float  # rad per unit of action
    default: float  # rad, of the default pose


def with_every_contact(robot: Robot) -> Robot:
    """The same robot whose shapes touch each other, with contact sensors on all bodies with a shape, and on the head.

    Training needs none of this, since its episodes end before a robot lies on the floor.
    """
    spec, model = robot.spec.copy(), robot.model
    _let_shapes_touch(spec)
    sensors = {model.sensor(sensor).name for sensor in range(model.nsensor)}
    for body in touching_bodies(robot):
        if CONTACT_SENSOR + body not in sensors:
            _add_contact_sensor(spec, CONTACT_SENSOR, mujoco.mjtObj.mjOBJ_BODY, body)
    for shape in robot.head_geom_ids:
        _add_contact_sensor(spec, HEAD_SENSOR, mujoco.mjtObj.mjOBJ_GEOM, model.geom(shape).name)
    return dataclasses.replace(robot, spec=spec, model=spec.compile())


def touching_bodies(robot: Robot) -> list[str]:
    """Names of the bodies with a shape that can touch the floor."""
    model = robot.model
    return [model.body(body).name for body in np.unique(model.geom_bodyid[model.geom_conaffinity > 0])]


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
    physics: PhysicsConfig | None = None,
    action: ActionConfig | None = None,
    robots_dir: Path = ROBOTS_DIR,
) -> Robot:
    """Compile a robot from `robots/NAME/`.

    Args:
        name: folder under robots/.
        physics: the physics step, the solver's limits and whether the robot's shapes touch each other; the default
            settings where none are given.
        action: what a policy expects of the robot in place of the robot's own.
        robots_dir: folder of the robots.

    Raises:
        InputError: unknown robot, roles that are wrong or do not fit the MJCF, or a joint in `action` that is not the
            robot's.
    """
    roles, spec = read_roles(roles_file(name, robots_dir))
    joints = [joint.name for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_HINGE]
    action = action or ActionConfig()
    policy_joints = _policy_joints(action, name, joints)
    drives = [_drive(roles, action, joint) for joint in joints]
    _set_physics(spec, physics or PhysicsConfig())
    _add_motors(spec, drives)
    for body in roles.key_bodies:
        _add_contact_sensor(spec, CONTACT_SENSOR, mujoco.mjtObj.mjOBJ_BODY, body)
    return _resolved(name, roles, spec, drives, policy_joints)


def read_spec(name: str, robots_dir: Path = ROBOTS_DIR) -> mujoco.MjSpec:
    """A robot's MJCF, mended where it is a vendor's, with the shapes that are only seen.

    Raises:
        InputError: unknown robot, or roles that are wrong or do not fit the MJCF.
    """
    return read_roles(roles_file(name, robots_dir))[1]


def relative_height(model: mujoco.MjModel) -> float:
    """How tall a robot is beside the G1, by the height of its root in its MJCF: what views of it scale by."""
    return float(model.body_pos[1, 2]) / G1_ROOT_HEIGHT


def _policy_joints(action: ActionConfig, robot: str, joint_names: Sequence[str]) -> np.ndarray:
    """Index of each joint of the policy's order; InputError for a joint that is not the robot's, or not there."""
    for field, table in vars(action).items():
        for joint in table if isinstance(table, dict) else ():
            if joint not in joint_names:
                raise InputError(f"action.{field}: no joint '{joint}' in {robot}; {nearest(joint, joint_names)}")
    order = action.joint_order or joint_names
    if sorted(order) != sorted(joint_names):
        unknown, missing = set(order) - set(joint_names), set(joint_names) - set(order)
        raise InputError(
            f"action.joint_order: found {len(order)} joints (unknown: {', '.join(sorted(unknown)) or 'none'}; missing: "
            f"{', '.join(sorted(missing)) or 'none'}); the {len(joint_names)} of {robot} are needed, each once"
        )
    return np.array([joint_names.index(joint) for joint in order])


def _drive(roles: Roles, action: ActionConfig, joint: str) -> Drive:
    """The PD gains follow from the motor's armature by a natural frequency and a damping ratio.

    What `action` has of the joint takes the place of these.
    """
    motor, omega = roles.motor_of(joint), 2.0 * np.pi * roles.natural_frequency_hz
    stiffness = motor.armature * omega**2
    damping = 2.0 * roles.damping_ratio * motor.armature * omega
    return Drive(
        joint,
        armature=action.armature.get(joint, motor.armature),
        effort=motor.effort,
        velocity=motor.velocity,
        stiffness=action.stiffness.get(joint, stiffness),
        damping=action.damping.get(joint, damping),
        action_scale=action.scale.get(joint, 0.25 * motor.effort / stiffness),
        default=action.default_pose.get(joint, roles.default_pose.get(joint, 0.0)),
    )


def _set_physics(spec: mujoco.MjSpec, physics: PhysicsConfig) -> None:
    spec.compiler.discardvisual = True  # shapes that are only seen would cost every step a little
    spec.option.timestep = physics.timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.iterations = physics.solver_iterations
    spec.option.ls_iterations = physics.line_search_iterations
    # Euler's own damping term is unused by implicitfast; MJX reads the flag.
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    if physics.self_collision:
        _let_shapes_touch(spec)


def _add_motors(spec: mujoco.MjSpec, drives: Sequence[Drive]) -> None:
    """A position servo for every joint, in the joints' order."""
    for drive in drives:
        spec.joint(drive.joint).armature = drive.armature
        actuator = spec.add_actuator(name=drive.joint, target=drive.joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=drive.stiffness, kv=drive.damping)
        actuator.forcerange = [-drive.effort, drive.effort]
        actuator.forcelimited = True


def _let_shapes_touch(spec: mujoco.MjSpec) -> None:
    """The robot's shapes touch each other too, but for the pairs that its MJCF excludes."""
    for geom in spec.geoms:
        if geom.name != FLOOR and geom.conaffinity:
            geom.contype = 1


def _add_contact_sensor(spec: mujoco.MjSpec, prefix: str, kind: mujoco.mjtObj, name: str) -> None:
    """The net force between a body or a shape and the floor."""
    sensor = spec.add_sensor(name=prefix + name, type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=kind, objname=name)
    sensor.refname, sensor.reftype = FLOOR, mujoco.mjtObj.mjOBJ_GEOM
    sensor.intprm[:3] = [1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 3, 1]  # data, reduce=netforce, num


def _resolved(
    name: str, roles: Roles, spec: mujoco.MjSpec, drives: Sequence[Drive], policy_joints: np.ndarray
) -> Robot:
    """The roles as indices into the compiled model."""
    model, _ = compiled(spec)
    key_bodies, joint_names = roles.key_bodies, tuple(drive.joint for drive in drives)
    root = model.body(1).name
    pairs = body_ids(model, roles.pairs)
    counterpart_ids = counterparts(model, pairs)
    lower, upper = model.jnt_range[1:].T
    centre, half = 0.5 * (lower + upper), 0.5 * (upper - lower) * roles.soft_limit_factor
    default = np.array([drive.default for drive in drives])
    collides = [geom for geom in range(model.ngeom) if model.geom_conaffinity[geom]]
    arrays = RobotArrays(
        stiffness=jnp.asarray([drive.stiffness for drive in drives], jnp.float32),
        damping=jnp.asarray([drive.damping for drive in drives], jnp.float32),
        effort=jnp.asarray([drive.effort for drive in drives], jnp.float32),
        action_scale=jnp.asarray([drive.action_scale for drive in drives], jnp.float32),
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
        policy_joints=policy_joints,
        joint_velocity_limit=np.array([drive.velocity for drive in drives]),
        joint_lower=lower,
        joint_upper=upper,
        motor_counts=np.array([roles.counts_motor_of(joint) for joint in joint_names]),
        counterpart=np.array([counterpart_ids.get(joint, joint) - 1 for joint in range(1, model.njnt)]),
        variants={
            name: tuple(joint for joint in joint_names if any(re.fullmatch(pattern, joint) for pattern in patterns))
            for name, patterns in roles.variants.items()
        },
        default_height=roles.default_height,
        key_bodies=key_bodies,
        key_body_ids=np.array([model.body(body).id for body in key_bodies]),
        anchor=key_bodies.index(roles.anchor),
        root=key_bodies.index(root),
        end_effectors=np.array([key_bodies.index(body) for body in roles.end_effectors]),
        feet=np.array([key_bodies.index(body) for body in roles.pairs.feet]),
        anchor_body_id=model.body(roles.anchor).id,
        pairs=pairs,
        body_sides=sides_of_bodies(model, pairs),
        foot_geom_ids=np.array([geom for geom in collides if model.geom_bodyid[geom] in pairs.feet]),
        head_geom_ids=np.array([model.geom(shape).id for shape in roles.head], int),
        arrays=arrays,
    )


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
