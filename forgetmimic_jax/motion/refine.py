"""Refine a whole retargeted clip at once: planted soles, free flight, no jitter, nothing under the floor.

One non-linear least-squares problem over all frames, solved by Gauss-Newton. The unknowns are the frames' tangent
steps (MuJoCo's nv: root linear in the world, root angular in the root's frame, joints). A cyclic clip wraps around:
frame n is frame 0 moved by the cycle's planar step.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.linalg import solveh_banded
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from forgetmimic_jax.motion.contact import FloorPoints, HumanContact
from forgetmimic_jax.motion.kinematics import PlanarTransform, rotation
from forgetmimic_jax.motion.retarget import Targets
from forgetmimic_jax.robot import Robot

RADIUS = 0.3  # m, over which a moment counts as a force
FRICTION = 0.7
TOUCHING = 0.02  # m above the floor
SURE = 3.0  # m/s^2: beyond it a missing acceleration counts linearly, so that an impact does not bend the motion
SEAM_SECONDS = 0.12  # half width of the more smoothed seam
GRAVITY = np.array([0.0, 0.0, -9.81])


@dataclass(frozen=True)
class Weights:
    """Weight of each residual; a residual of 1 over its weight counts as one radian of limb direction."""

    hip_centre: float = 2.0  # per m
    posture: float = 0.03  # per rad from the default pose
    wrist_posture: float = 0.2  # the same for the wrists, which the human skeleton lacks
    stance_height: float = 40.0  # per m of a planted sole point off the floor
    stance_slip: float = 150.0  # per m a planted sole point moves in one frame
    floor: float = 60.0  # per m below the floor, or below the clearance of a sole that swings
    wrench: float = 0.05  # per m/s^2 of acceleration that the floor cannot provide
    limit: float = 20.0  # per rad beyond the joint's limit less its margin
    speed: float = 0.3  # per rad/s beyond the share of the motor's speed
    smooth_hz: float = 6.0  # jerk is weighed so that motion faster than this is smoothed away
    seam: float = 5.0  # times more where cycles meet, since a recording may stop one motion there and start another
    clearance: float = 0.02  # m that a swinging sole keeps above the floor


class Pose(NamedTuple):
    """Positions and rotations of a clip with their Jacobians over nv."""

    points: np.ndarray  # [frame, point, 3] m
    points_jac: np.ndarray  # [frame, point, 3, nv]
    turns: np.ndarray  # [frame, body, 3, 3]
    turns_jac: np.ndarray  # [frame, body, 3, nv] world-frame rotation
    com: np.ndarray  # [frame, 3] m
    com_jac: np.ndarray  # [frame, 3, nv]
    momentum: np.ndarray  # [frame, 3, nv] matrix of the angular momentum about the centre of mass


class Term(NamedTuple):
    """Residuals of `frame`s [row, m] and their Jacobians [row, m, nv] by frames ahead of it."""

    frame: np.ndarray
    residual: np.ndarray
    jacobians: dict[int, np.ndarray]


def refine(
    robot: Robot,
    targets: Targets,
    contact: HumanContact,
    floor: FloorPoints,
    qpos: np.ndarray,
    fps: float,
    step: PlanarTransform | None,
    *,
    weights: Weights | None = None,
    limit_margin: float = 0.02,
    speed_share: float = 0.8,
    iterations: int = 25,
) -> np.ndarray:
    """Improve qpos [frame, 7 + joint].

    Args:
        robot: the robot.
        targets: limb directions, orientations and the hips' path.
        contact: when soles are planted and when the body flies.
        floor: the robot's points that may not go under the floor.
        qpos: where to start, from inverse kinematics.
        fps: frames per s.
        step: a cyclic clip's planar step from cycle to cycle, at the robot's scale; None if it does not repeat.
        weights: of the residuals.
        limit_margin: rad kept from every joint's limit.
        speed_share: of the motors' speed that the joints may use.
        iterations: Gauss-Newton steps.
    """
    problem = _Problem(
        robot, targets, contact, floor, fps, step, weights or Weights(), limit_margin, speed_share, len(qpos)
    )
    damping = 1e-4
    terms = list(problem.terms(qpos))
    cost = _cost(terms)
    for _ in range(iterations):
        delta = _solve(terms, len(qpos), robot.model.nv, step is not None, damping)
        candidate = problem.moved(qpos, delta)
        new_terms = list(problem.terms(candidate))
        new_cost = _cost(new_terms)
        if new_cost < cost:
            converged = cost - new_cost < 1e-5 * cost
            qpos, terms, cost, damping = candidate, new_terms, new_cost, max(damping / 4.0, 1e-6)
            if converged:
                break
        else:
            damping *= 8.0
    return np.concatenate([qpos[:, :7], np.clip(qpos[:, 7:], *problem.bounds)], axis=-1)


@dataclass(frozen=True)
class _Problem:
    robot: Robot
    targets: Targets
    contact: HumanContact
    floor: FloorPoints
    fps: float
    step: PlanarTransform | None
    weights: Weights
    limit_margin: float
    speed_share: float
    frames: int

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.robot.joint_lower + self.limit_margin, self.robot.joint_upper - self.limit_margin

    def moved(self, qpos: np.ndarray, delta: np.ndarray) -> np.ndarray:
        """Each frame [nq] moved along its tangent step [nv]."""
        result = np.empty_like(qpos)
        result[:, :3] = qpos[:, :3] + delta[:, :3]
        turned = rotation(qpos[:, 3:7]) * Rotation.from_rotvec(delta[:, 3:6])
        result[:, 3:7] = turned.as_quat(scalar_first=True)
        result[:, 7:] = qpos[:, 7:] + delta[:, 6:]
        return result

    def terms(self, qpos: np.ndarray) -> Iterator[Term]:
        """Every residual at qpos."""
        pose = self.pose(qpos)
        yield from self.imitation(qpos, pose)
        yield from self.contacts(pose)
        yield from self.floor_wrench(qpos, pose)
        yield from self.joint_bounds(qpos)
        yield from self.smoothness(qpos)

    def pose(self, qpos: np.ndarray) -> Pose:
        """Kinematics with Jacobians; points: the bodies' origins (by body id), then the floor points."""
        model = self.robot.model
        data = mujoco.MjData(model)
        bodies = model.nbody
        count = bodies + len(self.floor.body)
        pose = Pose(
            np.empty((self.frames, count, 3)),
            np.empty((self.frames, count, 3, model.nv)),
            np.empty((self.frames, bodies, 3, 3)),
            np.empty((self.frames, bodies, 3, model.nv)),
            np.empty((self.frames, 3)),
            np.empty((self.frames, 3, model.nv)),
            np.empty((self.frames, 3, model.nv)),
        )
        for frame in range(self.frames):
            data.qpos[:] = qpos[frame]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            pose.points[frame, :bodies] = data.xpos
            pose.turns[frame] = data.xmat.reshape(-1, 3, 3)
            turns = pose.turns[frame, self.floor.body]
            pose.points[frame, bodies:] = data.xpos[self.floor.body] + np.einsum("pij,pj->pi", turns, self.floor.local)
            for body in range(bodies):
                mujoco.mj_jacBody(model, data, pose.points_jac[frame, body], pose.turns_jac[frame, body], body)
            for row, body in enumerate(self.floor.body):
                point = pose.points[frame, bodies + row]
                mujoco.mj_jac(model, data, pose.points_jac[frame, bodies + row], None, point, body)
            pose.com[frame] = data.subtree_com[1]
            mujoco.mj_jacSubtreeCom(model, data, pose.com_jac[frame], 1)
            mujoco.mj_angmomMat(model, data, pose.momentum[frame], 1)
        pose.points[:, bodies:, 2] -= self.floor.radius
        return pose

    def imitation(self, qpos: np.ndarray, pose: Pose) -> Iterator[Term]:
        """The human's directions and orientations, the hips' path, a weak pull to the default pose."""
        every = np.arange(self.frames)
        for vector in self.targets.vectors:
            if vector.start is None:
                value = pose.turns[:, vector.end, :, 1]
                jacobian = -_skew(value) @ pose.turns_jac[:, vector.end]
            else:
                along = pose.points[:, vector.end] - pose.points[:, vector.start]
                length = np.linalg.norm(along, axis=-1)[:, None]
                value = along / length
                project = (np.eye(3) - value[:, :, None] * value[:, None, :]) / length[:, None]
                jacobian = project @ (pose.points_jac[:, vector.end] - pose.points_jac[:, vector.start])
            yield Term(every, vector.cost * (value - vector.target), {0: vector.cost * jacobian})
        for orientation in self.targets.orientations:
            error = (rotation_of(pose.turns[:, orientation.body]) * orientation.target.inv()).as_rotvec()
            jacobian = pose.turns_jac[:, orientation.body]
            yield Term(every, orientation.cost * error, {0: orientation.cost * jacobian})
        hips = list(self.targets.hip_bodies)
        weight = self.weights.hip_centre
        error = pose.points[:, hips].mean(axis=1) - self.targets.hip_centre
        yield Term(every, weight * error, {0: weight * pose.points_jac[:, hips].mean(axis=1)})
        default = np.asarray(self.robot.arrays.default_joint_pos, np.float64)
        wrist = np.array(["wrist" in joint for joint in self.robot.joint_names])
        pull = np.where(wrist, self.weights.wrist_posture, self.weights.posture)
        rows = np.broadcast_to(pull[:, None] * self._joint_rows(), (self.frames, len(pull), self.robot.model.nv))
        yield Term(every, pull * (qpos[:, 7:] - default), {0: rows})

    def contacts(self, pose: Pose) -> Iterator[Term]:
        """Planted soles stay at the floor and do not slip, nothing goes under it, a body in flight falls freely."""
        bodies = self.robot.model.nbody
        every = np.arange(self.frames)
        pos, jac = pose.points[:, bodies:], pose.points_jac[:, bodies:]
        height = pos[..., 2]
        planted, lifted = self._by_point(self.contact.planted), self._by_point(self.contact.lifted)

        touched = planted.any(axis=0)
        hold = self.weights.stance_height * planted[:, touched]
        yield Term(every, hold * height[:, touched], {0: hold[..., None] * jac[:, touched, 2]})
        short = height - self.weights.clearance * lifted
        under = self.weights.floor * (short < 0.0)
        yield Term(every, under * short, {0: under[..., None] * jac[:, :, 2]})

        here, ahead = self._frames_with(1)
        planted, pos, jac = planted[:, touched], pos[:, touched], jac[:, touched]
        pos_ahead, jac_ahead = self._ahead(pos, jac, here, 1)
        hold = self.weights.stance_slip * np.minimum(planted[here], planted[ahead])[..., None]
        rows = (len(here), -1)
        yield Term(
            here,
            (hold * (pos_ahead - pos[here])).reshape(rows),
            {
                0: (-hold[..., None] * jac[here]).reshape(*rows, self.robot.model.nv),
                1: (hold[..., None] * jac_ahead).reshape(*rows, self.robot.model.nv),
            },
        )

    def floor_wrench(self, qpos: np.ndarray, pose: Pose) -> Iterator[Term]:
        """Newton's and Euler's laws: what accelerates the body must come from the floor points that touch.

        Per unit of mass, [force; moment about the centre of mass over RADIUS] in m/s^2. The floor's best answer, by
        non-negative least squares over each point's friction pyramid, is subtracted; a body in flight gets none, so
        that it falls freely and keeps its angular momentum.
        """
        here, ahead = self._frames_with(1)
        change, before, after = self._changes(qpos)
        momentum = 0.5 * (pose.momentum[here] + pose.momentum[ahead])
        spin = np.einsum("tij,tj->ti", momentum, change)
        first, _ = self._frames_with(2)
        second = (first + 1) % self.frames
        com_1, jac_1 = self._ahead(pose.com[:, None], pose.com_jac[:, None], first, 1)
        com_2, jac_2 = self._ahead(pose.com[:, None], pose.com_jac[:, None], first, 2)
        bodies = self.robot.model.nbody
        points, _ = self._ahead(pose.points[:, bodies:], None, first, 1)

        force = (com_2[:, 0] - 2.0 * com_1[:, 0] + pose.com[first]) * self.fps**2 - GRAVITY
        mass = self.robot.model.body_subtreemass[1]
        rate = self.fps**2 / (mass * RADIUS)
        needed = np.concatenate([force, rate * (spin[second] - spin[first])], axis=-1)
        given, project = _floor_answer(
            needed, points - com_1, (points[..., 2] < TOUCHING) & ~self.contact.flight[second, None]
        )
        missing = needed - given
        robust = self.weights.wrench * (1.0 + np.sum(missing**2, axis=-1) / SURE**2) ** -0.25
        lever = -_skew(given[:, :3]) / RADIUS @ jac_1[:, 0]
        blocks = {
            0: (self.fps**2 * pose.com_jac[first], -rate * momentum[first] @ before[first]),
            1: (
                -2.0 * self.fps**2 * jac_1[:, 0],
                lever + rate * (momentum[second] @ before[second] - momentum[first] @ after[first]),
            ),
            2: (self.fps**2 * jac_2[:, 0], rate * momentum[second] @ after[second]),
        }
        yield Term(
            first,
            robust[:, None] * missing,
            {
                offset: robust[:, None, None] * (project @ np.concatenate(block, axis=1))
                for offset, block in blocks.items()
            },
        )

    def joint_bounds(self, qpos: np.ndarray) -> Iterator[Term]:
        """Joints inside their limits and below their motors' speed."""
        every = np.arange(self.frames)
        lower, upper = self.bounds
        joints = qpos[:, 7:]
        beyond = np.minimum(joints - lower, 0.0) + np.maximum(joints - upper, 0.0)
        active = self.weights.limit * (beyond != 0.0)
        yield Term(every, active * beyond, {0: active[..., None] * self._joint_rows()})

        here, ahead = self._frames_with(1)
        speed = (joints[ahead] - joints[here]) * self.fps
        allowed = self.speed_share * self.robot.joint_velocity_limit
        excess = speed - np.clip(speed, -allowed, allowed)
        active = self.weights.speed * (excess != 0.0)
        rows = active[..., None] * self._joint_rows() * self.fps
        yield Term(here, active * excess, {0: -rows, 1: rows})

    def smoothness(self, qpos: np.ndarray) -> Iterator[Term]:
        """Third differences of the root's and the joints' motion."""
        change, before, after = self._changes(qpos)
        first, _ = self._frames_with(3)
        rows = [(first + offset) % self.frames for offset in range(3)]
        jerk = change[rows[2]] - 2.0 * change[rows[1]] + change[rows[0]]
        jacobians = {
            0: before[rows[0]],
            1: after[rows[0]] - 2.0 * before[rows[1]],
            2: -2.0 * after[rows[1]] + before[rows[2]],
            3: after[rows[2]],
        }
        weight = self._smoothing(first)
        yield Term(
            first, weight * jerk, {offset: weight[..., None] * jacobian for offset, jacobian in jacobians.items()}
        )

    def _changes(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Tangent steps [row, nv] from each frame to the next, and their Jacobians over both [row, nv, nv]."""
        nv = self.robot.model.nv
        here, ahead = self._frames_with(1)
        pos_ahead, _ = self._ahead(qpos[:, None, :3], None, here, 1)
        linear = pos_ahead[:, 0] - qpos[here, :3]
        turns = rotation(qpos[:, 3:7])
        turns_ahead = turns[ahead]
        if self.step is not None:
            turns_ahead[-1] = self.step.turn(turns_ahead[-1])
        angular = (turns[here].inv() * turns_ahead).as_rotvec()
        joints = qpos[ahead, 7:] - qpos[here, 7:]
        change = np.concatenate([linear, angular, joints], axis=-1)  # first differences

        # d angular = (I - w/2) d ahead - (I + w/2) d here to first order in the turn w of one frame.
        half = 0.5 * _skew(angular)
        after = np.broadcast_to(np.eye(nv), (len(here), nv, nv)).copy()
        before = -after
        after[:, 3:6, 3:6] += half
        before[:, 3:6, 3:6] += half
        if self.step is not None:
            after[-1, :3, :3] = _yaw_matrix(self.step.yaw)
        return change, before, after

    def _smoothing(self, first: np.ndarray) -> np.ndarray:
        """Weight [row, 1] of the third differences that start at frame `first`, larger about a seam."""
        weight = np.full((len(first), 1), 1.0 / (2.0 * np.pi * self.weights.smooth_hz / self.fps) ** 3)
        if self.step is not None:
            middle = (first + 1.5) % self.frames
            distance = np.minimum(middle, self.frames - middle)[:, None] / self.fps
            weight *= 1.0 + (self.weights.seam - 1.0) * np.exp(-((distance / SEAM_SECONDS) ** 2))
        return weight

    def _by_point(self, parts: dict[str, np.ndarray]) -> np.ndarray:
        """A weight by part [frame] laid out over the floor points [frame, point]."""
        none = np.zeros(self.frames)
        return np.stack([parts.get(part, none) for part in self.floor.part], axis=1)

    def _joint_rows(self) -> np.ndarray:
        """Jacobian [joint, nv] of the joint angles."""
        return np.eye(self.robot.model.nv)[6:]

    def _frames_with(self, ahead: int) -> tuple[np.ndarray, np.ndarray]:
        """Frames that have a frame `ahead` of them, and those frames."""
        count = self.frames if self.step is not None else self.frames - ahead
        here = np.arange(count)
        return here, (here + ahead) % self.frames

    def _ahead(
        self, pos: np.ndarray, jac: np.ndarray | None, here: np.ndarray, ahead: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """World positions [row, point, 3] and Jacobians `ahead` of frames `here`, moved by the step past the seam."""
        index = here + ahead
        pos_ahead = pos[index % self.frames].copy()
        jac_ahead = np.empty(0) if jac is None else jac[index % self.frames].copy()
        past = index >= self.frames
        if self.step is not None and past.any():
            pos_ahead[past] = self.step.apply(pos_ahead[past])
            if jac is not None:
                jac_ahead[past] = _yaw_matrix(self.step.yaw) @ jac_ahead[past]
        return pos_ahead, jac_ahead


def _floor_answer(needed: np.ndarray, levers: np.ndarray, touching: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The wrench nearest to `needed` [row, 6] that the touching points give, and the projector [row, 6, 6] off it.

    levers [row, point, 3] m: the points from the centre of mass; touching bool[row, point].
    """
    edges = np.array([[FRICTION, 0, 1], [-FRICTION, 0, 1], [0, FRICTION, 1], [0, -FRICTION, 1]])
    given = np.zeros_like(needed)
    project = np.tile(np.eye(6), (len(needed), 1, 1))
    for row in np.flatnonzero(touching.any(axis=1)):
        arms = np.repeat(levers[row, touching[row]], len(edges), axis=0)
        forces = np.tile(edges, (len(arms) // len(edges), 1))
        columns = np.concatenate([forces, np.cross(arms, forces) / RADIUS], axis=1).T
        share, _ = nnls(columns, needed[row])
        given[row] = columns @ share
        active = columns[:, share > 0.0]
        if active.size:
            project[row] -= active @ np.linalg.pinv(active)
    return given, project


def _cost(terms: list[Term]) -> float:
    return float(sum(np.sum(term.residual**2) for term in terms))


def _solve(terms: list[Term], frames: int, nv: int, cyclic: bool, damping: float) -> np.ndarray:
    """Gauss-Newton step [frame, nv] of the block-banded (cyclic: block-circulant banded) normal equations."""
    reach = max(max(term.jacobians) for term in terms)
    blocks = np.zeros((reach + 1, frames, nv, nv))  # blocks[k, t] couples frame t with frame t + k
    gradient = np.zeros((frames, nv))
    for term in terms:
        for offset, jacobian in term.jacobians.items():
            at = (term.frame + offset) % frames
            gradient[at] += np.einsum("tmi,tm->ti", jacobian, term.residual)
            for other, other_jacobian in term.jacobians.items():
                if other >= offset:
                    product = np.swapaxes(jacobian, -1, -2) @ other_jacobian
                    blocks[other - offset, at] += product
    blocks[0] += damping * np.eye(nv)

    # A cyclic clip is folded (0, n-1, 1, n-2, ...), which turns the circle into a band of twice the width.
    every = np.arange(frames)
    place = np.where(every < (frames + 1) // 2, 2 * every, 2 * (frames - 1 - every) + 1) if cyclic else every
    width = (2 * reach + 1 if cyclic else reach + 1) * nv
    band = np.zeros((width, frames * nv))
    row, column = np.meshgrid(np.arange(nv), np.arange(nv), indexing="ij")
    for ahead in range(reach + 1):
        here = every if cyclic else every[: frames - ahead]
        there = (here + ahead) % frames
        for block, down, right in (
            (blocks[ahead, here], place[here], place[there]),
            (np.swapaxes(blocks[ahead, here], -1, -2), place[there], place[here]),
        )[: 2 if ahead else 1]:
            down_entry = down[:, None, None] * nv + row
            right_entry = right[:, None, None] * nv + column
            lower = down_entry >= right_entry
            band[(down_entry - right_entry)[lower], right_entry[lower]] += block[lower]
    solution = np.empty((frames, nv))
    order = np.argsort(place)
    solution[order] = -solveh_banded(band, gradient[order].reshape(-1), lower=True).reshape(frames, nv)
    return solution


def rotation_of(matrices: np.ndarray) -> Rotation:
    """scipy Rotation of rotation matrices [..., 3, 3]."""
    return Rotation.from_matrix(matrices)


def _skew(vectors: np.ndarray) -> np.ndarray:
    """Cross-product matrices [..., 3, 3] of vectors [..., 3]."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vectors.shape, 3)


def _yaw_matrix(yaw: float) -> np.ndarray:
    return Rotation.from_rotvec([0.0, 0.0, yaw]).as_matrix()
