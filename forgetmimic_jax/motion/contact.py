"""Where the floor is touched: the human's contacts and flight, and the robot's shapes above the floor."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from forgetmimic_jax.motion.deepmimic import CHEST_HEIGHT, HumanPose
from forgetmimic_jax.motion.kinematics import rate
from forgetmimic_jax.robot.model import Robot

SIDES = ("left", "right")
# A recorded sole in stance drifts up to 5 cm off the floor and creeps; between the two values the weight falls to 0.
SOLE_HEIGHT = (0.05, 0.09)  # m
OTHER_HEIGHT = (0.03, 0.08)  # m, of the other parts' surfaces
CONTACT_SPEED = (0.3, 0.6)  # m/s, above which a part slips
# A low sole pivots and drifts in the recording while it carries the body (in a crouch, in a turn); a swing is faster.
SWING_SPEED = (1.2, 2.4)  # m/s
SLIDING = 0.5  # of the weight against slipping, for a low sole that slips in the recording
# Soles carry and must hold exactly; hands carry at times; what else touches the floor does so roughly.
SOLE_WEIGHT, HAND_WEIGHT, OTHER_WEIGHT = 1.0, 0.5, 0.2
FLIGHT_CLEARANCE = 0.06  # m: with every part above it the human touches nothing
# DeepMimic's shapes: radii, and the spheres' heights above the root, the chest and the chest again, m.
PELVIS_RADIUS, PELVIS_OFFSET = 0.09, 0.07
CHEST_RADIUS, CHEST_OFFSET = 0.11, 0.12
HEAD_RADIUS, HEAD_OFFSET = 0.1025, 0.223894 + 0.175
HAND_RADIUS, KNEE_RADIUS, ELBOW_RADIUS = 0.04, 0.05, 0.045


@dataclass(frozen=True)
class HumanContact:
    """Contacts and flight of a human motion."""

    down: dict[str, np.ndarray]  # by part, [frame]: 0 free to 1 on the floor
    planted: dict[str, np.ndarray]  # the same where it does not slip either
    lifted: dict[str, np.ndarray]  # by part of the soles, [frame]: 1 where it moves too fast to touch the floor
    flight: np.ndarray  # bool[frame]


def human_contact(pose: HumanPose, fps: float) -> HumanContact:
    """Read contacts from the height and speed of the body's parts; flight from nothing being near the floor."""
    down, planted, lifted, heights = {}, {}, {}, []
    for part, (point, radius) in _human_parts(pose).items():
        speed = np.linalg.norm(rate(point, fps), axis=-1)
        height = point[:, 2] - radius
        sole = part.endswith(("toe", "heel"))
        weight = SOLE_WEIGHT if sole else HAND_WEIGHT if part.endswith("hand") else OTHER_WEIGHT
        near = weight * _fade(height, SOLE_HEIGHT if sole else OTHER_HEIGHT)
        planted[part] = down[part] = near * _fade(speed, CONTACT_SPEED)
        if sole:
            down[part] = near * _fade(speed, SWING_SPEED)
            planted[part] = SLIDING * down[part] + (1 - SLIDING) * planted[part]
            lifted[part] = 1.0 - _fade(speed, SWING_SPEED)
        heights.append(height)
    return HumanContact(down, planted, lifted, np.min(heights, axis=0) > FLIGHT_CLEARANCE)


def _human_parts(pose: HumanPose) -> dict[str, tuple[np.ndarray, float]]:
    """Centre [frame, 3] and radius, m, of every part of the human that may touch the floor."""
    up = np.array([0.0, 0.0, 1.0])
    root, chest = pose.frames["pelvis"], pose.frames["chest"]
    chest_pos = pose.points["pelvis"] + root.apply(CHEST_HEIGHT * up)
    parts = {
        "pelvis": (pose.points["pelvis"] + root.apply(PELVIS_OFFSET * up), PELVIS_RADIUS),
        "torso": (chest_pos + chest.apply(CHEST_OFFSET * up), CHEST_RADIUS),
        "head": (chest_pos + chest.apply(HEAD_OFFSET * up), HEAD_RADIUS),
    }
    for side in SIDES:
        sole = pose.points[f"{side}_sole"]
        parts[f"{side}_toe"] = (sole[:, :2].mean(axis=1), 0.0)
        parts[f"{side}_heel"] = (sole[:, 2:].mean(axis=1), 0.0)
        parts[f"{side}_hand"] = (pose.points[f"{side}_wrist"], HAND_RADIUS)
        parts[f"{side}_knee"] = (pose.points[f"{side}_knee"], KNEE_RADIUS)
        parts[f"{side}_elbow"] = (pose.points[f"{side}_elbow"], ELBOW_RADIUS)
    return parts


def _fade(value: np.ndarray, bounds: tuple[float, float]) -> np.ndarray:
    """1 below the first bound, 0 above the second, linear between."""
    low, high = bounds
    return np.clip((high - value) / (high - low), 0.0, 1.0)


JOINT_DISTANCE = 0.05  # m: a shin's or forearm's end this close to its joint is the knee or elbow


@dataclass(frozen=True)
class FloorPoints:
    """Points of the robot's shapes that can touch the floor first: the centres of spheres, the ends of capsules."""

    body: np.ndarray  # [point] body ids
    local: np.ndarray  # [point, 3] m in the body's frame
    radius: np.ndarray  # [point] m
    part: tuple[str, ...]  # [point] as in HumanContact, or '' for a point without a human counterpart
    geom: tuple[str, ...]  # [point] names of the shapes

    @property
    def is_sole(self) -> np.ndarray:
        return np.array([part.endswith(("toe", "heel")) for part in self.part])

    def foot(self, side: str) -> np.ndarray:
        """Rows of one foot's sole."""
        return np.flatnonzero([part in (f"{side}_toe", f"{side}_heel") for part in self.part])


def floor_points(robot: Robot) -> FloorPoints:
    """The floor points of every shape that collides."""
    model = robot.model
    rows = []
    for geom in range(model.ngeom):
        if not model.geom_conaffinity[geom] or model.geom_bodyid[geom] == 0:
            continue
        pos, turn = model.geom_pos[geom], _matrix(model.geom_quat[geom])
        size, kind = model.geom_size[geom], model.geom_type[geom]
        if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            ends, radius = [pos], size[0]
        elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            ends, radius = [pos + turn @ [0, 0, sign * size[1]] for sign in (1, -1)], size[0]
        elif kind == mujoco.mjtGeom.mjGEOM_BOX:
            signs = np.array(np.meshgrid([1, -1], [1, -1], [1, -1])).reshape(3, -1).T
            ends, radius = [pos + turn @ (sign * size) for sign in signs], 0.0
        else:
            raise ValueError(f"robot {robot.name}: shape {model.geom(geom).name} is no sphere, capsule or box")
        rows += [(geom, int(model.geom_bodyid[geom]), end, radius) for end in ends]

    soles = set(robot.foot_geom_ids.tolist())
    middle = float(np.mean([end[0] for geom, _, end, _ in rows if geom in soles]))
    parts = [_part(robot, geom, end, geom in soles, middle) for geom, _, end, _ in rows]
    return FloorPoints(
        body=np.array([row[1] for row in rows]),
        local=np.array([row[2] for row in rows]),
        radius=np.array([row[3] for row in rows]),
        part=tuple(parts),
        geom=tuple(model.geom(row[0]).name for row in rows),
    )


def _part(robot: Robot, geom: int, end: np.ndarray, sole: bool, sole_middle: float) -> str:
    """The human part that a robot's floor point stands for; '' where there is none."""
    body = robot.model.body(robot.model.geom_bodyid[geom]).name
    side = next((side for side in SIDES if body.startswith(side)), "")
    if sole:
        return f"{side}_{'toe' if end[0] > sole_middle else 'heel'}"
    if body == robot.key_bodies[robot.root]:
        return "pelvis"
    if body == robot.key_bodies[robot.anchor]:
        return "head" if "head" in robot.model.geom(geom).name else "torso"
    if body == f"{side}_wrist_yaw_link":
        return f"{side}_hand"
    at_joint = np.linalg.norm(end) < JOINT_DISTANCE
    return next((f"{side}_{joint}" for joint in ("knee", "elbow") if at_joint and body == f"{side}_{joint}_link"), "")


def floor_positions(robot: Robot, points: FloorPoints, qpos: np.ndarray) -> np.ndarray:
    """Lowest position of every floor point [frame, point, 3] m, world frame; z is its height above the floor."""
    data = mujoco.MjData(robot.model)
    positions = np.empty((len(qpos), len(points.body), 3))
    for frame, configuration in enumerate(qpos):
        data.qpos[:] = configuration
        mujoco.mj_kinematics(robot.model, data)
        turns = data.xmat[points.body].reshape(-1, 3, 3)
        positions[frame] = data.xpos[points.body] + np.einsum("pij,pj->pi", turns, points.local)
    positions[..., 2] -= points.radius
    return positions


def _matrix(quat: np.ndarray) -> np.ndarray:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)
