"""Policies side by side on the same episodes: rollouts, statistics, files and the terminal's table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp

from forgetmimic_jax.basics.console import progress
from forgetmimic_jax.basics.files import write_atomically
from forgetmimic_jax.basics.provenance import made_here
from forgetmimic_jax.evaluation import unbounded
from forgetmimic_jax.evaluation.document import FILE, SCHEMA, EvaluationDocument, write_evaluation
from forgetmimic_jax.evaluation.metrics import ZERO_ACTION
from forgetmimic_jax.evaluation.rollout import Evaluator, Switched
from forgetmimic_jax.evaluation.summary import evaluate_policies
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.settings.config import config_hash
from forgetmimic_jax.tracking.setup import Setup


class Subject(NamedTuple):
    """A policy that is evaluated, and where it comes from."""

    policy: Policy
    policy_hash: str  # of its checkpoint
    environment_steps: int  # that it was trained for


def evaluate(
    setup: Setup,
    subjects: Mapping[str, Subject],
    *,
    checkpoint: str,
    targets: tuple[str, ...],
    episodes: int,
    seed: int,
    noise: bool = False,
) -> EvaluationDocument:
    """The evaluation of policies and of the zero-action baseline on the same episodes; see `rollout`, `unbounded`.

    Args:
        setup: robot, clips and settings.
        subjects: by name, such as base and unlearned.
        checkpoint: what is evaluated, as the user named it.
        targets: clips to forget.
        episodes: a clip.
        seed: of the start frames, the resets, the noise and the bootstrap.
        noise: with the randomisation, the pushes and the sensor noise of training; then every episode has its bounds.
    """
    evaluator = Evaluator(setup, episodes=episodes, seed=seed, noise=noise)
    rollouts = {}
    everyone: dict[str, Policy | None] = {name: subject.policy for name, subject in subjects.items()}
    everyone[ZERO_ACTION] = None
    some_policy = next(iter(subjects.values())).policy
    with progress("evaluate", len(everyone)) as show:
        for done, (name, policy) in enumerate(everyone.items(), start=1):
            rollouts[name] = evaluator.rollout(Switched(policy or some_policy, jnp.asarray(policy is not None)))
            show(done, sum(int(rollout.length.sum()) for rollout in rollouts.values()), {})
    policies = evaluate_policies(rollouts, setup.library.names, targets, seed=seed)
    if targets and not noise:
        instead = unbounded.roll_out(setup, everyone, targets, episodes=episodes, seed=seed)
        unbounded.add_numbers(policies, instead, setup.library.names, seed=seed)
    return EvaluationDocument(
        schema=SCHEMA,
        robot=setup.robot.name,
        checkpoint=checkpoint,
        config_hash=config_hash(setup.config),
        library_hash=setup.library_hash,
        seed=seed,
        episodes=episodes,
        noise=noise,
        targets=list(targets),
        policies=policies,
        budget={name: {"environment_steps": subject.environment_steps} for name, subject in subjects.items()},
        made=made_here(),
        policy_hashes={name: subject.policy_hash for name, subject in subjects.items()},
        action_mode=setup.config.action.mode,
    )


def show_and_write(directory: Path, document: EvaluationDocument) -> dict[str, Path]:
    """Write evaluation.json, evaluation.md and evaluation.png, print the table; what was written, by name."""
    from rich.console import Console

    from forgetmimic_jax.evaluation.plots import clip_bars
    from forgetmimic_jax.evaluation.tables import markdown, render_table

    files = {"evaluation": directory / FILE}
    files |= {"table": files["evaluation"].with_suffix(".md"), "bars": files["evaluation"].with_suffix(".png")}
    write_evaluation(files["evaluation"], document)
    write_atomically(files["table"], markdown(document).encode())
    clip_bars(document, files["bars"])
    Console().print(render_table(document))
    return files
