"""Write a policy as ONNX for a robot's software: `forgetmimic export --checkpoint runs/...`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from forgetmimic_jax.basics.errors import InputError, run_command
from forgetmimic_jax.settings.options import at_least, on_engine, parse, replace_given

if TYPE_CHECKING:
    from forgetmimic_jax.evaluation.metrics import Rollout


@dataclass
class Options:
    """Write the actor with its normaliser as ONNX, with the metadata deploy tools expect and no motion inside.

    Beside it: deploy.yaml (unitree_rl_lab) for layout mjlab154, config.yaml (wbc-g1-deploy) for wbc132.
    Before the file is written it is run in plain MuJoCo on every clip: its actions must be the policy's to 1e-5, and
    the robot must move as in the evaluation. For that, the tracking rewards of each episode's first 10 steps are
    compared: 80 % of them must be the same to 1e-5. A wrong file differs from the first steps on and in every episode;
    rounding that a contact makes large shows in one episode and from one step on.
    """

    robot: str = "g1"
    """Robot under robots/."""
    checkpoint: Path | None = None
    """Checkpoint, or the folder of a run; the shipped base data/ROBOT/base by default."""
    episodes: int = 2
    """Episodes a clip in the check: half from frame 0, half spread over the clip."""
    seed: int = 0
    """Seed of the check's start frames and reset noise."""
    library: Path | None = None
    """Folder of clips for the check; the checkpoint's by default."""
    output: Path | None = None
    """File to write; export/policy.onnx in the checkpoint's run, or runs/export-ROBOT/policy.onnx."""


ACTION_TOLERANCE = 1e-5  # of an action, or of 1 where the action is smaller
# So long has rounding rarely grown: 1e-7 in files that are right, 1e-5 to 1e-3 where one wrist's scale is wrong by 5 %.
EARLY_STEPS, EARLY_TOLERANCE = 10, 1e-5  # of a tracking reward
EARLY_SHARE = 0.8  # of these steps


def main(options: Options) -> None:
    """Export, check and write."""
    import jax
    import numpy as np
    import yaml
    from rich.console import Console

    from forgetmimic_jax.basics.console import closing, command_line, progress, say
    from forgetmimic_jax.basics.files import write_atomically
    from forgetmimic_jax.evaluation.rollout import Evaluator
    from forgetmimic_jax.exchange.closed_loop import run_episodes
    from forgetmimic_jax.exchange.deployers import check_free, deployer_file
    from forgetmimic_jax.exchange.onnx_actor import OnnxActor, to_onnx
    from forgetmimic_jax.tracking.setup import make_setup, on_library
    from forgetmimic_jax.training import checkpoint
    from forgetmimic_jax.training.folder import check_writable, folder_of
    from forgetmimic_jax.training.start import base_folder

    at_least(1, "--episodes", options.episodes)
    at_least(0, "--seed", options.seed)
    path = options.checkpoint or base_folder(options.robot)
    run = folder_of(path)  # which has a config.yaml of its own
    output = options.output or (run / "export" if run else Path("runs") / f"export-{options.robot}") / "policy.onnx"
    check_writable(output.parent)
    if output.is_dir():
        raise InputError(f"{output}: a folder; --output is a file")
    info = checkpoint.read_info(path)
    # The evaluation to reproduce is that of MuJoCo's C engine, which the check runs on too.
    config = on_library(on_engine(replace_given(info.config, robot=options.robot), "native"), options.library)
    setup = make_setup(config)
    checkpoint.check_matches(info, setup, other_library=True)
    policy = checkpoint.load_policy(info, setup.robot)
    beside = deployer_file(setup.robot, config)
    if beside:
        check_free(output.parent, beside[0])

    run_path = f"{info.robot}/{checkpoint.policy_hash(info)}"
    content = to_onnx(policy, setup.robot, config, run_path=run_path).SerializeToString()
    evaluator = Evaluator(setup, episodes=options.episodes, seed=options.seed)
    start = evaluator.start()
    with progress("run the ONNX in MuJoCo", len(evaluator.clip)) as show:
        record = run_episodes(
            OnnxActor(content),
            setup.robot,
            setup.library,
            evaluator.config,
            start,
            progress=lambda episodes, steps: show(episodes, steps, {}),
        )
    expected = np.asarray(jax.jit(policy.mean_action)(record.observations))
    error = float((np.abs(record.actions - expected) / np.maximum(1.0, np.abs(expected))).max())
    if not error <= ACTION_TOLERANCE:
        raise InputError(f"{path}: the ONNX's actions differ from the policy's by {error:.1e}; nothing was written")
    evaluation = evaluator.rollout(policy)
    early = early_agreement(evaluation, record.rollout)
    if early < EARLY_SHARE:
        raise InputError(
            f"{path}: in MuJoCo the ONNX's tracking reward equals the evaluation's in {early:.0%} of the episodes' "
            f"first {EARLY_STEPS} steps; accepted: {EARLY_SHARE:.0%} or more; where episodes are few, a single contact "
            f"may do that, and not with --episodes 10; nothing was written"
        )
    output.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(output, content)
    files = {"policy": output}
    if beside:
        files["for its deployer"] = output.with_name(beside[0])
        write_atomically(output.with_name(beside[0]), yaml.safe_dump(beside[1], sort_keys=False).encode())
    Console().print(_table(setup.library.names, evaluation, record.rollout))
    say(
        f"{len(record.actions):,} actions equal the policy's to {error:.0e}; in {early:.0%} of the episodes' first "
        f"{EARLY_STEPS} steps tracking equals the evaluation's to {EARLY_TOLERANCE:.0e}; rounding grows at contacts."
    )
    closing(
        files,
        command_line("evaluate", robot=options.robot, checkpoint=path, library=options.library, episodes=100),
    )


def early_agreement(one: Rollout, other: Rollout) -> float:
    """Share of the episodes' first steps, of those that both policies survive, in which tracking rewards are equal."""
    import numpy as np

    from forgetmimic_jax.evaluation.metrics import common_length, steps_before

    steps = min(EARLY_STEPS, one.tracking_reward.shape[1])
    alive = steps_before(common_length([one, other]), steps)
    difference = np.abs(one.tracking_reward[:, :steps] - other.tracking_reward[:, :steps])
    return float((difference[alive] <= EARLY_TOLERANCE).mean())


def _table(names: Sequence[str], evaluation: Rollout, onnx: Rollout):
    """Success and tracking of every clip in the evaluation and with the ONNX."""
    from rich import box
    from rich.table import Table

    from forgetmimic_jax.evaluation.metrics import episode_metrics

    table = Table(title="Evaluation → ONNX in plain MuJoCo", title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for column in ("clip", "success", "tracking", "steps"):
        table.add_column(column, justify="left" if column == "clip" else "right")
    ours, theirs = episode_metrics(evaluation), episode_metrics(onnx)
    shown = {"success_rate": ".0%", "survival_weighted_tracking": ".3f", "episode_length": ".0f"}
    for row, members in [
        *((name, evaluation.clip == i) for i, name in enumerate(names)),
        ("all", evaluation.clip >= 0),
    ]:
        table.add_row(
            row, *(f"{ours[m][members].mean():{f}} → {theirs[m][members].mean():{f}}" for m, f in shown.items())
        )
    return table


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "export")))
