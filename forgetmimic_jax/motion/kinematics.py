"""Motion arithmetic on the host: differences inside one clip, resampling, forward kinematics.

Quaternions are wxyz; positions m; angles rad; z is up. Leading dimension: frame.
"""

from __future__ import annotations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from forgetmimic_jax.motion.clip import Clip, continuous
from forgetmimic_jax.robot.bodies import Bodies
from forgetmimic_jax.robot.model import Robot


def rotation(quat: np.ndarray) -> Rotation:
    """scipy Rotation of wxyz quaternions [..., 4]."""
    return Rotation.from_quat(quat, scalar_first=True)


def quaternion(rotation: Rotation) -> np.ndarray:
    """Continuous wxyz quaternions [frame, 4] of a scipy Rotation."""
    return continuous(rotation.as_quat(scalar_first=True))


def heading(quat: np.ndarray) -> np.ndarray:
    """Yaw [...] rad of orientations [..., 4]: the turn about z, which is the twist of the swing-twist split."""
    return 2.0 * np.arctan2(quat[..., 3], quat[..., 0])


def rate(values: np.ndarray, fps: float) -> np.ndarray:
    """Time derivative of [frame, ...] by central differences, one-sided at both ends."""
    return np.gradient(values, 1.0 / fps, axis=0)


def angular_velocity(quat: np.ndarray, fps: float) -> np.ndarray:
    """World-frame angular velocity [frame, 3] rad/s of orientations [frame, 4], differenced as `rate` does."""
    turns = rotation(quat)
    frames = len(quat)
    after = np.minimum(np.arange(frames) + 1, frames - 1)
    before = np.maximum(np.arange(frames) - 1, 0)
    return (turns[after] * turns[before].inv()).as_rotvec() * (fps / (after - before))[:, None]


def resample(clip: Clip, fps: float) -> Clip:
    """The clip at another rate: linear in positions and joint angles, slerp in the root's orientation."""
    times = np.arange(clip.num_frames) / clip.fps
    count = int(np.floor(times[-1] * fps + 1e-6)) + 1
    new_times = np.minimum(np.arange(count) / fps, times[-1])
    return Clip(
        name=clip.name,
        fps=fps,
        joint_names=clip.joint_names,
        root_pos=interpolate(new_times, times, clip.root_pos),
        root_quat=quaternion(Slerp(times, rotation(clip.root_quat))(new_times)),
        joint_pos=interpolate(new_times, times, clip.joint_pos),
    )


def interpolate(new_times: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Linear interpolation of [frame, ...] along time."""
    flat = values.reshape(len(values), -1)
    columns = [np.interp(new_times, times, column) for column in flat.T]
    return np.stack(columns, axis=-1).reshape(len(new_times), *values.shape[1:])


def configuration(clip: Clip, robot: Robot) -> np.ndarray:
    """MuJoCo's qpos [frame, 7 + joint], joints matched by name."""
    order = [clip.joint_names.index(joint) for joint in robot.joint_names]
    return np.concatenate([clip.root_pos, clip.root_quat, clip.joint_pos[:, order]], axis=-1)


def generalized_velocity(qpos: np.ndarray, fps: float) -> np.ndarray:
    """MuJoCo's qvel [frame, 6 + joint] of qpos: root linear in the world, root angular in the root's frame."""
    world = angular_velocity(qpos[:, 3:7], fps)
    local = rotation(qpos[:, 3:7]).inv().apply(world)
    return np.concatenate([rate(qpos[:, :3], fps), local, rate(qpos[:, 7:], fps)], axis=-1)


def tangent_steps(qpos: np.ndarray) -> np.ndarray:
    """Steps [frame - 1, nv] from each frame's qpos to the next: m and rad, ordered as MuJoCo's qvel."""
    turns = rotation(qpos[:, 3:7])
    angular = (turns[:-1].inv() * turns[1:]).as_rotvec()
    return np.concatenate([np.diff(qpos[:, :3], axis=0), angular, np.diff(qpos[:, 7:], axis=0)], axis=-1)


def body_motion(model: mujoco.MjModel, qpos: np.ndarray, fps: float, body_ids: np.ndarray) -> Bodies:
    """Forward kinematics of a clip.

    Velocities follow from the differenced qpos through the Jacobian (as in mj_objectVelocity), so that a robot reset to
    a frame's joint positions and velocities has exactly the reference's body velocities.
    """
    data = mujoco.MjData(model)
    qvel = generalized_velocity(qpos, fps)
    frames, bodies = len(qpos), len(body_ids)
    pos, quat = np.empty((frames, bodies, 3)), np.empty((frames, bodies, 4))
    spatial, com = np.empty((frames, bodies, 6)), np.empty((frames, 1, 3))  # velocities at the centre of mass
    for frame in range(frames):
        data.qpos[:], data.qvel[:] = qpos[frame], qvel[frame]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        pos[frame], quat[frame] = data.xpos[body_ids], data.xquat[body_ids]
        spatial[frame], com[frame] = data.cvel[body_ids], data.subtree_com[1]
    ang_vel = spatial[..., :3]
    return Bodies(pos, quat, spatial[..., 3:] + np.cross(ang_vel, pos - com), ang_vel)
