"""Where the human touches the floor, where it flies, and which points of the robot stand for which of its parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from forgetmimic_jax.motion.contact import FloorPoints, floor_positions
from forgetmimic_jax.motion.kinematics import rate
from forgetmimic_jax.retarget.deepmimic import CHEST_HEIGHT, HumanPose
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.robot.sides import SIDES

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


def human_parts(robot: Robot, points: FloorPoints) -> tuple[str, ...]:
    """The human part that each floor point of the robot stands for, as in `HumanContact`; '' where there is none."""
    sole_middle = float(points.local[points.is_sole, 0].mean())
    upright = np.zeros((1, robot.model.nq))
    upright[0, 3] = 1.0
    tops = floor_positions(robot, points, upright)[0, :, 2] + 2.0 * points.radius
    head = points.geom[np.argmax(tops)]
    root, anchor = int(robot.key_body_ids[robot.root]), robot.anchor_body_id

    def part(point: int) -> str:
        body, side = int(points.body[point]), robot.body_sides[points.body[point]]
        if points.is_sole[point]:
            return f"{side}_{'toe' if points.local[point, 0] > sole_middle else 'heel'}"
        if points.geom[point] == head:
            return "head"
        if body in (root, anchor):
            return "pelvis" if body == root else "torso"
        if body in robot.pairs.hands:
            return f"{side}_hand"
        at_joint = bool(np.linalg.norm(points.local[point]) < JOINT_DISTANCE)
        joints = {"knee": robot.pairs.knees, "elbow": robot.pairs.elbows}
        return next((f"{side}_{joint}" for joint, bodies in joints.items() if at_joint and body in bodies), "")

    return tuple(part(point) for point in range(len(points.body)))
