"""Recorded episodes: what several policies did from the same start on, as films and pages show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from forgetmimic_jax.evaluation.metrics import BASE, ZERO_ACTION
from forgetmimic_jax.evaluation.side_by_side import SideBySide
from forgetmimic_jax.motion.library import MotionLibrary
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.tracking.setup import Setup


@dataclass(frozen=True)
class Take:
    """One policy's episode, which runs on after a bound was broken and after the horizon."""

    qpos: np.ndarray  # [step + 1, nq] from the start on
    tracking_reward: np.ndarray  # [horizon] r̄; what is past `ended` does not count
    ended: int | None  # steps before a bound was broken; None: it reached the horizon
    fell: int | None  # steps to the first fall; None: the robot stayed upright
    impact: np.ndarray  # [step] body weights, the floor's largest force on a body that is no foot

    @property
    def survival_weighted_tracking(self) -> float:
        """(1/H) Σ_{t<τ} r̄_t: zeros after the end (the evaluation's primary number)."""
        return float(self.tracking_reward[: self.ended].sum() / len(self.tracking_reward))


@dataclass(frozen=True)
class Episode:
    """The takes of one clip, policy by policy, and the reference they were to follow."""

    clip: str
    target: bool  # the clip is to be forgotten
    fps: float  # control steps a second
    reference: np.ndarray  # [step + 1, nq]
    takes: Mapping[str, Take]


def in_words(
    policy: str, *, target: bool, ended: float | None, fell: float | None, now: float, impact: float
) -> tuple[str, str]:
    """What has become of an episode so far: whether the policy follows the clip, and whether the robot stands.

    Args:
        policy: its name.
        target: the clip is to be forgotten.
        ended: s, when a bound was broken; None: none was.
        fell: s, of the first fall; None: the robot is upright.
        now: s since the start.
        impact: body weights, the largest so far.
    """
    forgets = target and policy not in (BASE, ZERO_ACTION)
    follows = "" if ended is None else f"{'forgets' if forgets else 'leaves'} the motion at {ended:.2f} s"
    stands = f"stands {now:.2f} s" if fell is None else f"falls at {fell:.2f} s"
    return follows, stands + (f", impact {impact:.1f} times its weight" if impact > 0.0 else "")


def at(episode: Episode, policy: str, step: int) -> tuple[str, str]:
    """What has become of a policy's episode after so many steps; see `in_words`."""
    take = episode.takes[policy]

    def seconds(steps: int | None) -> float | None:
        return None if steps is None or steps > step else steps / episode.fps

    return in_words(
        policy,
        target=episode.target,
        ended=seconds(take.ended),
        fell=seconds(take.fell),
        now=step / episode.fps,
        impact=float(take.impact[:step].max(initial=0.0)),
    )


def reference_qpos(robot: Robot, library: MotionLibrary, clip: int) -> np.ndarray:
    """A clip as configurations [frame, nq] of the robot."""
    frames = library.clip(clip)
    return np.concatenate([frames.bodies.pos[:, robot.root], frames.bodies.quat[:, robot.root], frames.joint_pos], -1)


def record(
    setup: Setup,
    policies: Mapping[str, Policy | None],
    clips: Sequence[str],
    targets: Sequence[str] = (),
    *,
    seed: int = 0,
) -> list[Episode]:
    """One episode of each clip from its first frame on, for every policy.

    Until a bound is broken they are those of an `Evaluator` with one a clip, but for contacts of the robot with itself.
    A target runs on after its horizon.

    Args:
        setup: whose robot, clips, physics, rewards and bounds hold; the evaluation's changes are made here.
        policies: name → networks; None for the zero action.
        clips: names of clips of the library.
        targets: clips to forget.
        seed: of the reset noise.
    """
    robot, library = setup.robot, setup.library
    every = np.arange(len(library.names))  # the noise of a clip's start does not depend on which clips are chosen
    chosen = [library.names.index(clip) for clip in clips]
    stage = SideBySide(setup, policies, starts=len(every))
    state = stage.begin(every, np.zeros_like(every), seed)
    horizon = np.asarray(state.horizon)
    hold = np.tile([stage.hold if name in targets else 0 for name in library.names], len(stage.names))
    poses, rewards, impacts = [np.asarray(state.physics.qpos)], [], []
    ended, fell = np.full((2, len(horizon)), -1)
    for step in range(int((horizon + hold)[chosen].max())):
        state, result, happened = stage.step(state)
        poses.append(np.asarray(state.physics.qpos))
        rewards.append(np.asarray(result.reward.normalized_tracking))
        impacts.append(np.asarray(happened.impact))
        now = np.asarray(result.terminated) & (ended < 0) & (step < horizon)
        ended[now] = max(step, 1)  # as the evaluation counts: the step that breaks a bound does not count
        fell[np.asarray(happened.fallen) & (fell < 0) & (step < horizon + hold)] = step + 1
    qpos, tracking_reward, impact = (np.stack(series, axis=1) for series in (poses, rewards, impacts))

    def take(row: int) -> Take:
        steps = horizon[row] + hold[row]
        return Take(
            qpos=qpos[row, : steps + 1],
            tracking_reward=tracking_reward[row, : horizon[row]],
            ended=None if ended[row] < 0 else int(ended[row]),
            fell=None if fell[row] < 0 else int(fell[row]),
            impact=impact[row, :steps],
        )

    def reference(clip: int) -> np.ndarray:
        frames = reference_qpos(robot, library, clip)
        return frames[np.minimum(np.arange(horizon[clip] + hold[clip] + 1), len(frames) - 1)]

    return [
        Episode(
            clip=library.names[clip],
            target=library.names[clip] in targets,
            fps=1.0 / stage.env.control_step,
            reference=reference(clip),
            takes={policy: take(i * len(every) + clip) for i, policy in enumerate(stage.names)},
        )
        for clip in chosen
    ]


def facing(qpos: np.ndarray) -> float:
    """Direction of the root's x axis over the floor, rad, of a configuration [nq]."""
    forward = Rotation.from_quat(qpos[3:7], scalar_first=True).apply([1.0, 0.0, 0.0])
    return float(np.arctan2(forward[1], forward[0]))
