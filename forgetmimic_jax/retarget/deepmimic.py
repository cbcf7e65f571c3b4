"""DeepMimic's text clips: a human of fixed proportions, read into world-frame limb poses with z up.

Format and skeleton: DeepMimic's `humanoid3d.txt` (Peng et al. 2018). Frames of 44 numbers, y up, x forward, z to the
right; (x, y, z) becomes (x, -z, y) here, for positions and for the vector part of quaternions alike.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.kinematics import rotation

NUMBERS = 44
HIP_HALF_WIDTH, THIGH, SHIN = 0.084887, 0.421546, 0.40987
CHEST_HEIGHT, SHOULDER = 0.236151, np.array([-0.02405, 0.18311, 0.2435])  # the left shoulder in the chest's frame
UPPER_ARM, FOREARM = 0.274788, 0.258947
SOLE_DEPTH = 0.05  # of the sole below the ankle
FOOT_FRONT, FOOT_BACK, FOOT_HALF_WIDTH = 0.1335, -0.0435, 0.045  # the foot box about the ankle
LEG_LENGTH = THIGH + SHIN + SOLE_DEPTH
# First column of each joint's value; spherical joints hold a wxyz quaternion local to the parent.
ROOT_POS, ROOT_QUAT, CHEST, NECK = 1, 4, 8, 12
HIP = {"right": 16, "left": 30}
KNEE = {"right": 20, "left": 34}
ANKLE = {"right": 21, "left": 35}
SHOULDER_COLUMN = {"right": 25, "left": 39}
ELBOW = {"right": 29, "left": 43}


@dataclass(frozen=True)
class HumanMotion:
    """A human's frames at uneven times; joint rotations are local to the parent, in z-up axes."""

    name: str
    cyclic: bool
    times: np.ndarray  # [frame] s
    root_pos: np.ndarray  # [frame, 3] m, mid-hip
    rotations: dict[str, Rotation]  # root (world), chest, neck, {left,right}_{hip,knee,ankle,shoulder,elbow}


@dataclass(frozen=True)
class HumanPose:
    """World-frame poses of the human's limbs, [frame, ...], m, z up."""

    frames: dict[str, Rotation]  # pelvis, chest, {side}_{thigh,shin,foot,upper_arm,forearm}
    points: dict[str, np.ndarray]  # pelvis, {side}_{hip,knee,ankle,shoulder,elbow,wrist} [frame, 3]; {side}_sole
    # [frame, 4, 3]: toe left, toe right, heel left, heel right


def read_deepmimic(path: Path) -> HumanMotion:
    """Read a DeepMimic clip.

    Raises:
        InputError: not JSON, no Loop or Frames, a frame without 44 finite numbers, or fewer than two frames.
    """
    if not path.is_file():
        raise InputError(f"{path}: not found")
    try:
        content = json.loads(path.read_text())
    except ValueError as error:
        raise InputError(f"{path}: not a DeepMimic clip, which is JSON ({error})") from error
    if not isinstance(content, dict) or "Frames" not in content:
        raise InputError(f"{path}: missing field 'Frames'; a DeepMimic clip holds Loop and Frames")
    if content.get("Loop") not in ("wrap", "none"):
        raise InputError(f"{path}: Loop: found {content.get('Loop')!r}; 'wrap' or 'none' is needed")
    frames = content["Frames"]
    for row, frame in enumerate(frames):
        if len(frame) != NUMBERS:
            raise InputError(f"{path}: Frames: frame {row} holds {len(frame)} numbers; {NUMBERS} are needed")
    if len(frames) < 2:
        raise InputError(f"{path}: Frames: found {len(frames)}; at least 2 are needed")
    values = np.array(frames, dtype=np.float64)
    if not np.isfinite(values).all():
        raise InputError(f"{path}: Frames: NaN or infinity in frame {np.argwhere(~np.isfinite(values))[0][0]}")

    rotations = {"root": _spherical(values, ROOT_QUAT), "chest": _spherical(values, CHEST)}
    rotations["neck"] = _spherical(values, NECK)
    for side in ("left", "right"):
        rotations[f"{side}_hip"] = _spherical(values, HIP[side])
        rotations[f"{side}_knee"] = _hinge(values, KNEE[side])
        rotations[f"{side}_ankle"] = _spherical(values, ANKLE[side])
        rotations[f"{side}_shoulder"] = _spherical(values, SHOULDER_COLUMN[side])
        rotations[f"{side}_elbow"] = _hinge(values, ELBOW[side])
    return HumanMotion(
        name=path.stem.removeprefix("humanoid3d_"),
        cyclic=content["Loop"] == "wrap",
        times=np.concatenate([[0.0], np.cumsum(values[:-1, 0])]),
        root_pos=_to_z_up(values[:, ROOT_POS : ROOT_POS + 3]),
        rotations=rotations,
    )


def forward_kinematics(motion: HumanMotion) -> HumanPose:
    """Limb poses of every frame. Identity rotations stand upright facing x, arms down."""
    local, root = motion.rotations, motion.rotations["root"]
    chest = root * local["chest"]
    frames = {"pelvis": root, "chest": chest}
    points = {"pelvis": motion.root_pos}
    chest_pos = motion.root_pos + root.apply([0.0, 0.0, CHEST_HEIGHT])
    for side, sign in (("left", 1.0), ("right", -1.0)):
        thigh = root * local[f"{side}_hip"]
        shin = thigh * local[f"{side}_knee"]
        foot = shin * local[f"{side}_ankle"]
        upper_arm = chest * local[f"{side}_shoulder"]
        forearm = upper_arm * local[f"{side}_elbow"]
        hip = motion.root_pos + root.apply([0.0, sign * HIP_HALF_WIDTH, 0.0])
        knee = hip + thigh.apply([0.0, 0.0, -THIGH])
        ankle = knee + shin.apply([0.0, 0.0, -SHIN])
        shoulder = chest_pos + chest.apply(SHOULDER * [1.0, sign, 1.0])
        elbow = shoulder + upper_arm.apply([0.0, 0.0, -UPPER_ARM])
        wrist = elbow + forearm.apply([0.0, 0.0, -FOREARM])
        corners = [[x, y, -SOLE_DEPTH] for x in (FOOT_FRONT, FOOT_BACK) for y in (FOOT_HALF_WIDTH, -FOOT_HALF_WIDTH)]
        frames |= {f"{side}_thigh": thigh, f"{side}_shin": shin, f"{side}_foot": foot}
        frames |= {f"{side}_upper_arm": upper_arm, f"{side}_forearm": forearm}
        points |= {f"{side}_hip": hip, f"{side}_knee": knee, f"{side}_ankle": ankle}
        points |= {f"{side}_shoulder": shoulder, f"{side}_elbow": elbow, f"{side}_wrist": wrist}
        points[f"{side}_sole"] = np.stack([ankle + foot.apply(corner) for corner in corners], axis=1)
    return HumanPose(frames, points)


def _spherical(values: np.ndarray, column: int) -> Rotation:
    quat = values[:, column : column + 4]
    return rotation(np.concatenate([quat[:, :1], _to_z_up(quat[:, 1:])], axis=-1))  # normalises keyframed clips


def _hinge(values: np.ndarray, column: int) -> Rotation:
    """A turn about DeepMimic's local z, which is -y here."""
    return Rotation.from_rotvec(values[:, column, None] * np.array([0.0, -1.0, 0.0]))


def _to_z_up(vectors: np.ndarray) -> np.ndarray:
    return np.stack([vectors[..., 0], -vectors[..., 2], vectors[..., 1]], axis=-1)
