from collections.abc import Callable

import numpy as np
import pytest

from forgetmimic_jax.evaluation.metrics import Rollout


@pytest.fixture
def make_rollout() -> Callable[..., Rollout]:
    """A rollout whose tracking reward and error are constant within an episode, and garbage after its end."""

    def make(
        clip: list[int], horizon: list[int], length: list[int], reward: list[float], error: list[float] | None = None
    ) -> Rollout:
        steps = max(horizon) + 2
        alive = np.arange(steps) < np.array(length)[:, None]
        error = [0.0] * len(clip) if error is None else error
        return Rollout(
            clip=np.array(clip),
            start_frame=np.zeros(len(clip), int),
            horizon=np.array(horizon),
            length=np.array(length),
            tracking_reward=np.where(alive, np.array(reward)[:, None], np.nan),
            errors={"mpkpe": np.where(alive, np.array(error)[:, None], np.inf)},
        )

    return make
