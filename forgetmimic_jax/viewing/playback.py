"""A live episode: stepped, pushed and begun again at will, with what it has shown so far."""

from __future__ import annotations

import numpy as np

from forgetmimic_jax.robot.model import Robot
from forgetmimic_jax.viewing.side_by_side import SideBySide, push, reference_qpos

AFTER_END_SECONDS = 2.0  # simulated once every policy's episode has ended


class Playback:
    """The episode of one clip from its first frame on, one robot a policy; the same each time it is begun."""

    def __init__(self, stage: SideBySide, robot: Robot, clip: int = 0, *, seed: int = 0):
        self._stage, self._robot, self._seed = stage, robot, seed
        self.control_step = stage.env.control_step
        self.begin(clip)

    def begin(self, clip: int) -> None:
        """Go to the start of `clip`."""
        self.clip = clip
        self._state = self._stage.begin([clip], [0], self._seed)
        self._reference = reference_qpos(self._robot, self._stage.library, clip)
        self.horizon = int(self._state.horizon[0])
        self.step = 0
        self.qpos = np.asarray(self._state.physics.qpos)  # [policy, nq]
        self.ended: list[int | None] = [None] * len(self._stage.names)  # steps before a bound was broken
        self.tracking: list[np.ndarray] = []  # [step][policy] r̄, zero after the end
        self.height = [self._heights()]  # [step + 1][policy and reference] of the root, m

    def advance(self) -> None:
        """One control step, also for policies whose episode has ended; none past the clip's end."""
        if self.step >= self.horizon:
            return
        self._state, result = self._stage.step(self._state)
        for policy, terminated in enumerate(np.asarray(result.terminated)):
            if terminated and self.ended[policy] is None:
                self.ended[policy] = max(self.step, 1)
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
        """The clip is over, or every policy's episode has been for a while."""
        ends = [ended for ended in self.ended if ended is not None]
        all_lost = len(ends) == len(self.ended) and self.step >= max(ends) + AFTER_END_SECONDS / self.control_step
        return self.step >= self.horizon or all_lost

    def _heights(self) -> np.ndarray:
        return np.append(self.qpos[:, 2], self.reference[2])
