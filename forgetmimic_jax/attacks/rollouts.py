"""Roll policies out on given episodes to each clip's end, whether they fall or not.

The simulation is the evaluation's. A termination ends what counts as tracking. Motion content counts what comes after
it too, so the robot is simulated until its clip's end.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import numpy as np
from jax import Array

from forgetmimic_jax.attacks.performance import Performance
from forgetmimic_jax.evaluation.rollout import CHUNK, Acting, act, episode_starts, evaluation_setup, make_begin
from forgetmimic_jax.evaluation.side_by_side import distances
from forgetmimic_jax.motion.clip import Clip
from forgetmimic_jax.motion.library import Frames, build_library
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.env import Assets, EnvState
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.tracking.stand import stand_frame


class Stage:
    """Episodes of some clips. Compiled once, used for any number of policies, which all meet the same episodes."""

    def __init__(self, setup: Setup, clips: Sequence[Clip], *, episodes: int, seed: int, from_start: bool = False):
        """Choose the episodes.

        Args:
            setup: robot and settings; its library is not used.
            clips: at the control rate.
            episodes: a clip; half from frame 0, half spread over the clip.
            seed: of the start frames and the reset noise.
            from_start: every episode starts at frame 0.
        """
        library = build_library(setup.robot, clips)
        setup = evaluation_setup(dataclasses.replace(setup, library=library, base=None))
        self.names = library.names
        self.clip, self.start_frame = episode_starts(np.asarray(library.length), episodes, seed)
        if from_start:
            self.start_frame = np.zeros_like(self.start_frame)
        self._seed = seed
        self._env = tracking.make_environment(setup, len(self.clip), noisy=False)
        self._assets, self._stand = tracking.make_assets(setup), stand_frame(setup.robot)
        self._begin = make_begin(self._env, self.clip, self.start_frame)
        self._advance = jax.jit(self._advance_chunk)

    def perform(self, policies: Mapping[str, Acting | None]) -> Performance:
        """Every policy, by name, in every episode; None is the zero action."""
        seen = {name: self._roll_out(policy) for name, policy in policies.items()}
        horizon = next(iter(seen.values()))["horizon"]
        steps = np.arange(int(horizon.max()))
        length = {}
        for name, series in seen.items():
            ended = series["terminated"] & (steps < horizon[:, None])
            # A robot that terminates in its first step has done one: no length is 0.
            length[name] = np.where(ended.any(axis=1), np.maximum(ended.argmax(axis=1), 1), horizon)
        return Performance(
            names=self.names,
            clip=self.clip,
            start_frame=self.start_frame,
            horizon=horizon,
            length=length,
            tracking={name: series["tracking"] for name, series in seen.items()},
            deviation={name: series["deviation"] for name, series in seen.items()},
            movement=next(iter(seen.values()))["movement"],
        )

    def _roll_out(self, policy: Acting | None) -> dict[str, np.ndarray]:
        """The series [E, T] of one policy, and the horizons [E]."""
        state = self._begin(self._assets, jax.random.PRNGKey(self._seed))
        horizon = np.asarray(state.horizon)
        records = []
        for _ in range(0, int(horizon.max()), CHUNK):
            state, record = self._advance(self._assets, self._stand, policy, state)
            records.append(jax.device_get(record))
        together = {name: np.concatenate([record[name] for record in records]).T for name in records[0]}
        return {"horizon": horizon} | {name: values[:, : int(horizon.max())] for name, values in together.items()}

    def _advance_chunk(self, assets: Assets, stand: Frames, policy: Acting | None, state: EnvState):
        env = self._env

        def one_step(state: EnvState, key: Array):
            observation = tracking.observe(env, assets, state, None)[0]
            state, result = tracking.step(env, assets, state, act(env, policy, observation), key)
            record = {"terminated": result.terminated, "tracking": result.reward.normalized_tracking}
            return state, record | distances(env.robot, stand, result.pair)

        return jax.lax.scan(one_step, state, jax.random.split(jax.random.PRNGKey(0), CHUNK))
