"""What a rollout leaves: the steps that PPO learns from, and what the sampler and the log learn from."""

from __future__ import annotations

from flax import struct
from jax import Array


@struct.dataclass
class Transition:
    """Steps of a rollout, as the losses need them. Leading dimensions: time, env."""

    actor_observation: Array
    critic_observation: Array
    action: Array
    log_prob: Array  # of the action when it was taken
    mean: Array  # mean action of the policy that took it
    clip: Array  # i32 the motion that the step tracked
    taught: Array | None = None  # the teacher's action, where the rule has a teacher


@struct.dataclass
class Outcome:
    """What followed each simulated step. Leading dimensions: time, env."""

    reward: Array  # R' × control step
    value: Array  # V(s_t)
    next_value: Array  # V of the state reached, before any reset; meaningless where the episode terminated
    tracking: Array  # R_track
    regularisation: Array  # R_reg
    normalized_tracking: Array  # r̄
    terminated: Array  # bool
    truncated: Array  # bool
    diverged: Array  # bool
    start_bin: Array  # i32 of the episode
    failure: Array  # f_episode, meaningful where the episode ended
    steps: Array  # i32 of the episode so far, meaningful where it ended
    wrench_gain: Array
    causes: dict[str, Array]  # bool, which bound ended the episode

    @property
    def done(self) -> Array:
        """bool[time, env] the episode ended here."""
        return self.terminated | self.truncated
