"""A second of one clip inside another: does a forbidden second appear there, and does a kept one survive?

A splice is a lead of the host, the inserted frames, and the host again. Each piece starts where the one before it
ended, in place and heading, and what differs at a seam fades away.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from forgetmimic_jax.attacks.case import Case
from forgetmimic_jax.attacks.document import Compared, Splices
from forgetmimic_jax.attacks.near_duplicates import FOLLOWED, part, placed
from forgetmimic_jax.attacks.performance import compare, not_followed
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.kinematics import quaternion, rotation

INSERTED = 1.0  # s, of the middle of the clip that is inserted
LEAD = 1.0  # s of the host before the insertion, and after it
FADE = 0.2  # s


@dataclass(frozen=True)
class Splice:
    """A host with another clip's middle second in it."""

    clip: Clip
    first: int  # frame of the inserted part that is past its fade-in
    end: int  # frame after the last of the inserted part


def splice(host: Clip, guest: Clip) -> Splice:
    """The middle second of `guest` inside `host`, where the host's pose is most like the second's two ends.

    Args:
        host: at the same rate and of the same joints.
        guest: a shorter one is inserted whole.
    """
    inserted = middle(guest, INSERTED)
    cut = best_cut(host, inserted)
    lead = round(LEAD * host.fps)
    before = part(host, max(0, cut - lead), cut, "before")
    after = part(host, cut, min(host.num_frames, cut + lead), "after")
    fade = round(FADE * host.fps)
    whole = joined(joined(before, inserted, fade), after, fade)
    begin = before.num_frames
    return Splice(
        dataclasses.replace(whole, name=f"{guest.name}_in_{host.name}"),
        first=begin + min(fade, inserted.num_frames - 1),
        end=begin + inserted.num_frames,
    )


def middle(clip: Clip, seconds: float) -> Clip:
    """The `seconds` around the middle of a clip; all of a shorter clip."""
    frames = min(clip.num_frames, round(seconds * clip.fps))
    first = (clip.num_frames - frames) // 2
    return part(clip, first, first + frames, "middle")


def best_cut(host: Clip, inserted: Clip) -> int:
    """The frame before which the inserted clip fits best: the least squared joint difference at the two seams.

    Before and after it the host has a quarter of its frames or more.
    """
    order = [host.joint_names.index(joint) for joint in inserted.joint_names]
    joints = host.joint_pos[:, order]
    margin = max(2, host.num_frames // 4)
    cuts = np.arange(margin, max(margin + 1, host.num_frames - margin))
    into = ((joints[cuts - 1] - inserted.joint_pos[0]) ** 2).sum(axis=-1)
    out = ((joints[cuts] - inserted.joint_pos[-1]) ** 2).sum(axis=-1)
    return int(cuts[np.argmin(into + out)])


def joined(one: Clip, other: Clip, fade: int) -> Clip:
    """One clip and then another, which starts at the last pose of the first.

    The other clip is moved to the place and heading of the first's last frame. What still differs there, in height,
    tilt and joints, is added to its first `fade` frames with a weight that falls from 1 to 0 (a cubic step).
    """
    other = placed(other, one.root_pos[-1], one.root_quat[-1])
    order = [other.joint_names.index(joint) for joint in one.joint_names]
    joints = other.joint_pos[:, order]
    time = np.clip(np.arange(other.num_frames) / max(fade, 1), 0.0, 1.0)
    weight = (1.0 - time**2 * (3.0 - 2.0 * time))[:, None]
    tilt = (rotation(one.root_quat[-1]) * rotation(other.root_quat[0]).inv()).as_rotvec()
    return dataclasses.replace(
        one,
        root_pos=np.concatenate([one.root_pos, other.root_pos + weight * (one.root_pos[-1] - other.root_pos[0])]),
        root_quat=quaternion(
            Rotation.concatenate(
                [rotation(one.root_quat), Rotation.from_rotvec(weight * tilt) * rotation(other.root_quat)]
            )
        ),
        joint_pos=np.concatenate([one.joint_pos, joints + weight * (one.joint_pos[-1] - joints[0])]),
    )


def attack(case: Case) -> Splices:
    """Target seconds inside kept clips, and kept seconds inside targets, by every policy."""
    clips = case.clips
    pairs = [(host, target) for target in case.targets for host in case.nearest[target][: case.scale.hosts]]
    made = {"forbidden": [splice(clips[host], clips[target]) for host, target in pairs]}
    made["kept"] = [splice(clips[target], clips[host]) for host, target in pairs]
    every = made["forbidden"] + made["kept"]
    hosts = [host for host, _ in pairs] + [target for _, target in pairs]
    stage = case.stage([one.clip for one in every], case.scale.variant_episodes, from_start=True)
    performance = stage.perform(case.everyone)
    originals = {one.clip.name: host for one, host in zip(every, hosts, strict=True)}
    dropped = not_followed(performance, case.on_library, originals, FOLLOWED)
    # The step t tracks the frame t + 1.
    first = np.array([one.first for one in every])[performance.clip] - 1
    end = np.array([one.end for one in every])[performance.clip] - 1

    def compared(splices: list[Splice]) -> Compared:
        members = performance.of([one.clip.name for one in splices if one.clip.name not in dropped])
        if not members.any():
            return {}
        return compare(performance, members, against=case.against, seed=case.seed, window=(first, end))

    return Splices(
        forbidden=compared(made["forbidden"]),
        kept=compared(made["kept"]),
        splices={one.clip.name: compared([one]) for one in every if one.clip.name not in dropped},
        dropped=dropped,
    )
