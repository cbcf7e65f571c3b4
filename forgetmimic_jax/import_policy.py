"""Make a base checkpoint of an rsl_rl or ONNX policy: `forgetmimic import-policy --policy model_3000.pt`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.settings.config import Preset
from forgetmimic_jax.settings.options import at_least, parse, replace_given

if TYPE_CHECKING:
    from jax import Array

    from forgetmimic_jax.tracking.setup import Setup


@dataclass
class Options:
    """Turn a tracking policy of rsl_rl, or an ONNX actor, into a base checkpoint to unlearn from and to evaluate.

    Its observations, actions, gains and joint order must be those of this project (layout wbc132, docs/method.md). The
    actions of the new checkpoint are compared with the original's before anything is written.
    """

    policy: Path
    """The policy: a checkpoint of rsl_rl (.pt), or an ONNX file with input obs and output actions."""
    robot: str = "g1"
    """Robot under robots/."""
    library: Path | None = None
    """Folder of the clips it was trained on; data/ROBOT by default."""
    preset: Preset = "cpu"
    """Settings for further training: cpu for a laptop, paper for a GPU."""
    activation: str | None = None
    """Activation of a .pt's hidden layers; by default what params/agent.yaml beside it says."""
    std: float = 0.4
    """Standard deviation of the exploration noise, in units of action, where the file has none (an ONNX)."""
    seed: int = 0
    """Seed of the fresh critic."""
    output: Path | None = None
    """Folder of the checkpoint; runs/import-ROBOT by default."""


TOLERANCE = 1e-5  # of an action, or of 1 where the action is smaller
OBSERVATIONS = 20  # a clip, at which the actions are compared
READERS = (".pt", ".pth", ".onnx")


def main(options: Options) -> None:
    """Read, compare and write."""
    import jax.numpy as jnp
    import numpy as np
    from rich.console import Console

    from forgetmimic_jax.basics.console import closing, command_line
    from forgetmimic_jax.exchange.imported import check_actor, notes, with_actor, within_limit
    from forgetmimic_jax.exchange.onnx_actor import OnnxActor
    from forgetmimic_jax.exchange.onnx_reader import read_onnx
    from forgetmimic_jax.exchange.rsl_rl import read_rsl_rl
    from forgetmimic_jax.policy.gaussian import MAX_STD, MIN_STD
    from forgetmimic_jax.policy.normalizer import OBSERVATION_LIMIT
    from forgetmimic_jax.robot.model import load_robot
    from forgetmimic_jax.settings.config import preset
    from forgetmimic_jax.tracking.env import make_assets
    from forgetmimic_jax.tracking.layouts import find_layout
    from forgetmimic_jax.tracking.rsi import initial_failure_level
    from forgetmimic_jax.tracking.setup import make_setup
    from forgetmimic_jax.training import checkpoint
    from forgetmimic_jax.training.folder import prepare_folder
    from forgetmimic_jax.training.start import fresh_policy

    at_least(0, "--seed", options.seed)
    if not MIN_STD <= options.std <= MAX_STD:
        raise InputError(f"--std: found {options.std:g}; accepted: {MIN_STD:g} to {MAX_STD:g}")
    output = options.output or Path("runs") / f"import-{options.robot}"
    prepare_folder(output, resume=False)
    robot = load_robot(options.robot)
    suffix = options.policy.suffix.lower()
    if suffix not in READERS:
        raise InputError(f"{options.policy}: suffix: found '{suffix}'; accepted: {', '.join(READERS)}")
    is_onnx = suffix == ".onnx"
    config = replace_given(preset(options.preset), robot=options.robot, library=options.library, seed=options.seed)
    actor = read_onnx(options.policy, robot, config) if is_onnx else read_rsl_rl(options.policy, options.activation)
    check_actor(actor, find_layout(config.observation.layout), robot, options.policy)

    config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, actor_layers=actor.hidden_layers))
    setup = make_setup(config)
    assets = make_assets(setup)
    policy = with_actor(fresh_policy(setup, assets), actor, options.std)

    observations = np.asarray(_observations(setup, options.seed))
    original = OnnxActor(options.policy) if is_onnx else None
    expected = np.stack([original(each) for each in observations]) if original else actor(observations)
    found = np.asarray(policy.mean_action(jnp.asarray(observations)))
    inside = within_limit(policy, observations)
    if not inside.any():
        raise InputError(
            f"{options.policy}: every observation of the clips lies past {OBSERVATION_LIMIT:g} standard "
            f"deviations of its normaliser; is its observation layout another?"
        )
    error = float((np.abs(found - expected) / np.maximum(1.0, np.abs(expected)))[inside].max(initial=0.0))
    if not error <= TOLERANCE:
        raise InputError(f"{options.policy}: actions differ from the original's by {error:.1e}; nothing was written")
    level = initial_failure_level(config.sampling, assets.bins)
    checkpoint.save_policy(output, setup, policy, level, checkpoint.Progress(actor.iteration, environment_steps=0))
    facts = [f"Actions equal the original's to {error:.0e} at {inside.sum()} observations of the clips."]
    if not inside.all():
        facts.append(
            f"{(~inside).sum()} more lie past {OBSERVATION_LIMIT:g} standard deviations, where ours clips them."
        )
    facts += notes(actor, options.std)
    if not is_onnx:
        facts.append("A .pt does not name its observations and joints: they are taken to be in this project's order.")
    Console().print("\n".join(facts), highlight=False, soft_wrap=True)
    following = command_line("evaluate", robot=options.robot, library=options.library, checkpoint=output)
    closing({"base policy": output}, following)


def _observations(setup: Setup, seed: int) -> Array:
    """Actor observations [n, features] all along every clip, the robot on the reference but for the reset noise."""
    import jax

    from forgetmimic_jax.evaluation.rollout import Evaluator
    from forgetmimic_jax.tracking.env import make_assets, make_environment, observe

    evaluator = Evaluator(setup, episodes=OBSERVATIONS, seed=seed)
    env = make_environment(setup, len(evaluator.clip), noisy=False)
    return jax.jit(lambda assets, state: observe(env, assets, state, None)[0])(make_assets(setup), evaluator.start())


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "import-policy")))
