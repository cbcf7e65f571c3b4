"""Near-duplicates of a clip: the same motion at another speed, mirrored, larger, turned, noisy, in part, or blended.

A policy that forgot a motion does none of them. A filter that recognises the clip itself lets most of them through.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from forgetmimic_jax.attacks.case import Case
from forgetmimic_jax.attacks.document import Compared, NearDuplicates
from forgetmimic_jax.attacks.performance import Performance, not_followed
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.fit import lowest_points
from forgetmimic_jax.motion.kinematics import heading, quaternion, resample, rotation
from forgetmimic_jax.motion.mirror import mirrored
from forgetmimic_jax.robot.model import Robot

SPEEDS = (0.75, 0.9, 1.1, 1.25)
AMPLITUDES = (0.8, 1.2)
TURN = np.pi / 2  # rad
NOISE = 0.05  # rad, root mean square of every joint's noise
CUT_OFF = 2.0  # Hz, of the noise
BLEND = 0.75  # share of the clip in its blend with another
FOLLOWED = 0.5  # of the base's tracking on the original: below it a variant is dropped
KEPT_SPEEDS = (0.9, 1.1)

Families = Mapping[str, list[Clip]]


def near_duplicates(robot: Robot, clip: Clip, other: Clip, seed: int = 0) -> Families:
    """Every near-duplicate of a clip by its family, each named CLIP_FAMILY or CLIP_FAMILY_AMOUNT.

    Those whose legs move otherwise are raised or lowered as a whole, so that their feet are as far from the floor as
    the clip's.

    Args:
        robot: whose clip it is.
        clip: at the control rate.
        other: a clip at the same rate for the blend, a kept one.
        seed: of the noise.
    """
    return {
        "speed": [at_speed(clip, factor) for factor in SPEEDS],
        "mirrored": [mirrored(robot, clip)],
        "amplitude": [as_high(robot, with_amplitude(robot, clip, factor), clip) for factor in AMPLITUDES],
        "turned": [turned(clip, TURN)],
        "noise": [as_high(robot, with_noise(robot, clip, NOISE, CUT_OFF, seed), clip)],
        "half": [first_half(clip), second_half(clip)],
        "blended": [as_high(robot, blended(clip, other, BLEND), clip)],
    }


def at_speed(clip: Clip, factor: float) -> Clip:
    """The clip played `factor` times as fast, at the same rate."""
    faster = resample(dataclasses.replace(clip, fps=clip.fps * factor), clip.fps)
    return dataclasses.replace(faster, name=f"{clip.name}_speed_{factor:g}")


def with_amplitude(robot: Robot, clip: Clip, factor: float) -> Clip:
    """Every joint `factor` times as far from its mean over the clip, inside the robot's limits; the root as it was."""
    mean = clip.joint_pos.mean(axis=0)
    return _with_joints(robot, clip, mean + factor * (clip.joint_pos - mean), f"amplitude_{factor:g}")


def turned(clip: Clip, angle: float) -> Clip:
    """The clip turned by `angle` rad about the vertical through the world's origin."""
    turn = Rotation.from_euler("z", angle)
    return dataclasses.replace(
        clip,
        name=f"{clip.name}_turned",
        root_pos=turn.apply(clip.root_pos),
        root_quat=quaternion(turn * rotation(clip.root_quat)),
    )


def with_noise(robot: Robot, clip: Clip, size: float, cut_off: float, seed: int) -> Clip:
    """Slow noise on every joint, inside the robot's limits.

    Args:
        robot: whose clip it is.
        clip: any.
        size: root mean square over the frames of each joint's noise, rad.
        cut_off: standard deviation, in Hz, of the Gaussian low-pass filter.
        seed: of the noise.
    """
    white = np.random.default_rng(seed).standard_normal(clip.joint_pos.shape)
    noise = gaussian_filter1d(white, clip.fps / (2.0 * np.pi * cut_off), axis=0, mode="nearest")
    noise *= size / np.sqrt((noise**2).mean(axis=0))
    return _with_joints(robot, clip, clip.joint_pos + noise, "noise")


def part(clip: Clip, first: int, end: int, name: str) -> Clip:
    """The frames first ≤ frame < end, named CLIP_`name`."""
    return dataclasses.replace(clip.part(first, end), name=f"{clip.name}_{name}")


def first_half(clip: Clip) -> Clip:
    """The frames before the middle."""
    return part(clip, 0, clip.num_frames // 2, "first_half")


def second_half(clip: Clip) -> Clip:
    """The frames from the middle on."""
    return part(clip, clip.num_frames // 2, clip.num_frames, "second_half")


def blended(clip: Clip, other: Clip, share: float) -> Clip:
    """`share` of the clip and the rest of another one, frame by frame, as long as the shorter of the two.

    The other clip first gets the place and the heading that the clip starts with. Positions and joint angles are mixed
    linearly, orientations by slerp.
    """
    frames = min(clip.num_frames, other.num_frames)
    ours = part(clip, 0, frames, "blended")
    theirs = placed(part(other, 0, frames, ""), ours.root_pos[0], ours.root_quat[0])
    order = [other.joint_names.index(joint) for joint in clip.joint_names]
    between = rotation(ours.root_quat).inv() * rotation(theirs.root_quat)
    return dataclasses.replace(
        ours,
        root_pos=share * ours.root_pos + (1.0 - share) * theirs.root_pos,
        root_quat=quaternion(rotation(ours.root_quat) * Rotation.from_rotvec((1.0 - share) * between.as_rotvec())),
        joint_pos=share * ours.joint_pos + (1.0 - share) * theirs.joint_pos[:, order],
    )


def placed(clip: Clip, pos: np.ndarray, quat: np.ndarray) -> Clip:
    """The clip moved so that its first frame has the x and y of `pos` [3] and the heading of `quat` [4]."""
    turn = Rotation.from_euler("z", heading(quat) - heading(clip.root_quat[0]))
    start = clip.root_pos[0] * [1.0, 1.0, 0.0]
    return dataclasses.replace(
        clip,
        root_pos=turn.apply(clip.root_pos - start) + np.asarray(pos) * [1.0, 1.0, 0.0],
        root_quat=quaternion(turn * rotation(clip.root_quat)),
    )


def as_high(robot: Robot, variant: Clip, clip: Clip) -> Clip:
    """The variant raised or lowered as a whole, so that its soles are as far from the ground as the clip's.

    The lowest fifth of the frames' lowest sole points decides.
    """
    ours = np.quantile(lowest_points(robot, clip, soles=True), 0.2)
    theirs = np.quantile(lowest_points(robot, variant, soles=True), 0.2)
    return dataclasses.replace(variant, root_pos=variant.root_pos + np.array([0.0, 0.0, ours - theirs]))


def _with_joints(robot: Robot, clip: Clip, joint_pos: np.ndarray, name: str) -> Clip:
    order = [robot.joint_names.index(joint) for joint in clip.joint_names]
    limited = np.clip(joint_pos, robot.joint_lower[order], robot.joint_upper[order])
    return dataclasses.replace(clip, name=f"{clip.name}_{name}", joint_pos=limited)


def attack(case: Case) -> NearDuplicates:
    """Every near-duplicate of the targets, and a few of the kept clips, by every policy."""
    robot, clips = case.setup.robot, case.clips
    families: dict[str, list[str]] = {}
    originals: dict[str, str] = {}
    made: list[Clip] = []
    for target in case.targets:
        blended_with = clips[case.nearest[target][0]]
        for family, variants in near_duplicates(robot, clips[target], blended_with, case.seed).items():
            families[f"{target}, {family}"] = [variant.name for variant in variants]
            originals |= {variant.name: target for variant in variants}
            made += variants
    performance = case.stage(made, case.scale.variant_episodes).perform(case.everyone)
    dropped = not_followed(performance, case.on_targets, originals, FOLLOWED)
    kept, kept_dropped = _of_kept(case)
    return NearDuplicates(
        families=_compared(case, performance, families, dropped),
        variants=case.by_clip(performance, [name for name in originals if name not in dropped]),
        dropped=dropped | kept_dropped,
        kept=kept,
    )


def _of_kept(case: Case) -> tuple[dict[str, Compared], dict[str, float]]:
    """The kept clips at other speeds and with noise: a policy that falls on all that is unfamiliar cannot do them."""
    robot = case.setup.robot
    families: dict[str, list[str]] = {"speed": [], "noise": []}
    originals: dict[str, str] = {}
    made: list[Clip] = []
    for name in case.kept:
        clip = case.clips[name]
        variants = {"speed": [at_speed(clip, factor) for factor in KEPT_SPEEDS]}
        variants["noise"] = [as_high(robot, with_noise(robot, clip, NOISE, CUT_OFF, case.seed), clip)]
        for family, those in variants.items():
            families[family] += [variant.name for variant in those]
            originals |= {variant.name: name for variant in those}
            made += those
    performance = case.stage(made, case.scale.kept_variant_episodes).perform(case.everyone)
    dropped = not_followed(performance, case.on_library, originals, FOLLOWED)
    return _compared(case, performance, families, dropped), dropped


def _compared(
    case: Case, performance: Performance, families: Mapping[str, list[str]], dropped: Mapping[str, float]
) -> dict[str, Compared]:
    """The numbers of each family over the variants that are left."""
    left = {family: [name for name in names if name not in dropped] for family, names in families.items()}
    return {family: case.compare(performance, names) for family, names in left.items() if names}
