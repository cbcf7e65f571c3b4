"""Measure the speed of training on this machine: `forgetmimic bench`. Ratios within one run, nothing absolute."""

from __future__ import annotations

import json
import os
import resource
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.settings.config import EngineName, Preset
from forgetmimic_jax.settings.options import at_least, on_engine, parse, replace_given


@dataclass
class Options:
    """Time the environment against raw MuJoCo stepping of the same states, and the parts of a PPO iteration."""

    robot: str = "g1"
    """Robot under robots/."""
    preset: Preset = "cpu"
    """Settings."""
    physics: EngineName | None = None
    """Physics engine; auto is native on a CPU and mjx on a GPU or TPU."""
    library: Path | None = None
    """Folder of clips; data/ROBOT by default."""
    repeats: int = 7
    """Times each measurement is taken; the median counts, rounds of all measurements alternate."""
    output: Path | None = None
    """JSON file for the figures; only printed by default."""


def main(options: Options) -> None:
    """Measure and print a table."""
    started = time.perf_counter()
    import jax
    import jax.numpy as jnp
    from rich.console import Console
    from rich.table import Table

    from forgetmimic_jax.physics.choose import resolve_engine
    from forgetmimic_jax.ppo.collect import collect
    from forgetmimic_jax.ppo.rule import Rule
    from forgetmimic_jax.ppo.update import make_iteration
    from forgetmimic_jax.settings.config import preset
    from forgetmimic_jax.tracking import env as tracking
    from forgetmimic_jax.tracking.action import to_joint_target
    from forgetmimic_jax.tracking.setup import make_setup
    from forgetmimic_jax.training.folder import check_writable
    from forgetmimic_jax.training.start import start_state

    at_least(1, "--repeats", options.repeats)
    if options.output:
        check_writable(options.output.parent)
        if options.output.is_dir():
            raise InputError(f"{options.output}: a folder; --output is a file")
    config = replace_given(preset(options.preset), robot=options.robot, library=options.library)
    config = on_engine(config, options.physics)
    setup = make_setup(config)
    env, assets, steps = (
        tracking.make_environment(setup, config.ppo.num_envs),
        tracking.make_assets(setup),
        config.ppo.num_steps,
    )
    state = start_state(setup, env, assets)
    first_iteration = make_iteration(env, Rule())
    state, _ = jax.block_until_ready(first_iteration(assets, state))
    to_first_step = time.perf_counter() - started
    probabilities = tracking.start_probabilities(config, assets, state.failure_level)
    gains = jnp.zeros_like(probabilities)

    @jax.jit
    def environment(assets, episodes, key):
        def one_step(episodes, key):
            action_key, step_key, reset_key, observe_key = jax.random.split(key, 4)
            action = config.ppo.initial_std * jax.random.normal(action_key, (env.num_envs, env.robot.num_joints))
            after, result = tracking.step(env, assets, episodes, action, step_key)
            done = result.terminated | result.truncated
            fresh = tracking.reset_where(env, assets, after, done, reset_key, probabilities, gains)
            observation = tracking.observe(env, assets, fresh, observe_key)
            reference = tracking.lookup(assets.library, episodes.clip, episodes.frame + 1)
            joint_target = to_joint_target(config.action.mode, assets.robot, reference, action)
            return fresh, (episodes.physics, joint_target, observation[0].sum(), result.reward.tracking.sum())

        return jax.lax.scan(one_step, episodes, jax.random.split(key, steps))

    collect_only = jax.jit(lambda assets, state: collect(env, assets, state, Rule()))
    _, (physics, targets, *_) = jax.block_until_ready(environment(assets, state.env, jax.random.PRNGKey(1)))
    jax.block_until_ready(collect_only(assets, state))
    raw = _raw_stepping(setup.robot.model, env.num_envs, config.physics.substeps, physics, targets)

    measured: dict[str, list[float]] = {"raw": [], "environment": [], "collect": [], "iteration": []}
    for repeat in range(options.repeats):
        measured["raw"].append(raw())
        measured["environment"].append(_timed(environment, assets, state.env, jax.random.PRNGKey(repeat)))
        measured["collect"].append(_timed(collect_only, assets, state))
        begin = time.perf_counter()
        state, _ = jax.block_until_ready(first_iteration(assets, state))
        measured["iteration"].append(time.perf_counter() - begin)
    median = {name: statistics.median(values) for name, values in measured.items()}
    env_steps = env.num_envs * steps
    memory_unit = 2**30 if sys.platform == "darwin" else 2**20  # the system counts in bytes there, in KiB elsewhere
    figures = {
        "engine": resolve_engine(config.physics.engine),
        "cores": os.cpu_count(),
        "environments": env.num_envs,
        "raw_control_steps_per_second": env_steps / median["raw"],
        "environment_control_steps_per_second": env_steps / median["environment"],
        "environment_over_raw": median["raw"] / median["environment"],
        "iteration_control_steps_per_second": env_steps / median["iteration"],
        "iteration_beyond_simulation_over_simulation": (median["iteration"] - median["raw"]) / median["raw"],
        "share_physics": median["raw"] / median["iteration"],
        "share_environment": (median["environment"] - median["raw"]) / median["iteration"],
        "share_policy_in_rollout": (median["collect"] - median["environment"]) / median["iteration"],
        "share_update": (median["iteration"] - median["collect"]) / median["iteration"],
        "seconds_to_first_iteration": to_first_step,
        "peak_memory_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / memory_unit,
    }
    table = Table(title=f"{config.robot}, preset {config.preset}, {figures['engine']} engine", title_justify="left")
    table.add_column("figure")
    table.add_column("value", justify="right")
    for name, value in figures.items():
        table.add_row(name.replace("_", " "), f"{value:,.2f}" if isinstance(value, float) else str(value))
    Console().print(table)
    if options.output:
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps(figures, indent=2) + "\n")
        print(f"figures  {options.output}")


def _raw_stepping(model, num_envs: int, substeps: int, physics, targets) -> Callable[[], float]:
    """Seconds that plain `mujoco.batch` needs for the same states and targets; loading them is not counted."""
    import mujoco
    import mujoco.batch
    import numpy as np

    batch = mujoco.batch.Batch(model, num_envs)
    rows = [np.asarray(x, np.float64) for x in (physics.qpos, physics.qvel, physics.warmstart, targets)]

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
    import jax

    begin = time.perf_counter()
    jax.block_until_ready(function(*arguments))
    return time.perf_counter() - begin


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "bench")))
