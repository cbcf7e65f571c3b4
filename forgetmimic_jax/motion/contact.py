"""Where the floor is touched: the human's stance and flight, and the robot's shapes above the floor."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from forgetmimic_jax.motion.deepmimic import HumanPose
from forgetmimic_jax.motion.kinematics import rate
from forgetmimic_jax.robot import Robot

SIDES = ("left", "right")
# A recorded sole in stance drifts up to 5 cm off the floor and creeps; between the two values the weight falls to 0.
STANCE_HEIGHT = (0.05, 0.09)  # m
STANCE_SPEED = (0.3, 0.6)  # m/s
FLIGHT_SOLE, FLIGHT_WRIST, FLIGHT_PELVIS = 0.06, 0.15, 0.4  # m: above all three the human touches nothing


@dataclass(frozen=True)
class HumanContact:
    """Stance and flight of a human motion."""

    stance: dict[str, np.ndarray]  # {side}_{toe,heel} [frame], 0 free to 1 planted
    flight: np.ndarray  # bool[frame]


def human_contact(pose: HumanPose, fps: float) -> HumanContact:
    """Read stance from the soles' height and speed; flight from nothing being near the floor."""
    stance, lowest = {}, []
    for side in SIDES:
        sole = pose.points[f"{side}_sole"]
        for part, corners in (("toe", (0, 1)), ("heel", (2, 3))):
            point = sole[:, corners].mean(axis=1)
            speed = np.linalg.norm(rate(point, fps), axis=-1)
            stance[f"{side}_{part}"] = _fade(point[:, 2], STANCE_HEIGHT) * _fade(speed, STANCE_SPEED)
        lowest.append(sole[..., 2].min(axis=1))
    wrists = np.minimum(pose.points["left_wrist"][:, 2], pose.points["right_wrist"][:, 2])
    flight = (np.min(lowest, axis=0) > FLIGHT_SOLE) & (wrists > FLIGHT_WRIST)
    return HumanContact(stance, flight & (pose.points["pelvis"][:, 2] > FLIGHT_PELVIS))


def _fade(value: np.ndarray, bounds: tuple[float, float]) -> np.ndarray:
    """1 below the first bound, 0 above the second, linear between."""
    low, high = bounds
    return np.clip((high - value) / (high - low), 0.0, 1.0)


@dataclass(frozen=True)
class FloorPoints:
    """Points of the robot's shapes that can touch the floor first: the centres of spheres, the ends of capsules."""

    body: np.ndarray  # [point] body ids
    local: np.ndarray  # [point, 3] m in the body's frame
    radius: np.ndarray  # [point] m
    sole: tuple[str, ...]  # [point] {side}_{toe,heel}, or '' for a point that is not on a sole
    geom: tuple[str, ...]  # [point] names of the shapes

    @property
    def is_sole(self) -> np.ndarray:
        return np.array([bool(name) for name in self.sole])

    def foot(self, side: str) -> np.ndarray:
        """Rows of one foot's sole."""
        return np.array([row for row, name in enumerate(self.sole) if name.startswith(side)])


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
    middle = np.mean([end[0] for geom, _, end, _ in rows if geom in soles])
    names = []
    for geom, body, end, _ in rows:
        side = next((side for side in SIDES if model.body(body).name.startswith(side)), "")
        names.append(f"{side}_{'toe' if end[0] > middle else 'heel'}" if geom in soles else "")
    return FloorPoints(
        body=np.array([row[1] for row in rows]),
        local=np.array([row[2] for row in rows]),
        radius=np.array([row[3] for row in rows]),
        sole=tuple(names),
        geom=tuple(model.geom(row[0]).name for row in rows),
    )


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
