"""Pretraining: a run that follows its curriculum. Here is what the phases do; when they do it is in `curriculum`.

All of it is a function of the run's state and of files that never change once they are written, so a run that is killed
ends with the same bits: what stood between its newest checkpoint and the kill is made again. The folder of the run has
besides what every run has:

policies/NUMBER   the policies that the curriculum may still need, by the number of their evaluation

What is evaluated and kept has the averaged parameters, if the run averages them: single iterations scatter.

Clips that the training leaves out (the targets of a retrained control) are evaluated too, but the curriculum does not
know them and no episode starts from them.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import msgspec
from rich.console import Console

from forgetmimic_jax.basics.console import say
from forgetmimic_jax.policy.policy import Policy
from forgetmimic_jax.ppo.state import TrainState, init_state
from forgetmimic_jax.settings.config import Config
from forgetmimic_jax.tracking.env import Assets, Environment, make_assets
from forgetmimic_jax.tracking.focus import Focus
from forgetmimic_jax.tracking.setup import Setup
from forgetmimic_jax.training import checkpoint
from forgetmimic_jax.training.checkpoint import CheckpointInfo, Progress, checkpoints
from forgetmimic_jax.training.course import Position, evaluates
from forgetmimic_jax.training.curriculum import (
    ClipProgress,
    Curriculum,
    Kept,
    Measured,
    advance,
    settings_of,
)
from forgetmimic_jax.training.devices import agreed
from forgetmimic_jax.training.distil import DistilConfig, begin, distil
from forgetmimic_jax.training.folder import BEST
from forgetmimic_jax.training.search import SearchConfig, first_failure, search
from forgetmimic_jax.training.teaching import Lesson, PolicyTeacher, make_teaching
from forgetmimic_jax.training.watch import Watch

POLICIES = "policies"


class Pretraining:
    """The course of a run through the phases; see `course.Course`."""

    command = "pretrain"
    _watch: Watch

    def __init__(
        self, setup: Setup, env: Environment, directory: Path, console: Console, resumed: CheckpointInfo | None
    ):
        self._setup, self._env, self._directory, self._console = setup, env, directory, console
        self._names, left_out = setup.library.names, setup.config.unlearn.targets
        self._curriculum = Curriculum({name: ClipProgress() for name in self._names if name not in left_out})
        if resumed is not None:
            self._curriculum = msgspec.convert(resumed.curriculum, Curriculum)
        self._plain_assets = make_assets(setup)
        self._start = jax.jit(lambda assets, key, policy, level: init_state(env, assets, key, policy, level))

    @property
    def finished(self) -> bool:
        return self._curriculum.phase == "done"

    @property
    def curriculum(self) -> Mapping[str, Any]:
        values: Mapping[str, Any] = msgspec.to_builtins(self._curriculum)
        return values

    @property
    def note(self) -> Mapping[str, Any]:
        now = self._curriculum
        states = now.states(self._config.pretrain)
        specialist = {"specialist": now.specialist} if now.specialist else {}
        return {"phase": now.phase, **specialist, "clips": {name: {"state": state} for name, state in states.items()}}

    @property
    def _config(self) -> Config:
        return self._setup.config

    def begin(self, position: Position) -> Position:
        self._watch = Watch(self._setup, self._directory, position.iteration)
        if self._config.base and not self._curriculum.number:
            self._measure(position)  # the base may be better than what training makes of it
        return dataclasses.replace(position, assets=self._assets(position.state.policy))

    def after(self, position: Position) -> Position:
        return self._evaluated(position) if evaluates(self._config, position.iteration) else position

    def _evaluated(self, position: Position) -> Position:
        before = self._curriculum
        self._measure(position)
        if self._curriculum.stage != before.stage:
            position = self._next_stage(position)
        self._forget_policies()
        self._console.print(self._watch.table())
        if self.finished:
            return position
        return dataclasses.replace(position, assets=self._assets(position.state.policy))

    def _measure(self, position: Position) -> None:
        """Evaluate the position's policy, and advance the curriculum by what is found."""
        policy, now = position.state.averaged, self._curriculum
        row = self._watch.measure(policy, position.iteration, position.environment_steps)
        found = {name: _measured(of) for name, of in row["clips"].items() if name in now.clips}
        self._curriculum = advance(self._config, now, found, position.iteration)
        specialist = {"specialist": now.specialist} if now.specialist else {}
        states = self._curriculum.states(self._config.pretrain)
        clips = {name: of | ({"state": states[name]} if name in states else {}) for name, of in row["clips"].items()}
        self._watch.add({**row, "phase": now.phase, **specialist, "clips": clips})
        best = self._curriculum.best
        if best is not None and best.number == self._curriculum.number:
            self._save(self._directory / BEST, policy, position)
        if self._curriculum.number in _numbers(self._curriculum):
            self._save(self._policy_folder(self._curriculum.number), policy, position)

    def _next_stage(self, position: Position) -> Position:
        """The state that a new stage starts with: fresh episodes, Adam reset."""
        now, config = self._curriculum, self._config
        policy, steps, level = self._load(now.start), position.environment_steps, position.state.failure_level
        key = jax.random.fold_in(jax.random.PRNGKey(config.seed), now.stage)
        say(_headline(now, now.unmastered(config.pretrain)), self._console)
        if now.phase == "stuck" and not now.clips[now.specialists[0]].completed:
            policy, used = self._first_success(policy, now.specialists[0], key)
            steps += used
        if now.phase == "distil":
            policy, used = self._distilled(policy, key)
            steps += used
        fresh: TrainState = self._start(self._assets(policy), key, policy, level)
        old = position.state
        state = dataclasses.replace(
            fresh, learning_rate=old.learning_rate, iteration=old.iteration, diverged=old.diverged
        )
        position = dataclasses.replace(position, state=state, environment_steps=steps)
        if now.phase == "distil":
            self._measure(position)
            return position if self.finished else self._next_stage(position)
        return position

    def _assets(self, policy: Policy) -> Assets:
        """The run's arrays with the focus of the next iterations, and the best policy, if there is one, to stay near.

        A policy without weight in the loss stands in its place, so that the program is the same.
        """
        settings, best = settings_of(self._config, self._curriculum), self._curriculum.best
        focus = Focus(
            starts=self._by_clip(settings.starts),
            base_kl=self._by_clip(settings.best_kl),
            target_kl=jnp.float32(settings.target_kl),
            gae_lambda=jnp.float32(settings.gae_lambda),
        )
        # A copy, since an iteration donates the state that the policy is in.
        base = self._load(best) if any(settings.best_kl) and best is not None else jax.tree.map(jnp.copy, policy)
        return dataclasses.replace(self._plain_assets, focus=focus, base=base)

    def _by_clip(self, values: tuple[float, ...]) -> jax.Array:
        """Values of the curriculum's clips as f32[clip] of the library; 0 for a clip that is left out."""
        of = dict(zip(self._curriculum.clips, values, strict=True))
        return jnp.asarray([of.get(name, 0.0) for name in self._names], jnp.float32)

    def _indices(self, *without: str) -> list[int]:
        """The curriculum's clips in the library, but for some."""
        return [self._names.index(name) for name in self._curriculum.clips if name not in without]

    def _first_success(self, policy: Policy, clip: str, key: jax.Array) -> tuple[Policy, int]:
        """The policy after regression on what a search found for a clip that it never completes, and the steps used."""
        rounds, index, robots = self._config.pretrain.search_rounds, self._names.index(clip), self._env.num_envs
        if not rounds:
            return policy, 0
        assets = self._assets(policy)
        failure = first_failure(self._env, assets, policy, index)
        if failure < 0:
            return policy, 0
        size = SearchConfig(rounds=max(1, round(0.6 * rounds)), noisy_rounds=max(1, round(0.4 * rounds)))
        found = search(self._env, assets, policy, index, failure, size)
        used = (size.rounds + size.noisy_rounds + 1) * robots * found.steps
        say(
            f"{clip}: falls at frame {failure}; a search passes it in {found.passed:.0%} of the rollouts", self._console
        )
        if not found.passed:
            return policy, used
        taught, more = self._regression(policy, [(policy, self._indices(clip) or [index])], key, found.lessons)
        return taught, used + more

    def _distilled(self, best: Policy, key: jax.Array) -> tuple[Policy, int]:
        """The best policy and the experts as one, and the steps used."""
        experts = self._curriculum.experts
        others = self._indices(*experts)
        taught = [(best, others)] if others else []
        taught += [(self._load(kept), [self._names.index(name)]) for name, kept in experts.items()]
        return self._regression(best, taught, key)

    def _regression(
        self, student: Policy, taught: list[tuple[Policy, list[int]]], key: jax.Array, shown: Lesson | None = None
    ) -> tuple[Policy, int]:
        """The student after regression on teachers, each with its clips, and the steps used."""
        config = DistilConfig(rounds=self._config.pretrain.distil_rounds, normalizer_rounds=0)
        assets, robots = self._assets(student), self._env.num_envs
        teaching = make_teaching(assets, [(PolicyTeacher(policy), clips) for policy, clips in taught], shown)
        start = begin(self._env, assets, teaching, student, key)
        end = distil(self._env, assets, teaching, start, config)
        return end.student, int(end.round) * robots * config.steps

    def _policy_folder(self, number: int) -> Path:
        return self._directory / POLICIES / f"{number:04d}"

    def _save(self, path: Path, policy: Policy, position: Position) -> None:
        progress = Progress(position.iteration, position.environment_steps)
        checkpoint.save_policy(path, self._setup, policy, position.state.failure_level, progress)

    def _load(self, kept: Kept) -> Policy:
        info = checkpoint.read_info(self._policy_folder(kept.number))
        return checkpoint.load_policy(info, self._setup.robot)

    def _forget_policies(self) -> None:
        """Remove the policies that neither this curriculum nor one in a checkpoint of the run still names."""
        saved = [checkpoint.read_info(path).curriculum for path in checkpoints(self._directory)]
        needed = _numbers(self._curriculum).union(*(_numbers(msgspec.convert(one, Curriculum)) for one in saved))
        for folder in (self._directory / POLICIES).glob("[0-9]*"):
            if int(folder.name) not in needed:
                shutil.rmtree(folder)


def _measured(clip: Mapping[str, float]) -> Measured:
    """What a row of evaluations.jsonl says of a clip; the same on all processes of a training."""
    return Measured(
        success=agreed(clip["success_rate"]),
        tracking=agreed(clip["survival_weighted_tracking"]),
        steps=agreed(clip["episode_length"]),
        completed=agreed(clip["completed"]) > 0.0,
    )


def _numbers(curriculum: Curriculum) -> set[int]:
    """The policies that a curriculum names."""
    kept = [*curriculum.experts.values(), *([curriculum.best] if curriculum.best else [])]
    return {policy.number for policy in kept}


def _headline(now: Curriculum, unmastered: list[str]) -> str:
    """What the terminal says of a stage that begins."""
    if now.phase == "stuck":
        return f"specialist for {now.specialists[0]} (then {', '.join(now.specialists[1:]) or 'distillation'})"
    of = {"lagging": ", ".join(unmastered), "distil": ", ".join(now.experts)}
    return f"{now.phase}: {of.get(now.phase, '')}"
