"""Policies side by side on the same episodes: rollouts, statistics, files and the terminal's table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from forgetmimic_jax.basics.console import progress
from forgetmimic_jax.evaluation.metrics import ZERO_ACTION
from forgetmimic_jax.evaluation.report import evaluate_policies, evaluation_document, write_evaluation
from forgetmimic_jax.evaluation.rollout import Evaluator
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.settings.config import config_hash
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.training.checkpoint import CheckpointInfo

EPISODES = 20  # a clip


def evaluate(
    setup: Setup,
    policies: Mapping[str, Policy],
    *,
    checkpoint: str,
    targets: tuple[str, ...],
    episodes: int,
    seed: int,
    budget: Mapping[str, Mapping[str, float]],
) -> dict[str, Any]:
    """The evaluation document of `policies` (name → networks) and the zero-action baseline."""
    evaluator = Evaluator(setup, episodes=episodes, seed=seed)
    rollouts = {}
    everyone: dict[str, Policy | None] = {**policies, ZERO_ACTION: None}
    with progress("evaluate", len(everyone)) as report:
        for done, (name, policy) in enumerate(everyone.items(), start=1):
            rollouts[name] = evaluator.rollout(policy)
            report(done, sum(int(rollout.length.sum()) for rollout in rollouts.values()), {})
    return evaluation_document(
        evaluate_policies(rollouts, setup.library.names, targets, seed=seed),
        robot=setup.robot.name,
        checkpoint=checkpoint,
        config_hash=config_hash(setup.config),
        library_hash=setup.library_hash,
        seed=seed,
        episodes=episodes,
        targets=targets,
        budget=budget,
    )


def cost(info: CheckpointInfo) -> dict[str, float]:
    """What a checkpoint's training cost."""
    return {"environment_steps": info.environment_steps}


def show_and_write(directory: Path, document: dict[str, Any]) -> dict[str, Path]:
    """Write evaluation.json, evaluation.md and evaluation.png, print the table; what was written, by name."""
    from rich.console import Console

    from forgetmimic_jax.evaluation.plots import clip_bars
    from forgetmimic_jax.evaluation.tables import render_table

    as_json, as_markdown = write_evaluation(directory, document)
    picture = directory / "evaluation.png"
    clip_bars(document, picture)
    Console().print(render_table(document))
    return {"evaluation": as_json, "table": as_markdown, "bars": picture}
