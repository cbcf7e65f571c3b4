"""Several teachers become one student: regression on the student's own states (DAgger, Ross et al. 2011).

Every clip has a teacher. In a round the robots move, some by their teacher's action and more and more by the student's;
at every state the teacher says what it would do, and the student's actor is regressed on that. The student's critic is
regressed on the returns of the round. Everything that changes is in `DistilState`, one pytree: saved and restored, a
distillation continues with the same bits.

The unlearning method `distill` is something else: PPO of a fresh network with a KL to the base.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

from forgetmimic_jax.policy.normalizer import Normalizer
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.ppo.gae import generalized_advantages
from forgetmimic_jax.ppo.state import make_optimizer
from forgetmimic_jax.ppo.update import shuffled
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.env import Assets, Environment, EnvState
from forgetmimic_jax.training.teaching import Lesson, Teaching, fresh_episodes, lesson_at

SCORE_SEED = 0  # of the episodes on which student and teachers are compared


@struct.dataclass
class DistilState:
    """All that a distillation changes."""

    student: Policy
    optimizer: optax.OptState
    env: EnvState
    key: Array
    round: Array  # i32[] rounds done


@struct.dataclass
class Score:
    """Episodes of one student, or of the teachers, clip by clip; 0 for a clip without episodes."""

    success: Array  # [clip] share of the episodes that reach their end
    reward: Array  # [clip] mean tracking reward while alive


@dataclass(frozen=True)
class DistilConfig:
    """Settings. A student that is trained already needs `normalizer_rounds=0`."""

    rounds: int = 80
    steps: int = 24  # control steps of every robot in a round
    expert_share: tuple[float, ...] = (1.0, 0.7, 0.5, 0.3, 0.2, 0.1, 0.0)  # of the robots, spread over the rounds
    noise_rounds: int = 12  # first rounds with noise on the actions, so that mistakes and their correction are seen
    noise_std: float = 0.1
    noise_share: float = 0.5  # of the robots
    normalizer_rounds: int = 34  # first rounds in which the observation statistics are learned; then they are frozen
    variance_floor: float = 1e-4  # smallest variance of an observation in these statistics
    epochs: int = 4
    minibatches: int = 24
    learning_rate: float = 1e-3
    anneal: float = 0.5  # share of the rounds, at the end, in which the step size falls to 0
    check_every: int = 5  # rounds between two comparisons with the teachers, once the student acts alone
    success_tolerance: float = 0.02
    reward_tolerance: float = 0.02

    def share(self, done: Array | int) -> Array:
        """Share [] of the robots that their teacher moves after `done` rounds."""
        stage = jnp.minimum(done * len(self.expert_share) // self.rounds, len(self.expert_share) - 1)
        return jnp.asarray(self.expert_share, jnp.float32)[stage]

    def step_size(self, done: Array | int) -> Array:
        """Step size [] after `done` rounds."""
        left = 1.0 - done / self.rounds
        return self.learning_rate * jnp.clip(left / max(self.anneal, 1.0 / self.rounds), 0.0, 1.0)


def begin(env: Environment, assets: Assets, teaching: Teaching, student: Policy, key: Array) -> DistilState:
    """The state before the first round: every robot at a start of an episode."""
    key, start_key = jax.random.split(key)
    return DistilState(
        student=student,
        optimizer=make_optimizer(env.config.ppo).init(student.parameters),
        env=fresh_episodes(env, assets, teaching, start_key),
        key=key,
        round=jnp.zeros((), jnp.int32),
    )


def distil(
    env: Environment, assets: Assets, teaching: Teaching, state: DistilState, config: DistilConfig
) -> DistilState:
    """The state after the round in which the student is as good as its teachers, or after `config.rounds`.

    Args:
        env: static part; its noise setting decides whether observations have sensor noise.
        assets: constant arrays.
        teaching: who teaches what.
        state: from `begin`, or of a distillation that was interrupted.
        config: settings.
    """
    one_round = make_round(env, config)
    score = jax.jit(lambda assets, teaching, student: score_of(env, assets, teaching, student))
    teachers = score(assets, teaching, None)
    for done in range(int(state.round) + 1, config.rounds + 1):
        state, _ = one_round(assets, teaching, state)
        alone = float(config.share(done - 1)) == 0.0
        due = alone and done % config.check_every == 0 and done < config.rounds
        if due and is_enough(config, score(assets, teaching, state.student), teachers):
            break
    return jax.block_until_ready(state)  # the environment may end with the caller; the last round must not run on


def is_enough(config: DistilConfig, student: Score, teachers: Score) -> bool:
    """Whether no clip's success or reward is below the teachers' by more than the tolerance."""
    success = (teachers.success - student.success).max() <= config.success_tolerance
    return bool(success & ((teachers.reward - student.reward).max() <= config.reward_tolerance))


def make_round(
    env: Environment, config: DistilConfig
) -> Callable[[Assets, Teaching, DistilState], tuple[DistilState, dict[str, Array]]]:
    """The jitted round(assets, teaching, state) → (state, metrics)."""

    def one_round(assets: Assets, teaching: Teaching, state: DistilState) -> tuple[DistilState, dict[str, Array]]:
        state, lesson, metrics = roll(env, assets, teaching, state, config)
        learning = state.round < config.normalizer_rounds
        student = dataclasses.replace(
            state.student,
            actor_normalizer=_learned(config, learning, state.student.actor_normalizer, lesson.actor_observation),
            critic_normalizer=_learned(config, learning, state.student.critic_normalizer, lesson.critic_observation),
        )
        lesson = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), lesson)
        if teaching.shown is not None:
            lesson = jax.tree.map(lambda ours, shown: jnp.concatenate([ours, shown]), lesson, teaching.shown)
        state, errors = learn(env, dataclasses.replace(state, student=student), lesson, config)
        return dataclasses.replace(state, round=state.round + 1), metrics | errors

    return jax.jit(one_round)


def roll(
    env: Environment, assets: Assets, teaching: Teaching, state: DistilState, config: DistilConfig
) -> tuple[DistilState, Lesson, dict[str, Array]]:
    """`config.steps` control steps of every robot, and the lessons [time, env] of the states passed."""
    key, teacher_key, first_key, roll_key = jax.random.split(state.key, 4)
    by_teacher = jax.random.uniform(teacher_key, (env.num_envs, 1)) < config.share(state.round)
    noisy = (jnp.arange(env.num_envs)[:, None] < config.noise_share * env.num_envs) & (
        state.round < config.noise_rounds
    )

    def one_step(carry, key: Array):
        before, noise_key = carry
        action_key, step_key, reset_key, next_noise_key = jax.random.split(key, 4)
        actor_obs, critic_obs, taught = lesson_at(env, assets, teaching, before, noise_key)
        action = jnp.where(by_teacher, taught, state.student.mean_action(actor_obs))
        action += noisy * config.noise_std * jax.random.normal(action_key, action.shape)
        after, result = tracking.step(env, assets, before, action, step_key)
        done = result.terminated | result.truncated
        fresh = tracking.reset_where(env, assets, after, done, reset_key, teaching.starts)
        reward = (result.reward.tracking + result.reward.regularisation) * env.control_step
        value = state.student.value(critic_obs)
        next_value = state.student.value(tracking.observe(env, assets, after, None)[1])
        ends = (reward, value, next_value, result.terminated, result.truncated)
        return (fresh, next_noise_key), (actor_obs, critic_obs, taught, ends)

    keys = jax.random.split(roll_key, config.steps)
    (episodes, _), seen = jax.lax.scan(one_step, (state.env, first_key), keys)
    actor_obs, critic_obs, action, (reward, value, next_value, terminated, truncated) = seen
    discount, gae_lambda = env.config.ppo.discount, env.config.ppo.gae_lambda
    value_target = generalized_advantages(reward, value, next_value, terminated, truncated, discount, gae_lambda)[1]
    completed = truncated.sum() / jnp.maximum((terminated | truncated).sum(), 1)
    metrics = {"completed": completed, "teacher_share": by_teacher.mean()}
    lesson = Lesson(actor_obs, critic_obs, action, value_target)
    return dataclasses.replace(state, env=episodes, key=key), lesson, metrics


def learn(
    env: Environment, state: DistilState, lesson: Lesson, config: DistilConfig
) -> tuple[DistilState, dict[str, Array]]:
    """Epochs of mini-batch regression on lessons [n].

    The actor's loss is Huber's, in units of the student's exploration noise: its square is the KL divergence, and it
    is linear far away, for what a search found is far from any policy.
    """
    optimizer, size = make_optimizer(env.config.ppo), len(lesson.value_target)
    step_size, std = config.step_size(state.round), jnp.exp(state.student.log_std)

    def loss_of(parameters, data: Lesson) -> tuple[Array, dict[str, Array]]:
        student = state.student.with_parameters(parameters)
        wrong = student.mean_action(data.actor_observation) - data.action
        action_loss = optax.huber_loss(wrong / jax.lax.stop_gradient(std)).sum(-1).mean()
        value_loss = ((student.value(data.critic_observation) - data.value_target) ** 2).mean()
        return action_loss + value_loss, {"action_error": jnp.sqrt((wrong**2).mean()), "value_loss": value_loss}

    def minibatch(carry, indices: Array):
        parameters, optimizer_state = carry
        data = jax.tree.map(lambda x: x[indices], lesson)
        gradient, metrics = jax.grad(loss_of, has_aux=True)(parameters, data)
        updates, optimizer_state = optimizer.update(gradient, optimizer_state)
        return (jax.tree.map(lambda p, u: p - step_size * u, parameters, updates), optimizer_state), metrics

    def epoch(carry, key: Array):
        return jax.lax.scan(minibatch, carry, shuffled(key, size, config.minibatches))

    key, epoch_key = jax.random.split(state.key)
    carry = (state.student.parameters, state.optimizer)
    (parameters, optimizer_state), metrics = jax.lax.scan(epoch, carry, jax.random.split(epoch_key, config.epochs))
    student = state.student.with_parameters(parameters)
    state = dataclasses.replace(state, student=student, optimizer=optimizer_state, key=key)
    return state, {name: value[-1].mean() for name, value in metrics.items()}


def score_of(env: Environment, assets: Assets, teaching: Teaching, student: Policy | None) -> Score:
    """Success and reward of one episode of every robot, by the student or, with None, by the teachers.

    Starts and reset noise are the same in every call. An episode ends at its horizon, `max_episode_steps` at most.
    """
    start_key, noise_key, step_key = jax.random.split(jax.random.PRNGKey(SCORE_SEED), 3)
    episodes = fresh_episodes(env, assets, teaching, start_key)

    def one_step(carry, keys: Array):
        episodes, alive, steps, total = carry
        actor_obs, _, action = lesson_at(env, assets, teaching, episodes, keys[0])
        if student is not None:
            action = student.mean_action(actor_obs)
        running = episodes.step < episodes.horizon
        episodes, result = tracking.step(env, assets, episodes, action, keys[1])
        alive = alive & (~result.terminated | ~running)
        counted = alive & running
        total = total + jnp.where(counted, result.reward.normalized_tracking, 0.0)
        return (episodes, alive, steps + counted, total), None

    zeros = jnp.zeros(env.num_envs)
    keys = jnp.stack([jax.random.split(key, env.config.max_episode_steps) for key in (noise_key, step_key)], axis=1)
    (_, alive, steps, total), _ = jax.lax.scan(one_step, (episodes, zeros == 0, zeros, zeros), keys)

    def per_clip(values: Array) -> Array:
        sums = jax.ops.segment_sum(values.astype(jnp.float32), episodes.clip, len(teaching.teacher_of))
        return sums / jnp.maximum(jnp.bincount(episodes.clip, length=len(sums)), 1)

    return Score(success=per_clip(alive), reward=per_clip(total / jnp.maximum(steps, 1.0)))


def _learned(config: DistilConfig, learning: Array, normalizer: Normalizer, observation: Array) -> Normalizer:
    """The statistics with a batch [..., features] where `learning` []; no variance below `variance_floor`."""
    new = normalizer.updated(observation)
    new = dataclasses.replace(new, variance=jnp.maximum(new.variance, config.variance_floor))
    return jax.tree.map(lambda new, old: jnp.where(learning, new, old), new, normalizer)
