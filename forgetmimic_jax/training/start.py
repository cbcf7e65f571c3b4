"""What a run starts from: a random policy, a base, or the state of a checkpoint."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.basics.provenance import made_here
from forgetmimic_jax.motion.library import DATA_DIR
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.ppo.state import TrainState, init_state
from forgetmimic_jax.robot.model import roles_file
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.settings.interface import with_interface
from forgetmimic_jax.tracking.env import Assets, Environment, make_environment
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.carried_over import policy_for
from forgetmimic_jax.unlearning.registry import method_of


def base_folder(robot: str) -> Path:
    """The folder of a robot's shipped base policy.

    Raises:
        InputError: unknown robot, or none is shipped for it.
    """
    roles_file(robot)
    folder = shipped_base(robot)
    if folder is None:
        missing = DATA_DIR / robot / "base"
        raise InputError(f"{missing}: no policy is shipped for '{robot}'; train one and name its checkpoint")
    return folder


def shipped_base(robot: str) -> Path | None:
    """The folder of a robot's shipped base policy, if one is shipped."""
    folder = DATA_DIR / robot / "base"
    return folder if folder.is_dir() else None


def shipped_policies(robot: str, kind: str) -> tuple[Path, ...]:
    """The folders data/ROBOT/KIND*, by name.

    Args:
        robot: whose policies they are.
        kind: `base`, of which data/ROBOT/base is the one that commands take by default, and base-1, base-2, ... are
            others like it; `control`: retrained controls, the first of them beside the first base; `unlearned`: what
            methods made of the first base.
    """
    return tuple(sorted(path for path in (DATA_DIR / robot).glob(f"{kind}*") if path.is_dir()))


def base_checkpoint(config: Config) -> Path:
    """The checkpoint that an unlearning run starts from: the one it names, or the shipped one."""
    return base_folder(config.robot) if config.base is None else Path(config.base)


def with_interface_of_base(config: Config) -> Config:
    """The config with the interface of the base that training continues from, if it names one.

    A run's folder becomes the checkpoint that it stands for now.
    """
    if config.base is None:
        return config
    info = checkpoint.read_info(Path(config.base))
    return dataclasses.replace(with_interface(config, info.config), base=str(info.path))


def unlearned_base(config: Config) -> str | None:
    """`policy_hash` of the checkpoint that an unlearning run starts from or is taught by; None where there is none."""
    if not config.unlearn.targets or method_of(config).start == "fresh":
        return None
    return checkpoint.policy_hash(checkpoint.read_info(base_checkpoint(config)))


def fresh_policy(setup: Setup, assets: Assets) -> Policy:
    """A random policy of the sizes that the setup's observations and joints ask for."""
    env = make_environment(setup, 1, noisy=False)
    key = jax.random.PRNGKey(setup.config.seed)
    return jax.jit(lambda assets, key: init_state(env, assets, key).policy)(assets, key)


def base_policy(setup: Setup) -> Policy:
    """The policy that a run starts from.

    Training may use other clips than the base's, and another robot's policy, carried over joint by joint; unlearning
    needs the base's own.

    Raises:
        InputError: the checkpoint is not of this robot, network or library, or of a robot that shares nothing.
    """
    config, robot = setup.config, setup.robot
    path, training = base_checkpoint(config), not config.unlearn.targets
    info = checkpoint.read_info(path)
    carry = training and info.robot != robot.name
    checkpoint.check_matches(info, setup, other_library=training, other_robot=carry)
    return policy_for(robot, info) if carry else checkpoint.load_policy(info, robot)


def start_state(setup: Setup, env: Environment, assets: Assets) -> TrainState:
    """A fresh run's state; with a base, a warm start from its policy, unless the method trains a fresh one.

    Where unlearning samples or assists by failure levels, it starts with the base's, unless something else than the
    clip is the reference: that the base failed at a clip says nothing about it.
    """
    config, unlearning = setup.config, bool(setup.config.unlearn.targets)
    key = jax.random.PRNGKey(config.seed)
    if method_of(config).start != "base" or (config.base is None and not unlearning):
        return jax.jit(lambda assets, key: init_state(env, assets, key))(assets, key)
    policy, failure_level = setup.base or base_policy(setup), None
    by_failure = config.sampling.rule == "adaptive" or config.wrench.max_gain > 0
    if config.sampling.rule == "frozen" or (unlearning and by_failure and not env.replace_reference):
        failure_level = checkpoint.load_failure_level(base_checkpoint(config), assets.bins)
    start = jax.jit(lambda assets, key, policy, level: init_state(env, assets, key, policy, level))
    return start(assets, key, policy, failure_level)


def template(env: Environment, assets: Assets) -> TrainState:
    """Shapes of a run's TrainState."""
    return jax.eval_shape(lambda key: init_state(env, assets, key), jax.random.PRNGKey(0))


def saved_state(setup: Setup, env: Environment, assets: Assets, path: Path) -> tuple[TrainState, int]:
    """The state of a checkpoint of this run, and the environment steps behind it.

    What another process than the first wrote has no state. There a fresh one stands for it until the run begins: then
    every process has the first one's (`devices.spread`).
    """
    info = checkpoint.read_info(path)
    checkpoint.check_matches(info, setup, resume=True)
    if jax.process_index() > 0 and not checkpoint.is_whole(info):
        state = start_state(setup, env, assets)
        state = dataclasses.replace(state, iteration=jnp.full_like(state.iteration, info.iteration))
        return state, info.environment_steps
    state = checkpoint.load_state(info, template(env, assets))
    step_size = setup.config.ppo.learning_rate
    if step_size != info.config.ppo.learning_rate:  # changed with --set; else the state's own holds
        state = dataclasses.replace(state, learning_rate=jnp.asarray(step_size, jnp.float32))
    return state, info.environment_steps


def another_machine(path: Path, devices: int) -> str | None:
    """What a run says that resumes from checkpoint `path` on another machine or number of devices; None otherwise.

    Another processor, or another number of cores, adds floating-point numbers in another order. Every device draws
    noise of its own.
    """
    info, here = checkpoint.read_info(path), dataclasses.asdict(made_here())
    if info.config.devices != devices:
        return f"{path} was made with --devices {info.config.devices}, this run has {devices}: its noise will differ"
    before = info.made
    then, now = (f"{made.get('processor')} (cores: {made.get('cores')})" for made in (before, here))
    if not before or then == now:
        return None
    return f"{path} was made on {then}, this is {now}: the numbers will differ in the last digits"


def steps_before(config: Config) -> int:
    """Environment steps of the base, which count as this run's where training continues on the same robot."""
    if config.base is None or config.unlearn.targets:
        return 0
    info = checkpoint.read_info(Path(config.base))
    return info.environment_steps if info.robot == config.robot else 0
