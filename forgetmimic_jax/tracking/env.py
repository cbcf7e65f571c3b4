"""The environment: a batch of robots that track clips. Pure functions over EnvState.

`step` moves the robots and returns reward and ending; `reset_where` starts new episodes under a mask. Keeping them
apart lets training bootstrap the value of a truncated episode's last state, and lets evaluation not reset at all.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from flax import struct
from jax import Array

from forgetmimic_jax.basics.rows import select_rows
from forgetmimic_jax.motion.library import Frames, MotionLibrary
from forgetmimic_jax.physics import BodyState, Engine, PhysicsParameters, PhysicsState
from forgetmimic_jax.physics.choose import make_engine
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.robot.model import Robot, RobotArrays
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking import observation, randomise, reward
from forgetmimic_jax.tracking.action import in_robot_order, to_joint_target
from forgetmimic_jax.tracking.focus import Focus, focus_of
from forgetmimic_jax.tracking.layouts import Layout, Moment, find_layout
from forgetmimic_jax.tracking.reference import align_to_anchor, anchor_between, at_anchor, lookup
from forgetmimic_jax.tracking.reward import Pair
from forgetmimic_jax.tracking.rsi import Bins, Start, bin_probabilities, make_bins, sample_start
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.tracking.stand import falls
from forgetmimic_jax.tracking.termination import terminations
from forgetmimic_jax.tracking.wrench import reference_wrench, wrench_gain


@struct.dataclass
class Assets:
    """Constant arrays of a run; traced arguments of the jitted functions, never baked into them."""

    robot: RobotArrays
    library: MotionLibrary
    bins: Bins
    is_target: Array  # bool[clip] the clips to forget
    focus: Focus
    base: Policy | None = None  # the frozen policy that an unlearning run, or a phase of pretraining, compares with
    teacher: Policy | None = None  # the policy that shows what to do instead of a target
    instead: MotionLibrary | None = None  # its only clip is what to do instead of a target


@struct.dataclass
class EnvState:
    """A batch of running episodes. Leading dimension: env."""

    physics: PhysicsState
    bodies: BodyState
    parameters: PhysicsParameters
    clip: Array  # i32
    frame: Array  # i32 the reference frame the robot is at; the next action is to reach frame + 1
    start_bin: Array  # i32
    step: Array  # i32 steps of the episode so far
    horizon: Array  # i32 steps the episode can live: min(max_episode_steps, frames left)
    tracking_sum: Array  # f32 Σ r̄ so far
    last_action: Array  # f32[env, joint] the network's output, in the robot's order of joints
    encoder_bias: Array  # f32[env, joint] rad
    wrench_gain: Array  # f32 β, frozen for the episode
    push_countdown: Array  # i32 control steps to the next push
    terms: Array  # f32[env, term] kernels of the last step, in the order of `reward.TERMS`


class StartTable(NamedTuple):
    """How new episodes start, by the bin [clip, bin] that they start in."""

    probabilities: Array  # p of starting there, 1 together
    wrench_gain: Array  # β of such an episode


@struct.dataclass
class StepResult:
    """The result of a step, before any reset. Leading dimension: env."""

    reward: reward.Reward
    terminated: Array  # bool: a bound was broken, or the physics diverged
    truncated: Array  # bool: the clip or the time ended
    diverged: Array  # bool: NaN, Inf or absurd numbers in the physics
    causes: dict[str, Array]  # bool, which bound
    pair: Pair  # the robot beside the frame that it tracked


@dataclass(frozen=True)
class Environment:
    """What is fixed when the functions are traced: the engine and small host constants."""

    config: Config
    robot: Robot
    engine: Engine  # simulates a control step at a time; with the wrench a physics step
    num_envs: int
    noisy: bool  # reset noise, pushes, randomisation and observation noise
    runs_on: int = 0  # control steps that a target's episode lasts after the clip's end; with any, only a fall ends it
    replace_reference: bool = False  # whether the reference of a target clip is what to do instead of it

    @property
    def layout(self) -> Layout:
        """What the actor sees."""
        return find_layout(self.config.observation.layout)

    @property
    def control_step(self) -> float:
        return self.config.physics.control_step

    @property
    def nominal_friction(self) -> float:
        return float(self.robot.model.geom_friction[self.robot.foot_geom_ids[0], 0])


def make_environment(
    setup: Setup,
    num_envs: int,
    *,
    noisy: bool | None = None,
    runs_on: float = 0.0,
    replace_reference: bool = False,
    shards: int = 1,
) -> Environment:
    """An environment of `num_envs` robots.

    Args:
        setup: robot, clips and settings.
        num_envs: robots.
        noisy: by default the config's.
        runs_on: s that an episode of a target clip lasts after the clip's end, with the last frame held. Above 0, such
            an episode is terminated by a fall only.
        replace_reference: whether the reference of a target clip is what to do instead of it, at the robot's place.
        shards: of this process, each with `num_envs` robots, that step at the same time.
    """
    config, robot = setup.config, setup.robot
    assisted = config.wrench.max_gain > 0
    physics = dataclasses.replace(config.physics, substeps=1) if assisted else config.physics  # see `_simulate`
    engine = make_engine(robot, physics, num_envs, shards)
    noisy = config.noise.enabled if noisy is None else noisy
    steps = round(runs_on / config.physics.control_step)
    return Environment(config, robot, engine, num_envs, noisy, steps, replace_reference)


def make_assets(setup: Setup) -> Assets:
    """The constant arrays of a run."""
    config, library = setup.config, setup.library
    is_target = jnp.asarray([name in config.unlearn.targets for name in library.names])
    bins = make_bins(library, config.sampling.bin_seconds, config.physics.control_step)
    if config.sampling.clips == "kept":
        bins = dataclasses.replace(bins, valid=bins.valid & ~is_target[:, None])
    focus = focus_of(config.ppo, is_target)
    return Assets(setup.robot.arrays, library, bins, is_target, focus, setup.base, setup.teacher, setup.instead)


def start_probabilities(config: Config, assets: Assets, failure_level: Array) -> Array:
    """p [clip, bin] of starting an episode in each bin, at failure levels L [clip, bin]."""
    return bin_probabilities(config.sampling, assets.bins, failure_level, assets.is_target, assets.focus.starts)


def start_table(config: Config, assets: Assets, failure_level: Array) -> StartTable:
    """The table of starts at failure levels L [clip, bin]."""
    probabilities = start_probabilities(config, assets, failure_level)
    return StartTable(probabilities, wrench_gain(config.wrench, failure_level))


def start_episodes(env: Environment, assets: Assets, key: Array, start: Start, gain: Array) -> EnvState:
    """Fresh episodes [env] with reset noise and the wrench's gain β [env]. Bodies: see `refresh_bodies`."""
    noise, n, joints = env.config.noise, env.num_envs, env.robot.num_joints
    keys = jax.random.split(key, 4)
    reference = lookup(assets.library, start.clip, start.frame)
    left = assets.library.length[start.clip] - 1 - start.frame
    if env.runs_on:
        left += env.runs_on * assets.is_target[start.clip]
    if env.noisy:
        parameters = randomise.physics_parameters(noise, keys[1], n)
        encoder_bias = randomise.symmetric(keys[2], n, (noise.encoder_bias,) * joints)
    else:
        parameters = randomise.nominal_parameters(env.nominal_friction, n)
        encoder_bias = jnp.zeros((n, joints))
    return EnvState(
        physics=randomise.reset_state(noise, assets.robot, reference, env.robot.root, keys[0]),
        bodies=BodyState(**vars(reference.bodies), contact_force=jnp.zeros_like(reference.bodies.pos)),
        parameters=parameters,
        clip=start.clip,
        frame=start.frame,
        start_bin=start.bin,
        step=jnp.zeros((n,), jnp.int32),
        horizon=jnp.minimum(env.config.max_episode_steps, left),
        tracking_sum=jnp.zeros((n,), jnp.float32),
        last_action=jnp.zeros((n, joints), jnp.float32),
        encoder_bias=encoder_bias,
        wrench_gain=gain,
        push_countdown=randomise.push_interval(noise, keys[3], n, env.control_step),
        terms=jnp.ones((n, len(reward.TERMS)), jnp.float32),
    )


def reference_of(env: Environment, assets: Assets, state: EnvState, ahead: int) -> Frames:
    """The reference frame [env], `ahead` frames from now: the clip's, or what to do instead of a target."""
    clip = lookup(assets.library, state.clip, state.frame + ahead)
    if not env.replace_reference:
        return clip
    return select_rows(assets.is_target[state.clip], instead_of_clip(env, assets, state, ahead), clip)


def instead_of_clip(env: Environment, assets: Assets, state: EnvState, ahead: int) -> Frames:
    """The frame [env] of what to do instead of a target, `ahead` frames from now, at the robot's place and heading.

    It is at the frame of the clip to forget, whose last frame it does not pass: a policy observes no more.
    """
    assert assets.instead is not None
    frame = jnp.minimum(state.frame + ahead, assets.library.length[state.clip] - 1)
    anchor, bodies = env.robot.anchor, state.bodies
    reference = lookup(assets.instead, jnp.zeros_like(frame), frame)
    return at_anchor(reference, anchor, bodies.pos[:, anchor], bodies.quat[:, anchor])


def refresh_bodies(env: Environment, state: EnvState, mask: Array) -> EnvState:
    """Key bodies by forward kinematics where mask [env]: a reset's noise moved them off the reference."""
    bodies = env.engine.forward(state.physics, state.parameters, mask, state.bodies)
    return dataclasses.replace(state, bodies=bodies)


def reset_where(
    env: Environment, assets: Assets, state: EnvState, mask: Array, key: Array, table: StartTable
) -> EnvState:
    """New episodes where mask [env], at starts that are drawn from a table."""
    start_key, episode_key = jax.random.split(key)
    start = sample_start(env.config.sampling, start_key, table.probabilities, assets.bins, env.num_envs)
    fresh = start_episodes(env, assets, episode_key, start, table.wrench_gain[start.clip, start.bin])
    return refresh_bodies(env, select_rows(mask, fresh, state), mask)


def assist(env: Environment, assets: Assets, state: EnvState, fraction: Array | float = 0.0) -> Array:
    """The assistive wrench [env, 6] N, N m: β times the reference wrench.

    `fraction` is the part of the control step that is over: the robot is compared with the reference of that time.
    """
    reference = anchor_between(assets.library, env.robot.anchor, state.clip, state.frame, fraction)
    wrench = reference_wrench(env.config.wrench, assets.robot, reference, state.bodies, env.robot.anchor)
    return state.wrench_gain[:, None] * wrench


def step(env: Environment, assets: Assets, state: EnvState, action: Array, key: Array) -> tuple[EnvState, StepResult]:
    """One control step of every environment, without resets.

    Args:
        env: static part.
        assets: constant arrays.
        state: before the step.
        action: [env, joint] the network's output, in the policy's order of joints.
        key: for pushes.
    """
    config, robot = env.config, env.robot
    reference = reference_of(env, assets, state, ahead=1)
    action = in_robot_order(robot, action)
    # The joint controller regulates what its encoders read, so their bias moves the robot, not the reading.
    joint_target = to_joint_target(config.action.mode, assets.robot, reference, action) - state.encoder_bias

    physics, countdown = state.physics, state.push_countdown
    if env.noisy:
        push_key, interval_key = jax.random.split(key)
        due = countdown <= 0
        pushed = randomise.push(config.noise, push_key, physics)
        physics = dataclasses.replace(physics, qvel=jnp.where(due[:, None], pushed, physics.qvel))
        interval = randomise.push_interval(config.noise, interval_key, env.num_envs, env.control_step)
        countdown = jnp.where(due, interval, countdown) - 1

    physics, bodies = _simulate(env, assets, dataclasses.replace(state, physics=physics), joint_target)
    diverged = ~_all_sane((physics, bodies), env.num_envs)
    # A diverged robot shows as standing where it was, so that no NaN can reach a sum; it is reset right after.
    physics, bodies = select_rows(diverged, state.physics, physics), select_rows(diverged, state.bodies, bodies)

    reference = reference_of(env, assets, dataclasses.replace(state, bodies=bodies), ahead=1)
    aligned = align_to_anchor(reference, robot.anchor, bodies.pos[:, robot.anchor], bodies.quat[:, robot.anchor])
    pair = Pair(reference, aligned, bodies, physics.qpos[:, 7:], physics.qvel[:, 6:], robot.anchor)
    kernels = reward.tracking_kernels(pair)
    tracking, normalized = reward.tracking_reward(kernels, config.reward)
    regularisation = reward.regularisation_reward(
        assets.robot,
        config.reward,
        action=action,
        last_action=state.last_action,
        joint_target=joint_target,
        physics=physics,
    )
    # Where, not a product: a number that overflowed before the divergence was seen would survive a factor of zero.
    result_reward = jax.tree.map(
        lambda value: jnp.where(diverged, 0.0, value), reward.Reward(tracking, regularisation, normalized, kernels)
    )
    causes = terminations(config.termination, reference, aligned, bodies, robot)
    if env.runs_on:
        is_target = assets.is_target[state.clip]
        causes = {name: broken & ~is_target for name, broken in causes.items()}
        clip_before = lookup(assets.library, state.clip, state.frame).bodies
        clip_after = lookup(assets.library, state.clip, state.frame + 1).bodies
        causes["fall"] = is_target & falls(robot, state.bodies, bodies, clip_before, clip_after)
    terminated = diverged | jnp.stack(list(causes.values())).any(0)
    steps = state.step + 1
    new = dataclasses.replace(
        state,
        physics=physics,
        bodies=bodies,
        frame=state.frame + 1,
        step=steps,
        tracking_sum=state.tracking_sum + result_reward.normalized_tracking,
        last_action=action,
        push_countdown=countdown,
        # By name: JAX sorts the keys of a dict.
        terms=jnp.stack([result_reward.terms[term.name] for term in reward.TERMS], axis=-1),
    )
    truncated = (steps >= state.horizon) & ~terminated
    return new, StepResult(result_reward, terminated, truncated, diverged, causes, pair)


def _simulate(env: Environment, assets: Assets, state: EnvState, joint_target: Array) -> tuple[PhysicsState, BodyState]:
    """One control step of the physics.

    The wrench is renewed for each physics step: before the k-th of n, from 0, the reference is k/n of the way to the
    next frame. The torque uses the inertia of the whole robot but acts on the torso alone. If it were constant for a
    whole control step, its damping would overshoot.
    """
    if env.config.wrench.max_gain == 0:
        nothing = jnp.zeros((env.num_envs, 6), jnp.float32)
        return env.engine.step(state.physics, state.parameters, joint_target, nothing)

    def physics_step(state: EnvState, fraction: Array) -> tuple[EnvState, None]:
        wrench = assist(env, assets, state, fraction)
        physics, bodies = env.engine.step(state.physics, state.parameters, joint_target, wrench)
        return dataclasses.replace(state, physics=physics, bodies=bodies), None

    substeps = env.config.physics.substeps
    state, _ = jax.lax.scan(physics_step, state, jnp.arange(substeps) / substeps)
    return state.physics, state.bodies


def moment_of(env: Environment, assets: Assets, state: EnvState) -> Moment:
    """What the observations of the running episodes are made of."""
    return Moment(
        robot=assets.robot,
        reference=reference_of(env, assets, state, ahead=1),
        physics=state.physics,
        bodies=state.bodies,
        last_action=state.last_action,
        anchor=env.robot.anchor,
        root=env.robot.root,
    )


def observe(env: Environment, assets: Assets, state: EnvState, key: Array | None) -> tuple[Array, Array]:
    """Actor observation [env, features] and critic observation [env, features]; noise on the actor's with a key."""
    robot, moment = env.robot, moment_of(env, assets, state)
    clean = observation.actor_observation(env.layout, robot.policy_joints, moment)
    wrench = assist(env, assets, state) if env.config.wrench.max_gain > 0 else jnp.zeros((env.num_envs, 6), jnp.float32)
    critic = observation.critic_observation(
        clean,
        moment,
        wrench=wrench / (assets.robot.mass * 9.81),
        wrench_gain=state.wrench_gain,
        phase=jnp.minimum(state.frame, assets.library.length[state.clip]) / assets.library.length[state.clip],
        terms=state.terms,
    )
    if key is None:
        return clean, critic
    bias = observation.in_policy_order(state.encoder_bias, robot.policy_joints)
    return clean + observation.sensor_noise(env.layout, env.config.noise.sensors, key, bias), critic


def _all_sane(tree, num_envs: int) -> Array:
    """bool[env]: no number of the environment is NaN or beyond MuJoCo's bound, above which it too calls it diverged."""
    sane = [(jnp.abs(leaf) < mujoco.mjMAXVAL).reshape(num_envs, -1).all(-1) for leaf in jax.tree.leaves(tree)]
    return jnp.stack(sane).all(0)
