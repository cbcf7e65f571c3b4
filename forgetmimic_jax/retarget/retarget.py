"""Retarget a human motion to a robot: every limb points the way the human's does, at the robot's own size.

Lengths scale by the ratio of the legs. First inverse kinematics frame by frame (mink) here.
"""

from __future__ import annotations

from dataclasses import dataclass

import mink
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from forgetmimic_jax.motion.kinematics import quaternion
from forgetmimic_jax.retarget.deepmimic import LEG_LENGTH, HumanPose
from forgetmimic_jax.retarget.timeline import cross_matrix
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.robot.sides import SIDES

LIMBS = {  # human limb: the robot's pairs at its two ends
    "thigh": ("hips", "knees"),
    "shin": ("knees", "feet"),
    "upper_arm": ("shoulders", "elbows"),
    "forearm": ("elbows", "hands"),
}
HINGES = {"thigh": "knees", "upper_arm": "elbows"}  # human limb: the pair of bodies whose y axis is the hinge below it
LIMIT_MARGIN = 0.02  # rad


@dataclass(frozen=True)
class Vector:
    """A unit vector of the robot to point along a goal: from the origin of `start` to `end`, or `end`'s y axis."""

    start: int | None
    end: int
    goal: np.ndarray  # [frame, 3] world
    cost: float

    def value(self, data: mujoco.MjData) -> np.ndarray:
        if self.start is None:
            return data.xmat[self.end].reshape(3, 3)[:, 1].copy()
        along = data.xpos[self.end] - data.xpos[self.start]
        return along / np.linalg.norm(along)

    def jacobian(self, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
        """[3, nv] of `value`."""
        end = np.zeros((3, model.nv))
        if self.start is None:
            mujoco.mj_jacBody(model, data, None, end, self.end)
            return -cross_matrix(self.value(data)) @ end
        start = np.zeros((3, model.nv))
        mujoco.mj_jacBody(model, data, end, None, self.end)
        mujoco.mj_jacBody(model, data, start, None, self.start)
        along = data.xpos[self.end] - data.xpos[self.start]
        length = np.linalg.norm(along)
        unit = along / length
        return (np.eye(3) - np.outer(unit, unit)) @ (end - start) / length


@dataclass(frozen=True)
class Orientation:
    """A body and the orientation it is to have."""

    body: int
    goal: Rotation  # [frame]
    cost: float


@dataclass(frozen=True)
class Goals:
    """What the robot is to do, [frame, ...], world frame."""

    hip_bodies: tuple[int, int]
    hip_centre: np.ndarray  # [frame, 3] m, midpoint of the hip bodies
    orientations: tuple[Orientation, ...]
    vectors: tuple[Vector, ...]

    @property
    def num_frames(self) -> int:
        return len(self.hip_centre)


def leg_scale(robot: Robot) -> float:
    """Robot's leg length, hip to sole, over the human's."""
    data = mujoco.MjData(robot.model)
    mujoco.mj_kinematics(robot.model, data)
    hip, knee, foot = (data.xpos[pair[0]] for pair in (robot.pairs.hips, robot.pairs.knees, robot.pairs.feet))
    sole = min(data.geom_xpos[geom][2] - robot.model.geom_size[geom][0] for geom in robot.foot_geom_ids)
    return (np.linalg.norm(knee - hip) + np.linalg.norm(foot - knee) + foot[2] - sole) / LEG_LENGTH


def make_goals(robot: Robot, pose: HumanPose) -> Goals:
    """Directions from the human's limbs; the hips' path scaled by the legs' ratio."""
    orientations = [
        Orientation(int(robot.key_body_ids[robot.root]), pose.frames["pelvis"], 1.0),
        Orientation(robot.anchor_body_id, pose.frames["chest"], 0.5),
    ]
    vectors = []
    for row, side in enumerate(SIDES):
        body = {role: pair[row] for role, pair in vars(robot.pairs).items()}
        orientations.append(Orientation(body["feet"], pose.frames[f"{side}_foot"], 0.3))
        for limb, (start, end) in LIMBS.items():
            goal = pose.frames[f"{side}_{limb}"].apply([0.0, 0.0, -1.0])
            vectors.append(Vector(body[start], body[end], goal, 1.0))
        for limb, role in HINGES.items():
            axis = pose.frames[f"{side}_{limb}"].apply([0.0, 1.0, 0.0])
            vectors.append(Vector(None, body[role], axis, 0.15))
    hip_centre = pose.points["pelvis"] * leg_scale(robot)
    return Goals(robot.pairs.hips, hip_centre, tuple(orientations), tuple(vectors))


class VectorTask(mink.Task):
    """mink's view of a `Vector`."""

    def __init__(self, vector: Vector):
        super().__init__(cost=np.full(3, vector.cost))
        self.vector = vector
        self.frame = 0

    def compute_error(self, configuration: mink.Configuration) -> np.ndarray:
        return self.vector.value(configuration.data) - self.vector.goal[self.frame]

    def compute_jacobian(self, configuration: mink.Configuration) -> np.ndarray:
        return self.vector.jacobian(configuration.model, configuration.data)


def inverse_kinematics(robot: Robot, goals: Goals) -> np.ndarray:
    """Frame by frame, each started from the one before: qpos [frame, 7 + joint]."""
    model = robot.model
    hip_offset = _hip_centre_offset(robot)
    base = goals.orientations[0]
    base_pos = goals.hip_centre - base.goal.apply(hip_offset)
    base_quat = quaternion(base.goal)

    frame_tasks = [
        mink.FrameTask(orientation.body, "body", 2.0 if orientation is base else 0.0, orientation.cost)
        for orientation in goals.orientations
    ]
    vector_tasks = [VectorTask(vector) for vector in goals.vectors]
    rest = np.concatenate([base_pos[0], base_quat[0], np.asarray(robot.arrays.default_joint_pos, np.float64)])
    posture = mink.PostureTask(model, cost=0.03)
    posture.set_target(rest)
    limits = [mink.ConfigurationLimit(model, min_distance_from_limits=LIMIT_MARGIN)]

    configuration = mink.Configuration(model, rest)
    qpos = np.empty((goals.num_frames, model.nq))
    for frame in range(goals.num_frames):
        for task, orientation in zip(frame_tasks, goals.orientations, strict=True):
            turn = mink.SO3(orientation.goal[frame].as_quat(scalar_first=True))
            task.set_target(mink.SE3.from_rotation_and_translation(turn, base_pos[frame]))
        for vector_task in vector_tasks:
            vector_task.frame = frame
        for _ in range(100 if frame == 0 else 8):
            velocity = mink.solve_ik(
                configuration, [*frame_tasks, *vector_tasks, posture], 1.0, "daqp", damping=1e-3, limits=limits
            )
            configuration.integrate_inplace(velocity, 1.0)
        qpos[frame] = configuration.q
    return qpos


def _hip_centre_offset(robot: Robot) -> np.ndarray:
    """Midpoint of the hips in the base's frame [3] m, default pose."""
    data = mujoco.MjData(robot.model)
    data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    data.qpos[7:] = 0.0
    mujoco.mj_kinematics(robot.model, data)
    return np.mean(data.xpos[list(robot.pairs.hips)], axis=0)
