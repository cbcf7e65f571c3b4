"""A live episode: stepped, pushed and begun again at will, with what it has shown so far."""

from __future__ import annotations

import numpy as np

from forgetmimic_jax.evaluation.side_by_side import SideBySide, push
from forgetmimic_jax.viewing.takes import reference_qpos


class Playback:
    """The episode of one clip from its first frame on, one robot a policy; the same each time it is begun.

    It runs on after a bound was broken, and for some seconds after the clip's end with the last frame held.
    """

    def __init__(self, stage: SideBySide, clip: int = 0, *, seed: int = 0):
        self._stage, self._seed = stage, seed
        self.robot, self.policies, self.clips = stage.env.robot, stage.names, stage.library.names
        self.control_step = stage.env.control_step
        self.begin(clip)

    def begin(self, clip: int) -> None:
        """Go to the start of `clip`."""
        self.clip = clip
        self._state = self._stage.begin([clip], [0], self._seed)
        self._reference = reference_qpos(self.robot, self._stage.library, clip)
        self.horizon = int(self._state.horizon[0])
        self.last_step = self.horizon + self._stage.hold
        self.step = 0
        self.qpos = np.asarray(self._state.physics.qpos)  # [policy, nq]
        self.ended: list[int | None] = [None] * len(self.policies)  # steps before a bound was broken
        self.fell: list[int | None] = [None] * len(self.policies)  # steps to the first fall
        self.impact = np.zeros(len(self.policies))  # body weights, the largest on a body that is no foot
        self.tracking: list[np.ndarray] = []  # [step][policy] r̄, zero after the end
        self.height = [self._heights()]  # [step + 1][policy and reference] of the root, m

    def advance(self) -> None:
        """One control step, also for policies that broke a bound; none past the last step."""
        if self.done:
            return
        self._state, result, happened = self._stage.step(self._state)
        for policy, terminated in enumerate(np.asarray(result.terminated)):
            if terminated and self.ended[policy] is None and self.step < self.horizon:
                self.ended[policy] = max(self.step, 1)
        for policy, falls in enumerate(np.asarray(happened.fallen)):
            if falls and self.fell[policy] is None:
                self.fell[policy] = self.step + 1
        self.impact = np.maximum(self.impact, happened.impact)
        alive = np.array([ended is None for ended in self.ended])
        self.tracking.append(np.where(alive, np.asarray(result.reward.normalized_tracking), 0.0))
        self.step += 1
        self.qpos = np.asarray(self._state.physics.qpos)
        self.height.append(self._heights())

    def push(self, velocity: np.ndarray) -> None:
        """Every robot's root gets `velocity` [3] m/s on top of its own."""
        self._state = push(self._state, velocity)

    @property
    def reference(self) -> np.ndarray:
        """The configuration [nq] to be at now."""
        return self._reference[min(self.step, len(self._reference) - 1)]

    @property
    def start(self) -> np.ndarray:
        """The configuration [nq] that the clip starts from."""
        return self._reference[0]

    @property
    def done(self) -> bool:
        """The clip is over, and its last frame was held long enough."""
        return self.step >= self.last_step

    def _heights(self) -> np.ndarray:
        return np.append(self.qpos[:, 2], self.reference[2])
