"""Refine a whole retargeted clip at once: planted soles, possible accelerations, no jitter, nothing under the floor.

One non-linear least-squares problem over all frames, solved by Gauss-Newton. The unknowns are the frames' tangent
steps (MuJoCo's nv: root linear in the world, root angular in the root's frame, joints). A cyclic clip wraps around:
frame n is frame 0 moved by the cycle's planar step.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from forgetmimic_jax.motion.contact import FloorPoints, floor_points
from forgetmimic_jax.motion.kinematics import rotation
from forgetmimic_jax.retarget.contact import HumanContact, human_parts
from forgetmimic_jax.retarget.dynamics import floor_wrench, motor_torque
from forgetmimic_jax.retarget.least_squares import Residuals, gauss_newton
from forgetmimic_jax.retarget.pose import Pose, pose_of
from forgetmimic_jax.retarget.retarget import Goals
from forgetmimic_jax.retarget.timeline import Timeline, cross_matrix
from forgetmimic_jax.robot.model import Robot

SEAM_SECONDS = 0.12  # half width of the more smoothed seam
TORQUE_SHARE = 0.8  # of the motors' limits; the rest is for balance
SPEED_SHARE = 0.8  # of the motors' speed
LIMIT_MARGIN = 0.02  # rad kept from every joint's limit
GENTLE = 0.25  # of the dynamics' weight, in a first round


@dataclass(frozen=True)
class Weights:
    """Weight of each residual; a residual of 1 over its weight counts as one radian of limb direction."""

    hip_centre: float = 0.5  # per m
    posture: float = 0.03  # per rad from the default pose
    wrist_posture: float = 0.2  # the same where the motor does not count: wrists, which the human skeleton lacks
    stance_height: float = 40.0  # per m that a sole point which is down is off the floor
    stance_slip: float = 150.0  # per m a planted sole point moves in one frame
    floor: float = 60.0  # per m below the floor, or below the clearance of a sole that swings
    wrench: float = 0.2  # per m/s^2 of acceleration that the floor cannot provide
    torque: float = 3.0  # per torque limit that a motor lacks
    limit: float = 20.0  # per rad beyond the joint's limit less its margin
    speed: float = 0.3  # per rad/s beyond the share of the motor's speed
    smooth_hz: float = 6.0  # jerk is weighed so that motion faster than this is smoothed away
    seam: float = 5.0  # times more where cycles meet, since a recording may stop one motion there and start another
    clearance: float = 0.02  # m that a swinging sole keeps above the floor

    def with_dynamics(self, share: float) -> Weights:
        """The same with a share of what the dynamics weigh."""
        return dataclasses.replace(self, wrench=share * self.wrench, torque=share * self.torque)


def refine(
    robot: Robot,
    goals: Goals,
    contact: HumanContact,
    qpos: np.ndarray,
    timeline: Timeline,
    iterations: int = 150,
) -> np.ndarray:
    """Improve qpos [frame, 7 + joint].

    Args:
        robot: the robot.
        goals: limb directions, orientations and the hips' path.
        contact: when soles are planted and when the body flies.
        qpos: where to start, from inverse kinematics.
        timeline: of the frames; a cyclic clip's step is at the robot's scale.
        iterations: Gauss-Newton steps a round.
    """
    weights = Weights()
    gentle = Problem.of(robot, goals, contact, timeline, weights.with_dynamics(GENTLE))
    strict = Problem.of(robot, goals, contact, timeline, weights)

    def solved(problem: Problem, start: np.ndarray) -> tuple[np.ndarray, float]:
        return gauss_newton(problem.terms, problem.moved, start, robot.model.nv, timeline.cyclic, iterations)

    # What the floor answers has kinks, in which the search may stick. Which way around them is better depends on the
    # clip: at once, or from a motion that the dynamics bent less.
    best, _ = min((solved(strict, start) for start in (qpos, solved(gentle, qpos)[0])), key=lambda found: found[1])
    return np.concatenate([best[:, :7], np.clip(best[:, 7:], *strict.bounds)], axis=-1)


@dataclass(frozen=True)
class Problem:
    """The residuals of a clip."""

    robot: Robot
    goals: Goals
    contact: HumanContact
    timeline: Timeline
    weights: Weights
    floor: FloorPoints
    parts: tuple[str, ...]  # the human's, that the floor points stand for

    @classmethod
    def of(cls, robot: Robot, goals: Goals, contact: HumanContact, timeline: Timeline, weights: Weights) -> Problem:
        """The problem with the robot's floor points."""
        floor = floor_points(robot)
        return cls(robot, goals, contact, timeline, weights, floor, human_parts(robot, floor))

    @property
    def frames(self) -> int:
        return self.timeline.frames

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.robot.joint_lower + LIMIT_MARGIN, self.robot.joint_upper - LIMIT_MARGIN

    def moved(self, qpos: np.ndarray, delta: np.ndarray) -> np.ndarray:
        """Each frame [nq] moved along its tangent step [nv]."""
        result = np.empty_like(qpos)
        result[:, :3] = qpos[:, :3] + delta[:, :3]
        turned = rotation(qpos[:, 3:7]) * Rotation.from_rotvec(delta[:, 3:6])
        result[:, 3:7] = turned.as_quat(scalar_first=True)
        result[:, 7:] = qpos[:, 7:] + delta[:, 6:]
        return result

    def terms(self, qpos: np.ndarray) -> list[Residuals]:
        """Every residual at qpos."""
        pose = pose_of(self.robot, self.floor, qpos)
        return [
            *self.imitation(pose),
            *self.contacts(pose),
            *self.dynamics(pose),
            *self.joint_bounds(qpos),
            *self.smoothness(qpos),
        ]

    def imitation(self, pose: Pose) -> Iterator[Residuals]:
        """The human's directions and orientations, the hips' path, a weak pull to the default pose."""
        every = np.arange(self.frames)
        for vector in self.goals.vectors:
            if vector.start is None:
                value = pose.turns[:, vector.end, :, 1]
                jacobian = -cross_matrix(value) @ pose.turns_jac[:, vector.end]
            else:
                along = pose.bodies[:, vector.end] - pose.bodies[:, vector.start]
                length = np.linalg.norm(along, axis=-1)[:, None]
                value = along / length
                project = (np.eye(3) - value[:, :, None] * value[:, None, :]) / length[:, None]
                jacobian = project @ (pose.bodies_jac[:, vector.end] - pose.bodies_jac[:, vector.start])
            yield Residuals(every, vector.cost * (value - vector.goal), {0: vector.cost * jacobian})
        for orientation in self.goals.orientations:
            error = (Rotation.from_matrix(pose.turns[:, orientation.body]) * orientation.goal.inv()).as_rotvec()
            jacobian = pose.turns_jac[:, orientation.body]
            yield Residuals(every, orientation.cost * error, {0: orientation.cost * jacobian})
        hips = list(self.goals.hip_bodies)
        weight = self.weights.hip_centre
        error = pose.bodies[:, hips].mean(axis=1) - self.goals.hip_centre
        yield Residuals(every, weight * error, {0: weight * pose.bodies_jac[:, hips].mean(axis=1)})
        default = np.asarray(self.robot.arrays.default_joint_pos, np.float64)
        pull = np.where(self.robot.motor_counts, self.weights.posture, self.weights.wrist_posture)
        rows = np.broadcast_to(pull[:, None] * self._joint_rows(), (self.frames, len(pull), self.robot.model.nv))
        yield Residuals(every, pull * (pose.qpos[:, 7:] - default), {0: rows})

    def contacts(self, pose: Pose) -> Iterator[Residuals]:
        """Planted parts stay at the floor and do not slip, nothing goes under it, a swinging sole clears it."""
        every = np.arange(self.frames)
        pos, jac = pose.floor, pose.floor_jac
        height = pos[..., 2]
        down = self._by_point(self.contact.down)
        planted = self._by_point(self.contact.planted)
        lifted = self._by_point(self.contact.lifted)

        touched = down.any(axis=0)
        hold = self.weights.stance_height * down[:, touched]
        yield Residuals(every, hold * height[:, touched], {0: hold[..., None] * jac[:, touched, 2]})
        short = height - self.weights.clearance * lifted
        under = self.weights.floor * (short < 0.0)
        yield Residuals(every, under * short, {0: under[..., None] * jac[:, :, 2]})

        here, ahead = self.timeline.having(1)
        planted, pos, jac = planted[:, touched], pos[:, touched], jac[:, touched]
        pos_ahead, jac_ahead = self.timeline.positions(pos, here, 1), self.timeline.vectors(jac, here, 1)
        hold = self.weights.stance_slip * np.minimum(planted[here], planted[ahead])[..., None]
        rows = (len(here), -1)
        yield Residuals(
            here,
            (hold * (pos_ahead - pos[here])).reshape(rows),
            {
                0: (-hold[..., None] * jac[here]).reshape(*rows, self.robot.model.nv),
                1: (hold[..., None] * jac_ahead).reshape(*rows, self.robot.model.nv),
            },
        )

    def dynamics(self, pose: Pose) -> Iterator[Residuals]:
        """What neither the floor nor the motors can give."""
        given = self.robot, self.timeline, pose, self.contact.flight
        yield floor_wrench(*given, self.weights.wrench)
        yield motor_torque(*given, share=TORQUE_SHARE, weight=self.weights.torque)

    def joint_bounds(self, qpos: np.ndarray) -> Iterator[Residuals]:
        """Joints inside their limits and below their motors' speed."""
        every = np.arange(self.frames)
        lower, upper = self.bounds
        joints = qpos[:, 7:]
        beyond = np.minimum(joints - lower, 0.0) + np.maximum(joints - upper, 0.0)
        active = self.weights.limit * (beyond != 0.0)
        yield Residuals(every, active * beyond, {0: active[..., None] * self._joint_rows()})

        here, ahead = self.timeline.having(1)
        speed = (joints[ahead] - joints[here]) * self.timeline.fps
        allowed = SPEED_SHARE * self.robot.joint_velocity_limit
        excess = speed - np.clip(speed, -allowed, allowed)
        active = self.weights.speed * (excess != 0.0)
        rows = active[..., None] * self._joint_rows() * self.timeline.fps
        yield Residuals(here, active * excess, {0: -rows, 1: rows})

    def smoothness(self, qpos: np.ndarray) -> Iterator[Residuals]:
        """Third differences of the root's and the joints' motion."""
        change, before, after = self.timeline.changes(qpos)
        first, _ = self.timeline.having(3)
        rows = [(first + offset) % self.frames for offset in range(3)]
        jerk = change[rows[2]] - 2.0 * change[rows[1]] + change[rows[0]]
        jacobians = {
            0: before[rows[0]],
            1: after[rows[0]] - 2.0 * before[rows[1]],
            2: -2.0 * after[rows[1]] + before[rows[2]],
            3: after[rows[2]],
        }
        weight = self._smoothing(first)
        yield Residuals(
            first, weight * jerk, {offset: weight[..., None] * jacobian for offset, jacobian in jacobians.items()}
        )

    def _smoothing(self, first: np.ndarray) -> np.ndarray:
        """Weight [row, 1] of the third differences that start at frame `first`, larger about a seam."""
        weight = np.full((len(first), 1), 1.0 / (2.0 * np.pi * self.weights.smooth_hz / self.timeline.fps) ** 3)
        if self.timeline.cyclic:
            middle = (first + 1.5) % self.frames
            distance = np.minimum(middle, self.frames - middle)[:, None] / self.timeline.fps
            weight *= 1.0 + (self.weights.seam - 1.0) * np.exp(-((distance / SEAM_SECONDS) ** 2))
        return weight

    def _by_point(self, parts: dict[str, np.ndarray]) -> np.ndarray:
        """A weight by part [frame] laid out over the floor points [frame, point]."""
        none = np.zeros(self.frames)
        return np.stack([parts.get(part, none) for part in self.parts], axis=1)

    def _joint_rows(self) -> np.ndarray:
        """Jacobian [joint, nv] of the joint angles."""
        return np.eye(self.robot.model.nv)[6:]
