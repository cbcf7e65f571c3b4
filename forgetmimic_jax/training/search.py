"""A first success: actions that pass the frame at which a policy fails.

A policy that never completes a clip gets no signal from it. The search starts some steps before the failure and varies
what is added to the policy's actions, as knots joined by straight lines, by the cross-entropy method (Rubinstein 1999).
First it finds a way without reset noise, then it continues with reset noise, so that what it found does not depend on
one state. The rollouts that pass become lessons for `training.distil`.

If the search finds a way, the clip is feasible. If it finds none, the clip may be infeasible, or the search too small.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.ppo.gae import generalized_advantages
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.env import Assets, Environment, EnvState
from forgetmimic_jax.tracking.rsi import Start
from forgetmimic_jax.training.teaching import Lesson


@dataclass(frozen=True)
class SearchConfig:
    """Size of the search, in control steps and units of action. A robot of the environment is a rollout of a round."""

    before: int = 25  # steps before the failure at which it starts
    window: int = 45  # steps whose actions are searched
    after: int = 30  # steps to survive after them
    knot: int = 4  # steps between two knots
    rounds: int = 45  # without reset noise
    noisy_rounds: int = 30  # with it; it grows to its full size over the first half of them
    elites: float = 0.125  # share of the rollouts that the next round is drawn around
    noisy_elites: float = 0.25  # luck counts for less among more of them
    starting_std: float = 1.5  # far beyond exploration noise: the way may be far from the policy
    least_std: float = 0.15
    keep: float = 0.3  # share of the last round's mean and standard deviation
    seed: int = 0  # of the draws and of the reset noise


@dataclass(frozen=True)
class Found:
    """What a search found."""

    start: int  # frame of the clip at which the first action is taken
    steps: int  # control steps searched and survived after
    added: np.ndarray  # f32[window, joint] to be added to the policy's actions
    passed: float  # share of rollouts with reset noise that survive all steps with what was found
    lessons: Lesson  # [n] states and actions of those rollouts


def first_failure(env: Environment, assets: Assets, policy: Policy, clip: int) -> int:
    """Frame of a clip at which the policy fails first, from frame 0 without reset noise; −1 where it completes it.

    An episode lasts at most `max_episode_steps`.
    """
    env = dataclasses.replace(env, noisy=False)
    steps = min(env.config.max_episode_steps, int(assets.library.length[clip]) - 1)
    state = _start(env, assets, clip, 0, 0.0, jax.random.PRNGKey(0))
    nothing = jnp.zeros((steps, 1, env.robot.num_joints))
    survived = int(jax.jit(partial(_roll, env))(assets, policy, state, nothing)[0][0])
    return survived if survived < steps else -1


def search(env: Environment, assets: Assets, policy: Policy, clip: int, failure: int, config: SearchConfig) -> Found:
    """Actions that pass frame `failure` of a clip, where the policy fails.

    Args:
        env: static part. Its robots are the rollouts; pushes, randomisation and sensor noise are off.
        assets: constant arrays.
        policy: what the actions are added to.
        clip: index of the clip.
        failure: frame at which the policy fails; see `first_failure`.
        config: size of the search.

    Raises:
        ValueError: the clip ends before a step can be searched.
    """
    env = dataclasses.replace(env, noisy=False)
    start = max(0, failure - config.before)
    left = int(assets.library.length[clip]) - 1 - start
    window, steps = min(config.window, left), min(config.window + config.after, left)
    if not 0 <= failure <= start + left or window < 2:
        raise ValueError(f"failure at frame {failure}, in a clip of {start + left + 1} frames: nothing to search")
    lines = straight_lines(max(2, window // config.knot), window)
    roll, rng = jax.jit(partial(_roll, env), static_argnames="record"), np.random.default_rng(config.seed)

    def rollouts(knots: np.ndarray, noise: float, key: Array, record: bool = False) -> Any:
        """`_roll` with knots [rollout, knot, joint] and `noise` times the reset noise."""
        added = np.zeros((steps, *knots.shape[::2]), np.float32)
        added[:window] = np.einsum("sk,rkj->srj", lines, knots)
        return jax.device_get(roll(assets, policy, _start(env, assets, clip, start, noise, key), added, record=record))

    mean = np.zeros((1, lines.shape[1], env.robot.num_joints))
    std = np.full_like(mean, config.starting_std)
    keys = jax.random.split(jax.random.PRNGKey(config.seed), config.rounds + config.noisy_rounds + 1)
    for number, key in enumerate(keys[:-1]):
        noisy = number >= config.rounds
        noise = min(1.0, 2.0 * (number + 1 - config.rounds) / config.noisy_rounds) if noisy else 0.0
        knots = mean + std * rng.standard_normal((env.num_envs, *mean.shape[1:]))
        if not noisy:
            knots[:1] = mean
        survived, tracked, _ = rollouts(knots, noise, key)
        elites = max(2, round((config.noisy_elites if noisy else config.elites) * env.num_envs))
        best = knots[np.argsort(-(survived / steps + tracked), kind="stable")[:elites]]
        mean = config.keep * mean + (1.0 - config.keep) * best.mean(0)
        std = np.maximum(config.keep * std + (1.0 - config.keep) * best.std(0), config.least_std)
    passed, _, lessons = rollouts(mean, 1.0, keys[-1], record=True)
    passed = passed == steps
    return Found(
        start=start,
        steps=steps,
        added=(lines @ mean[0]).astype(np.float32),
        passed=float(passed.mean()),
        lessons=jax.tree.map(lambda x: x[:, passed].reshape(-1, *x.shape[2:]), lessons),
    )


def straight_lines(knots: int, steps: int) -> np.ndarray:
    """Weights [step, knot] of knots that are spread evenly over the steps and joined by straight lines."""
    places = np.linspace(0, knots - 1, steps)
    return np.stack([np.interp(places, np.arange(knots), one) for one in np.eye(knots)], axis=-1)


def _start(env: Environment, assets: Assets, clip: int, frame: int, noise: float, key: Array) -> EnvState:
    """Every robot at a frame of a clip, with `noise` times the config's reset noise."""
    widths = {name: value for name, value in dataclasses.asdict(env.config.noise).items() if name.startswith("reset_")}
    scaled = dataclasses.replace(env.config.noise, **jax.tree.map(lambda width: noise * width, widths))
    env = dataclasses.replace(env, config=dataclasses.replace(env.config, noise=scaled))
    zeros = jnp.zeros((env.num_envs,), jnp.int32)
    start = Start(zeros + clip, zeros, zeros + frame)
    state = tracking.start_episodes(env, assets, key, start, zeros.astype(jnp.float32))
    return tracking.refresh_bodies(env, state, zeros == 0)


def _roll(
    env: Environment, assets: Assets, policy: Policy, state: EnvState, added: Array, record: bool = False
) -> tuple[Array, Array, Lesson | None]:
    """Steps survived and mean tracking reward, each [rollout], and lessons [step, rollout] where `record`.

    Args:
        env: static part.
        assets: constant arrays.
        policy: what the actions are added to.
        state: at the start.
        added: [step, rollout or 1, joint].
        record: whether there are lessons.
    """

    def one_step(carry, added: Array):
        state, alive, survived, tracked = carry
        actor_obs, critic_obs = tracking.observe(env, assets, state, None)
        action = policy.mean_action(actor_obs) + added
        after, result = tracking.step(env, assets, state, action, jax.random.PRNGKey(0))
        alive = alive & ~result.terminated
        tracked = tracked + jnp.where(alive, result.reward.normalized_tracking, 0.0)
        if not record:
            return (after, alive, survived + alive, tracked), None
        reward = (result.reward.tracking + result.reward.regularisation) * env.control_step
        next_value = policy.value(tracking.observe(env, assets, after, None)[1])
        ends = (reward, policy.value(critic_obs), next_value, result.terminated, result.truncated)
        return (after, alive, survived + alive, tracked), (actor_obs, critic_obs, action, ends)

    zeros = jnp.zeros(env.num_envs)
    (_, _, survived, tracked), seen = jax.lax.scan(one_step, (state, zeros == 0, zeros, zeros), added)
    if seen is None:
        return survived, tracked / len(added), None
    actor_obs, critic_obs, action, (reward, value, next_value, terminated, truncated) = seen
    discount = env.config.ppo.discount
    value_target = generalized_advantages(reward, value, next_value, terminated, truncated, discount, 1.0)[1]
    return survived, tracked / len(added), Lesson(actor_obs, critic_obs, action, value_target)
