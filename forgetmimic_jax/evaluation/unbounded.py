"""What a robot does instead of a clip that its policy forgot: rollouts that no termination ends, and their numbers.

Each target clip is played to the end of the episode's horizon and `HOLD_SECONDS` longer. A robot that lies on the floor
stays in the simulation. `docs/method.md` defines the numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax
import msgspec
import numpy as np

from forgetmimic_jax.evaluation import statistics
from forgetmimic_jax.evaluation.document import GroupResult, PolicyResult, UnboundedNumbers, UnboundedResult
from forgetmimic_jax.evaluation.metrics import LOWEST_CONTENT
from forgetmimic_jax.evaluation.rollout import Acting, episode_starts
from forgetmimic_jax.evaluation.side_by_side import Happened, SideBySide
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.tracking.stand import low

ATTEMPT = 0.3  # motion content above which an episode attempts the clip
# Root mean square over steps and key bodies, m: where the rest of a clip is nearer than this to the stand, it has no
# movement to reproduce, and motion content is undefined.
SMALLEST_MOVEMENT = 0.05


@dataclass(frozen=True)
class UnboundedRollout:
    """E episodes of one policy. T is the longest episode's number of control steps; what is past an end is unread."""

    clip: np.ndarray  # i[E] index into the library's names
    start_frame: np.ndarray  # i[E]
    horizon: np.ndarray  # i[E] steps until the reference is held
    steps: np.ndarray  # i[E] all steps of the episode
    control_step: float  # s
    lying_at_start: np.ndarray  # bool[E]
    happened: Happened  # numpy arrays [E, T]


def roll_out(
    setup: Setup, policies: Mapping[str, Acting | None], targets: Sequence[str], *, episodes: int, seed: int
) -> dict[str, UnboundedRollout]:
    """Every policy on the same episodes of the targets.

    Args:
        setup: robot, clips and settings.
        policies: by name; None for the zero action.
        targets: names of clips.
        episodes: a clip: half from frame 0, half spread over it.
        seed: of the start frames and the reset noise.
    """
    library, robot = setup.library, setup.robot
    chosen = np.array([library.names.index(target) for target in targets])
    index, frame = episode_starts(np.asarray(library.length)[chosen], episodes, seed)
    clip = chosen[index]
    stage = SideBySide(setup, policies, starts=len(clip))
    state = stage.begin(clip, frame, seed)
    horizon = np.asarray(state.horizon)
    lying = np.asarray(low(robot, state.bodies))
    steps = []
    for _ in range(int(horizon.max()) + stage.hold):
        state, _, happened = stage.step(state)
        steps.append(happened)
    series = jax.tree.map(lambda *values: np.stack(values, axis=-1), *steps)
    return {
        policy: UnboundedRollout(
            clip=clip,
            start_frame=frame,
            horizon=horizon[rows],
            steps=horizon[rows] + stage.hold,
            control_step=stage.env.control_step,
            lying_at_start=lying[rows],
            happened=jax.tree.map(lambda values: values[rows], series),  # noqa: B023
        )
        for policy, rows in zip(stage.names, np.split(np.arange(len(horizon)), len(stage.names)), strict=True)
    }


def episode_numbers(rollout: UnboundedRollout) -> dict[str, np.ndarray]:
    """Numbers of each episode, f[E] each; NaN where one is undefined.

    `upright_rate`, `safe_rate` and `time_to_fall` are undefined for a robot that starts lying; `impact_speed` where no
    body but the feet touches the floor; `motion_content` and `attempt_rate` where the rest of the clip hardly moves.
    """
    happened = rollout.happened
    steps = np.arange(happened.fallen.shape[1])
    during = steps < rollout.steps[:, None]
    of_clip = steps < rollout.horizon[:, None]

    def largest(values: np.ndarray) -> np.ndarray:
        return np.where(during, values, 0).max(axis=1).astype(float)

    def mean(values: np.ndarray, where: np.ndarray = during) -> np.ndarray:
        return np.where(where, values, 0.0).sum(axis=1) / where.sum(axis=1)

    falls = happened.fallen & during
    upright = ~falls.any(axis=1)
    steps_to_fall = np.where(upright, rollout.steps, falls.argmax(axis=1) + 1)
    impact = largest(happened.impact)
    landed = during & (happened.impact_speed != 0.0)
    first = np.take_along_axis(happened.impact_speed, landed.argmax(axis=1)[:, None], axis=1)[:, 0]
    movement = mean(happened.movement, of_clip)
    moves = movement >= SMALLEST_MOVEMENT**2
    content = 1.0 - mean(happened.deviation, of_clip) / np.where(moves, movement, np.nan)
    stood = ~rollout.lying_at_start
    return {
        "upright_rate": np.where(stood, upright, np.nan),
        "safe_rate": np.where(stood, upright & (impact <= 1.0), np.nan),
        "time_to_fall": np.where(stood, steps_to_fall * rollout.control_step, np.nan),
        "impact_force": impact,
        "impact_rate": (impact > 1.0).astype(float),
        "impact_speed": np.where(landed.any(axis=1), first, np.nan),
        "head_contact_rate": largest(happened.head_contact),
        "hand_contact_rate": largest(happened.hand_contact),
        "torque_saturation": mean(happened.torque_saturation),
        "joint_limit_violation": mean(happened.joint_limit_violation),
        "joint_speed_violation": mean(happened.joint_speed_violation),
        "motion_content": np.maximum(content, LOWEST_CONTENT),
        "attempt_rate": np.where(moves, content > ATTEMPT, np.nan),
    }


def add_numbers(
    policies: Mapping[str, PolicyResult], rollouts: Mapping[str, UnboundedRollout], names: Sequence[str], *, seed: int
) -> None:
    """Put what every policy did into its results: those of each target clip, and of all targets.

    Args:
        policies: results by name.
        rollouts: of the same policies.
        names: clip names of the library, which `UnboundedRollout.clip` indexes.
        seed: of the bootstrap.
    """
    for policy, rollout in rollouts.items():
        result, numbers = policies[policy], episode_numbers(rollout)
        groups: list[tuple[GroupResult | None, np.ndarray]] = [(result.target, np.ones(len(rollout.clip), bool))]
        groups += [(result.clips[names[clip]], rollout.clip == clip) for clip in np.unique(rollout.clip)]
        for group, members in groups:
            assert group is not None
            group.unbounded = UnboundedResult(
                all_starts=estimates(numbers, rollout.clip, members, seed),
                from_frame_0=estimates(numbers, rollout.clip, members & (rollout.start_frame == 0), seed),
            )


def estimates(numbers: Mapping[str, np.ndarray], clip: np.ndarray, members: np.ndarray, seed: int) -> UnboundedNumbers:
    """Every number over the episodes bool[E] where it is defined."""
    found: dict[str, statistics.PlainEstimate] = {}
    for name, every in numbers.items():
        defined = members & np.isfinite(every)
        if not defined.any():
            continue
        values = every[defined]
        if name.endswith("_rate"):
            found[name] = statistics.rate(int(values.sum()), len(values))
            continue
        weights = statistics.resampling_weights(clip[defined], seed=seed)
        if name == "impact_force":
            found["impact_force_median"] = statistics.bootstrap_quantile(values, weights, 0.5)
            found["impact_force_95"] = statistics.bootstrap_quantile(values, weights, 0.95)
        else:
            found[name] = statistics.bootstrap_mean(values, weights)
    return msgspec.convert(found, UnboundedNumbers)
