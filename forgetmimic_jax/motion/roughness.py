"""Frames of a clip that no body moves through: jumps of the root, spikes of a joint, stretches in the air."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.ndimage import median_filter

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.kinematics import rotation
from forgetmimic_jax.motion.recording import MIN_SECONDS
from forgetmimic_jax.robot.model import Robot

# A jump is a step of the root that differs from the median of the steps around it. Over 26 real clips the largest
# difference is 0.9 m/s and 16 rad/s; a teleport of 1.5 m at 30 Hz is 45 m/s, a random first frame 93 rad/s.
JUMP = 5.0  # m/s
WHIRL = 40.0  # rad/s
JUMP_SECONDS = 0.1  # of steps that are the step's neighbours
# A spike is an angle that differs from its median over some frames: real clips 0.47 rad, a spike of 1 rad 0.91.
SPIKE = 0.6  # rad
SPIKE_SECONDS = 0.16
# Above the ground for longer than a jump: real clips 0.6 s.
AIR_HEIGHT = 0.05  # m
AIR_SECONDS = 1.0
SHOWN = 3  # spikes that are named; of the others the number


def check_jumps(clip: Clip, first: int, path: Path) -> None:
    """Refuse a root that jumps.

    Args:
        clip: at the file's rate.
        first: the file's frame that the clip begins with.
        path: of the file, for the message.

    Raises:
        InputError: with frame and second, and the longest stretch without a jump.
    """
    turns = rotation(clip.root_quat)
    steps = np.diff(clip.root_pos, axis=0) * clip.fps
    spins = (turns[1:] * turns[:-1].inv()).as_rotvec() * clip.fps
    jumps, whirls = _difference(steps, clip.fps), _difference(spins, clip.fps)
    bad = np.flatnonzero((jumps > JUMP) | (whirls > WHIRL))
    if not len(bad):
        return
    worst = int(bad[np.argmax(np.maximum(jumps[bad] / JUMP, whirls[bad] / WHIRL))])
    edges = np.concatenate([[-1], bad, [clip.num_frames - 1]])
    longest = int(np.argmax(np.diff(edges)))
    kept = (first + edges[longest] + 1) / clip.fps, (first + edges[longest + 1]) / clip.fps
    degrees = np.degrees(np.linalg.norm(spins[worst])) / clip.fps
    raise InputError(
        f"{path}: the root jumps {len(bad)} time(s), by {np.linalg.norm(steps[worst]) / clip.fps:.2f} m and "
        f"{degrees:.0f} degrees from frame {first + worst} to {first + worst + 1} "
        f"({(first + worst + 1) / clip.fps:.2f} s); the longest part without a jump: --start {_up(kept[0])} "
        f"--end {_down(kept[1])}"
    )


def spikes(robot: Robot, clip: Clip, first: int) -> list[str]:
    """Joints that leave their path for some frames and come back, the largest first; arguments as `check_jumps`."""
    window = _window(SPIKE_SECONDS, clip.fps, 7)
    off = np.abs(clip.joint_pos - median_filter(clip.joint_pos, (window, 1), mode="mirror"))
    worst = off.max(axis=0)
    found = [joint for joint in np.argsort(-worst) if worst[joint] > SPIKE]
    lines = []
    for joint in found[:SHOWN]:
        frames = np.flatnonzero(off[:, joint] > SPIKE)
        start, end = max(frames[0] - 1, 0), frames[0] + window  # the last good frame before, the first after
        parts = [f"--end {_down((first + start) / clip.fps)}"] if start / clip.fps >= MIN_SECONDS else []
        if (clip.num_frames - 1 - end) / clip.fps >= MIN_SECONDS:
            parts.append(f"--start {_up((first + end) / clip.fps)}")
        lines.append(
            f"{robot.joint_names[joint]} jumps by {worst[joint]:.2f} rad and back at frame {first + frames[0]} "
            f"({(first + frames[0]) / clip.fps:.2f} s){'; leave it out with ' if parts else ''}{' or '.join(parts)}"
        )
    return lines + ([f"{len(found) - SHOWN} more joints jump and come back"] if len(found) > SHOWN else [])


def stretches_in_the_air(lowest: np.ndarray, fps: float, start: float) -> list[str]:
    """Where no point of the robot comes near the ground for longer than a jump.

    Args:
        lowest: [frame] m, height of the lowest point.
        fps: frames per s.
        start: second of the file that the first frame is at.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lowest > AIR_HEIGHT, [False]]).astype(int)))
    lines = []
    for begin, end in edges.reshape(-1, 2):
        if (end - begin) / fps > AIR_SECONDS:
            lines.append(
                f"no point touches the ground from {start + begin / fps:.2f} to {start + end / fps:.2f} s: the lowest "
                f"is up to {lowest[begin:end].max():.2f} m above it; do the heights drift?"
            )
    return lines


def _difference(values: np.ndarray, fps: float) -> np.ndarray:
    """Norm of the difference of vectors [step, 3] from the median of their neighbours."""
    window = _window(JUMP_SECONDS, fps, 5)
    return np.linalg.norm(values - median_filter(values, (window, 1), mode="mirror"), axis=-1)


def _window(seconds: float, fps: float, least: int) -> int:
    """An odd number of frames."""
    return max(least, 2 * round(0.5 * seconds * fps) + 1)


def _up(seconds: float) -> str:
    return f"{max(np.ceil(100.0 * seconds - 1e-6) / 100.0, 0.0) + 0.0:.2f}"


def _down(seconds: float) -> str:
    return f"{max(np.floor(100.0 * seconds + 1e-6) / 100.0, 0.0):.2f}"
