"""How well a clip suits the robot: floor contact, joint limits, smoothness, seams and dynamics, against two bars.

What fails the lower bar is rougher than the shipped clips, which may be no harm. What fails the upper one is no motion
of the robot.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.contact import FloorPoints, floor_points, floor_positions
from forgetmimic_jax.motion.dynamics import missing_acceleration
from forgetmimic_jax.motion.kinematics import configuration, rate
from forgetmimic_jax.motion.motors import motor_loads
from forgetmimic_jax.robot.model import Robot

STANCE_HEIGHT = 0.05  # m: a foot this low …
STANCE_SPEED = 0.3  # m/s: … and this slow stands
TOUCHING = 0.01  # m: a sole point this low touches the floor
FLIGHT_CLEARANCE = 0.02  # m: with every point above it the robot flies
FLIGHT_FRAMES = 5  # shorter hops hold no acceleration worth reading
MISSING_SECONDS = 0.2  # a single frame's acceleration says little
LOAD_SECONDS = 0.1  # … nor does its torque
JITTER_HZ = 12.0  # a body's own motion is slower
ROOT_SECONDS = 1.0  # over which the root's speed is a mean

# The bar that every shipped clip passes.
MAX_DEPTH = 0.02  # m under the floor, of any shape
MAX_STANCE_HEIGHT = 0.02  # m of a standing sole off the floor
MAX_SKATE = 0.10  # m/s
MAX_SEAM_RATIO = 1.0
MAX_JITTER = 0.02
MAX_FLIGHT_ERROR = 5.0  # m/s^2 from gravity
MAX_MISSING = 3.5  # m/s^2
MAX_LOAD = 1.5  # torque limits

# The bar of what may be a motion of the robot at all; rough retargets pass it.
MAX_LIMIT_EXCESS = 1e-4  # rad: an import cuts every joint at its limit
MAX_BURIED = 0.15  # m under the floor: retargets of LAFAN1 reach 0.08
MAX_PUSH = 100.0  # m/s^2 that no contact gives: a retarget's worst noise is under 20, a jump of 1 m is 290


@dataclass(frozen=True)
class Quality:
    """Measures of one clip; None where the clip has no such phase."""

    name: str
    seconds: float
    sole_lowest: float  # m, lowest point of any sole
    stance_height: float | None  # m, 95th percentile of a standing foot's distance from the floor
    skate: float | None  # m/s, mean horizontal speed of the sole points that touch the floor
    other_lowest: float  # m, lowest point of any other shape
    joint_speed: float  # largest share of a motor's speed
    limit_excess: float  # rad beyond a joint's limit, the largest
    joint_acceleration: float  # rad/s^2, 99th percentile of each frame's fastest joint
    jitter: float  # share of the joint velocity's power above JITTER_HZ
    seam: float | None  # velocity jump where cycles meet, over the largest change elsewhere; cyclic clips
    flight_acceleration: float | None  # m/s^2, vertical, of the centre of mass, median of flight
    missing_acceleration: float | None  # m/s^2 that no contact gives, the worst mean over MISSING_SECONDS
    motor_load: float | None  # torque over torque limit, the worst mean over LOAD_SECONDS of a motor that counts
    root_speed: float  # m/s, horizontal, the largest mean over ROOT_SECONDS
    worst: Mapping[str, str]  # where a measure is worst, by its name: the second and the frame, and the joint

    def failures(self) -> list[str]:
        """Where the clip is rougher than the shipped ones, in words; empty where it passes."""
        checks = [
            (
                self.limit_excess > MAX_LIMIT_EXCESS,
                "limit_excess",
                f"a joint {self.limit_excess:.3f} rad beyond its limit",
            ),
            (self.joint_speed > 1.0, "joint_speed", f"a joint at {self.joint_speed:.2f} of its motor's speed"),
            (
                self.sole_lowest < -MAX_DEPTH,
                "sole_lowest",
                f"a sole {-100 * self.sole_lowest:.1f} cm under the floor",
            ),
            (
                self.other_lowest < -MAX_DEPTH,
                "other_lowest",
                f"a shape {-100 * self.other_lowest:.1f} cm under the floor",
            ),
            (self.jitter > MAX_JITTER, "", f"jitter: {100 * self.jitter:.1f} % of the joints' power above 12 Hz"),
        ]
        if self.stance_height is not None:
            height = f"soles {100 * self.stance_height:.1f} cm from the floor in stance"
            checks.append((self.stance_height > MAX_STANCE_HEIGHT, "", height))
        if self.skate is not None:
            checks.append((self.skate > MAX_SKATE, "skate", f"soles skate at {self.skate:.2f} m/s"))
        if self.seam is not None:
            checks.append((self.seam > MAX_SEAM_RATIO, "", f"velocity jumps at the seam ({self.seam:.2f} x elsewhere)"))
        if self.flight_acceleration is not None:
            error = abs(self.flight_acceleration + 9.81)
            flight = f"off the floor it accelerates at {self.flight_acceleration:.1f} m/s^2 upwards, not -9.8"
            checks.append((error > MAX_FLIGHT_ERROR, "", flight))
        found = [f"{words}{self.worst.get(measure, '')}" for failed, measure, words in checks if failed]
        return found + self.infeasibilities()

    def faults(self) -> list[str]:
        """Why the clip is no motion of the robot, in words; empty where it may be one."""
        deepest = min(self.sole_lowest, self.other_lowest)
        shape = "sole_lowest" if self.sole_lowest <= self.other_lowest else "other_lowest"
        push = self.missing_acceleration or 0.0
        checks = [
            (
                self.limit_excess > MAX_LIMIT_EXCESS,
                "limit_excess",
                f"a joint {self.limit_excess:.3f} rad beyond its limit",
            ),
            (deepest < -MAX_BURIED, shape, f"a shape {-100 * deepest:.1f} cm under the floor"),
            (push > MAX_PUSH, "missing_acceleration", f"it needs {push:.0f} m/s^2 that no contact gives"),
        ]
        return [f"{words}{self.worst.get(measure, '')}" for failed, measure, words in checks if failed]

    def infeasibilities(self) -> list[str]:
        """Why no policy may be able to follow the clip, in words; empty where nothing says so."""
        checks = []
        if self.missing_acceleration is not None:
            missing = f"for {MISSING_SECONDS} s it needs {self.missing_acceleration:.1f} m/s^2 that no contact gives"
            checks.append((self.missing_acceleration > MAX_MISSING, "missing_acceleration", missing))
        if self.motor_load is not None:
            load = f"for {LOAD_SECONDS} s it needs {self.motor_load:.2f} times a motor's torque limit"
            checks.append((self.motor_load > MAX_LOAD, "motor_load", load))
        return [f"{words}{self.worst.get(measure, '')}" for failed, measure, words in checks if failed]


def measure(robot: Robot, clip: Clip, cycle_frames: int | None = None) -> Quality:
    """Measure a clip.

    Args:
        robot: whose clip it is.
        clip: the motion.
        cycle_frames: frames of one cycle of a tiled clip; None for a motion that does not repeat.
    """
    qpos = configuration(clip, robot)
    points = floor_points(robot)
    positions = floor_positions(robot, points, qpos)
    height = positions[..., 2]
    joints = qpos[:, 7:]
    joint_vel = np.diff(joints, axis=0) * clip.fps
    acceleration = np.abs(np.diff(joint_vel, axis=0)) * clip.fps
    beyond = robot.beyond(joints)
    missing = _means(missing_acceleration(robot, positions, qpos, clip.fps), MISSING_SECONDS, clip.fps)
    loads = _means(motor_loads(robot, points, positions, qpos, clip.fps), LOAD_SECONDS, clip.fps)
    speeds = np.abs(joint_vel) / robot.joint_velocity_limit
    soles = height[:, points.is_sole].min(axis=1)
    others = height[:, ~points.is_sole].min(axis=1, initial=np.inf)  # a robot may have shapes at its feet alone
    sliding = _sliding(points, positions, clip.fps)
    worst = {
        "limit_excess": _place(beyond, clip.fps, robot),
        "joint_speed": _place(speeds, clip.fps, robot),
        "sole_lowest": _place(-soles, clip.fps),
        "other_lowest": _place(-others, clip.fps),
        "skate": _place(np.nan_to_num(sliding).max(axis=1), clip.fps),
    }
    # A window of means begins one frame after its first frame, whose acceleration needs both neighbours.
    if missing is not None:
        worst["missing_acceleration"] = _place(np.linalg.norm(missing, axis=-1), clip.fps, first=1)
    if loads is not None:
        worst["motor_load"] = _place(np.abs(loads), clip.fps, robot, first=1)
    return Quality(
        name=clip.name,
        seconds=clip.seconds,
        sole_lowest=float(soles.min()),
        stance_height=_stance_height(robot, points, positions, clip.fps),
        skate=None if np.isnan(sliding).all() else float(np.nanmean(sliding)),
        other_lowest=float(others.min()),
        joint_speed=float(speeds.max()),
        limit_excess=float(max(0.0, beyond.max())),
        joint_acceleration=float(np.percentile(acceleration.max(axis=1), 99)) if len(acceleration) else 0.0,
        jitter=_jitter(joint_vel, clip.fps),
        seam=None if cycle_frames is None else seam_ratio(joint_vel, cycle_frames),
        flight_acceleration=_flight_acceleration(robot, qpos, height.min(axis=1), clip.fps),
        missing_acceleration=None if missing is None else float(np.linalg.norm(missing, axis=-1).max()),
        motor_load=None if loads is None else float(np.abs(loads).max()),
        root_speed=_root_speed(clip),
        worst=worst,
    )


def seam_ratio(joint_vel: np.ndarray, cycle_frames: int) -> float | None:
    """Largest change of a joint's velocity where two cycles meet, over the largest anywhere else.

    Args:
        joint_vel: [frame - 1, joint] differences from frame to frame.
        cycle_frames: frames in a cycle.
    """
    change = np.abs(np.diff(joint_vel, axis=0)).max(axis=1)  # row k: at frame k + 1
    at_seam = np.isin((np.arange(len(change)) + 1) % cycle_frames, (0, cycle_frames - 1))
    if not at_seam.any() or at_seam.all():
        return None
    return float(change[at_seam].max() / max(change[~at_seam].max(), 1e-9))


def _means(rows: np.ndarray, seconds: float, fps: float) -> np.ndarray | None:
    """Means of [row, n] over windows of `seconds`; None for a shorter clip."""
    window = round(seconds * fps)
    return sliding_window_view(rows, window, axis=0).mean(axis=-1) if len(rows) >= window else None


def _stance_height(robot: Robot, points: FloorPoints, positions: np.ndarray, fps: float) -> float | None:
    heights = []
    for body in robot.pairs.feet:
        foot = positions[:, points.is_sole & (points.body == body)]
        speed = np.linalg.norm(rate(foot.mean(axis=1), fps), axis=-1)
        lowest = foot[..., 2].min(axis=1)
        heights.append(lowest[(lowest < STANCE_HEIGHT) & (speed < STANCE_SPEED)])
    every = np.abs(np.concatenate(heights))
    return float(np.percentile(every, 95)) if len(every) else None


def _sliding(points: FloorPoints, positions: np.ndarray, fps: float) -> np.ndarray:
    """Horizontal speed [frame - 1, sole point] m/s of the sole points that touch the floor; NaN for the others."""
    soles = positions[:, points.is_sole]
    speed = np.linalg.norm(np.diff(soles[..., :2], axis=0), axis=-1) * fps
    touching = (soles[:-1, :, 2] < TOUCHING) & (soles[1:, :, 2] < TOUCHING)
    return np.where(touching, speed, np.nan)


def _place(sizes: np.ndarray, fps: float, robot: Robot | None = None, first: int = 0) -> str:
    """Where [frame] or [frame, joint] is largest, in words."""
    place = np.unravel_index(np.argmax(sizes), sizes.shape)
    frame = first + int(place[0])
    joint = f"{robot.joint_names[place[1]]} " if robot is not None else ""
    return f" ({joint}at {frame / fps:.2f} s, frame {frame})"


def _root_speed(clip: Clip) -> float:
    window = min(round(ROOT_SECONDS * clip.fps), clip.num_frames - 1)
    travel = np.linalg.norm(np.diff(clip.root_pos[:, :2], axis=0), axis=-1) * clip.fps
    return float(sliding_window_view(travel, window).mean(axis=-1).max())


def _jitter(joint_vel: np.ndarray, fps: float) -> float:
    power = np.abs(np.fft.rfft((joint_vel - joint_vel.mean(axis=0)) * np.hanning(len(joint_vel))[:, None], axis=0)) ** 2
    fast = np.fft.rfftfreq(len(joint_vel), 1.0 / fps) > JITTER_HZ
    return float(power[fast].sum() / max(power.sum(), 1e-12))


def _flight_acceleration(robot: Robot, qpos: np.ndarray, lowest: np.ndarray, fps: float) -> float | None:
    flying = lowest > FLIGHT_CLEARANCE
    starts = np.flatnonzero(np.diff(np.concatenate([[False], flying]).astype(int)) == 1)
    ends = np.flatnonzero(np.diff(np.concatenate([flying, [False]]).astype(int)) == -1) + 1
    data = mujoco.MjData(robot.model)
    found: list[np.ndarray] = []
    for start, end in zip(starts, ends, strict=True):
        if end - start < FLIGHT_FRAMES:
            continue
        com = []
        for configuration_row in qpos[start:end]:
            data.qpos[:] = configuration_row
            mujoco.mj_kinematics(robot.model, data)
            mujoco.mj_comPos(robot.model, data)
            com.append(data.subtree_com[1][2])
        found.append(np.diff(com, n=2) * fps**2)
    return float(np.median(np.concatenate(found))) if found else None
