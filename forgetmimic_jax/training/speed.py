"""How fast an iteration is and what it takes: seconds beside raw MuJoCo stepping, and memory by XLA's own analysis."""

from __future__ import annotations

import resource
import statistics
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np
from jax.sharding import PartitionSpec as P

from forgetmimic_jax.basics.provenance import cores
from forgetmimic_jax.basics.shards import average
from forgetmimic_jax.physics.choose import resolve_engine
from forgetmimic_jax.ppo.collect import collect
from forgetmimic_jax.ppo.rule import Rule
from forgetmimic_jax.ppo.update import make_iteration
from forgetmimic_jax.tracking import env as tracking
from forgetmimic_jax.tracking.action import to_joint_target
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.training.devices import mesh_of, shard_environment, share, spread
from forgetmimic_jax.training.start import start_state, template

Figures = dict[str, float | int | str]

GIB = 2**30
RSS_UNIT = 2**30 if sys.platform == "darwin" else 2**20  # the system counts in bytes there, in KiB elsewhere


def speed(setup: Setup, *, repeats: int, started: float) -> Figures:
    """The parts of an iteration in one process. Medians; rounds of all measurements alternate.

    Args:
        setup: robot, clips and settings.
        repeats: times each part is measured.
        started: `time.perf_counter()` when the process began.
    """
    config = setup.config
    env, assets = tracking.make_environment(setup, config.ppo.num_envs), tracking.make_assets(setup)
    state = start_state(setup, env, assets)
    iteration = make_iteration(env, Rule())
    state, _ = jax.block_until_ready(iteration(assets, state))
    to_first_iteration = time.perf_counter() - started

    environment = _environment_alone(env)
    collect_alone = jax.jit(lambda assets, state: collect(env, assets, state, Rule()))
    _, (physics, joint_targets, *_) = jax.block_until_ready(
        environment(assets, state.env, state.failure_level, jax.random.PRNGKey(1))
    )
    jax.block_until_ready(collect_alone(assets, state))
    raw = _raw_stepping(setup.robot.model, env.num_envs, config.physics.substeps, physics, joint_targets)

    seconds: dict[str, list[float]] = {"raw": [], "environment": [], "collect": [], "iteration": []}
    for repeat in range(repeats):
        seconds["raw"].append(raw())
        key = jax.random.PRNGKey(repeat)
        seconds["environment"].append(_timed(environment, assets, state.env, state.failure_level, key))
        seconds["collect"].append(_timed(collect_alone, assets, state))
        begin = time.perf_counter()
        state, _ = jax.block_until_ready(iteration(assets, state))
        seconds["iteration"].append(time.perf_counter() - begin)
    median = {name: statistics.median(values) for name, values in seconds.items()}
    steps = env.num_envs * config.ppo.num_steps
    return {
        "engine": resolve_engine(config.physics.engine),
        "cores": cores(),
        "environments": env.num_envs,
        "raw_control_steps_per_second": steps / median["raw"],
        "environment_control_steps_per_second": steps / median["environment"],
        "environment_over_raw": median["raw"] / median["environment"],
        "iteration_control_steps_per_second": steps / median["iteration"],
        "iteration_over_raw": median["iteration"] / median["raw"],
        "share_physics": median["raw"] / median["iteration"],
        "share_environment": (median["environment"] - median["raw"]) / median["iteration"],
        "share_policy_in_rollout": (median["collect"] - median["environment"]) / median["iteration"],
        "share_update": (median["iteration"] - median["collect"]) / median["iteration"],
        "seconds_to_first_iteration": to_first_iteration,
        "peak_memory_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / RSS_UNIT,
    }


def growth(setup: Setup, *, repeats: int) -> Figures:
    """The time of an iteration on the devices of the config, and of what the devices exchange in one. Medians.

    Args:
        setup: robot, clips and settings; `devices.join` came before.
        repeats: times each part is measured.
    """
    config, rule = setup.config, Rule()
    mesh, ppo = mesh_of(config.devices), setup.config.ppo
    env, assets = tracking.make_environment(setup, ppo.num_envs), tracking.make_assets(setup)
    state = spread(mesh, start_state(setup, env, assets))
    iteration = make_iteration(shard_environment(mesh, setup, env), rule, mesh)
    assets, steps = share(mesh, assets), ppo.epochs * ppo.minibatches

    def exchange(gradient):
        return jax.lax.scan(lambda mean, _: (average(mean), None), gradient, length=steps)[0]

    one = exchange if mesh is None else jax.shard_map(exchange, mesh=mesh, in_specs=P(), out_specs=P(), check_vma=False)
    averaging = jax.jit(one)
    seconds: dict[str, list[float]] = {"iteration": [], "averaging": []}
    for repeat in range(repeats + 1):
        begin = time.perf_counter()
        state, _ = jax.block_until_ready(iteration(assets, state))
        took = {"iteration": time.perf_counter() - begin}
        took["averaging"] = _timed(averaging, state.policy.parameters)
        if repeat:  # the first time compiles
            for name, values in seconds.items():
                values.append(took[name])
    return {
        "engine": resolve_engine(config.physics.engine),
        "devices": config.devices,
        "cores": cores(),
        "environments": ppo.num_envs,
        "control_steps": ppo.num_envs * ppo.num_steps,
        "iteration_seconds": statistics.median(seconds["iteration"]),
        "averaging_seconds": statistics.median(seconds["averaging"]) if mesh else 0.0,
    }


def memory(setup: Setup) -> Figures:
    """Memory of an iteration in GiB, as XLA computes it when it compiles. Nothing is simulated.

    The engine's own memory is part of it with MJX, which is inside the program, and not with the native engine.
    """
    config = setup.config
    env, assets = tracking.make_environment(setup, config.ppo.num_envs), tracking.make_assets(setup)
    iteration = jax.jit(make_iteration(env, Rule()), donate_argnums=1)
    state = template(env, assets)
    found = iteration.lower(assets, state).compile().memory_analysis()
    assert found is not None  # every backend of JAX that this program runs on has it
    return {
        "engine": resolve_engine(config.physics.engine),
        "environments": env.num_envs,
        "state_gib": sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state)) / GIB,
        "arguments_gib": found.argument_size_in_bytes / GIB,
        "temporary_gib": found.temp_size_in_bytes / GIB,
        "program_gib": found.generated_code_size_in_bytes / GIB,
        # The state is donated: its memory is used again for the result.
        "together_gib": (found.argument_size_in_bytes + found.temp_size_in_bytes + found.generated_code_size_in_bytes)
        / GIB,
    }


def _environment_alone(env: tracking.Environment) -> Callable:
    """The jitted rollout of random actions, without policy and critic."""
    config = env.config

    @jax.jit
    def environment(assets, episodes, failure_level, key):
        probabilities = tracking.start_probabilities(config, assets, failure_level)
        starts = tracking.StartTable(probabilities, jnp.zeros_like(probabilities))

        def one_step(episodes, key):
            action_key, step_key, reset_key, observe_key = jax.random.split(key, 4)
            action = config.ppo.initial_std * jax.random.normal(action_key, (env.num_envs, env.robot.num_joints))
            after, result = tracking.step(env, assets, episodes, action, step_key)
            done = result.terminated | result.truncated
            fresh = tracking.reset_where(env, assets, after, done, reset_key, starts)
            observation = tracking.observe(env, assets, fresh, observe_key)
            reference = tracking.lookup(assets.library, episodes.clip, episodes.frame + 1)
            joint_target = to_joint_target(config.action.mode, assets.robot, reference, action)
            return fresh, (episodes.physics, joint_target, observation[0].sum(), result.reward.tracking.sum())

        return jax.lax.scan(one_step, episodes, jax.random.split(key, config.ppo.num_steps))

    return environment


def _raw_stepping(model, num_envs: int, substeps: int, physics, joint_targets) -> Callable[[], float]:
    """Seconds that plain `mujoco.batch` needs for the same states and joint targets; loading them is not counted."""
    batch = mujoco.batch.Batch(model, num_envs, cores())
    rows = [np.asarray(x, np.float64) for x in (physics.qpos, physics.qvel, physics.warmstart, joint_targets)]

    def run() -> float:
        seconds = 0.0
        for qpos, qvel, warmstart, joint_target in zip(*rows, strict=True):
            batch.qpos[:], batch.qvel[:], batch.qacc_warmstart[:], batch.ctrl[:] = qpos, qvel, warmstart, joint_target
            begin = time.perf_counter()
            batch.step(nstep=substeps, stage=int(mujoco.mjtStage.mjSTAGE_VEL))
            seconds += time.perf_counter() - begin
        return seconds

    return run


def _timed(function: Callable[..., object], *arguments: object) -> float:
    begin = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    return time.perf_counter() - begin
