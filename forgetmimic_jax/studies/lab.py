"""Where a study's trials run: its options, checked, and what they make of a trial, a rollout or a table over seeds."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from forgetmimic_jax.basics.console import progress
from forgetmimic_jax.basics.errors import InputError, Interrupted
from forgetmimic_jax.settings.config import Config, preset
from forgetmimic_jax.settings.options import Settings, at_least, comma_separated, override, replace_given
from forgetmimic_jax.studies.document import Known, made_by, origin_of, run_name
from forgetmimic_jax.studies.variants import summary

if TYPE_CHECKING:
    import numpy as np

    from forgetmimic_jax.evaluation.metrics import Rollout
    from forgetmimic_jax.motion.clip import Clip
    from forgetmimic_jax.policy.policy import Policy
    from forgetmimic_jax.studies.trials import Trial
    from forgetmimic_jax.tracking.setup import Setup

Key = tuple[str, int]  # label and seed of a run


@dataclass(kw_only=True)
class Options:
    """Run the missing trials of a study, then write its JSON, its page and its figure."""

    robot: str = "g1"
    """Robot under robots/."""
    base: Path | None = None
    """Checkpoint that every trial starts from; the shipped data/ROBOT/base by default."""
    targets: str | None = None
    """Clips to forget, comma-separated; the library's default targets (g1: punch,kick) by default."""
    preset: Literal["cpu", "paper"] = "cpu"
    """cpu: a laptop's settings and iterations; paper: the paper's, for a GPU."""
    iterations: int | None = None
    """PPO iterations of each trial; the preset's by default."""
    control_iterations: int | None = None
    """Iterations of the retrained control; as many steps as the base was trained for by default."""
    seeds: int = 3
    """Runs of each kind, with the seeds 0, 1, ...; the intervals are over them."""
    episodes: int = 20
    """Evaluation episodes a clip."""
    jobs: int = 2
    """Trials at a time on this machine; they share its cores evenly. With a GPU: 1."""
    cluster: str | None = None
    """Address of a dask scheduler, such as tcp://host:8786, whose workers run the trials; see docs/cluster.md."""
    trials: Path = Path("runs/trials")
    """Folder of the trials, where every study finds the finished ones again."""
    mix_commits: bool = False
    """Take finished runs of other code too; the page then says which code made which run."""
    physics: Literal["auto", "native", "mjx", "mjx-warp"] | None = None
    """Physics engine; auto is native on a CPU and mjx on a GPU or TPU."""
    library: Path | None = None
    """Folder of clips; the base's by default."""
    output: Path | None = None
    """Folder for NAME.json, NAME.md and NAME.png; experiments/results/ROBOT by default."""
    draw: bool = False
    """Only write page and figure again, from the JSON."""
    set: Settings = field(default_factory=list)
    """Any other settings of every trial, such as ppo.learning_rate=1e-4."""


class Lab:
    """The options of a study, checked, and the runs that it has used."""

    def __init__(self, options: Options, iterations: int, known: Mapping[str, Known] | None = None):
        """Check the options.

        Args:
            options: of the study.
            iterations: of each trial.
            known: what the JSON of studies says of trials, by the trial's name (`known_trials`).
        """
        from forgetmimic_jax.tracking.setup import check_targets, default_targets
        from forgetmimic_jax.training import checkpoint
        from forgetmimic_jax.training.start import base_folder

        for flag in ("seeds", "episodes", "jobs"):
            at_least(1, f"--{flag}", getattr(options, flag))
        at_least(1, "--iterations", iterations)
        self.options, self.iterations = options, iterations
        self.base = options.base or base_folder(options.robot)
        self.info = checkpoint.read_info(self.base)
        if self.info.robot != options.robot:
            raise InputError(f"{self.base}: robot: found '{self.info.robot}'; --robot is '{options.robot}'")
        self.config: Config = replace_given(self.info.config, library=options.library)
        self.targets = default_targets(self.config) if options.targets is None else comma_separated(options.targets)
        if not self.targets:
            raise InputError("--targets: no clip named; name at least one to forget, such as --targets punch,kick")
        check_targets(self.targets, self.info.clips)
        self.seeds = tuple(range(options.seeds))
        self.failed: dict[str, str] = {}
        self.stopped: Interrupted | None = None
        self._known = known or {}
        self._origins: dict[str, Mapping[str, Any]] = {}

    @property
    def control_iterations(self) -> int:
        """Iterations of a policy that is trained from scratch: as many environment steps as the base's by default."""
        config = preset("paper") if self.options.preset == "paper" else self.config
        ppo = override(config, itertools.chain(*self.options.set)).ppo
        steps = ppo.num_envs * ppo.num_steps
        return self.options.control_iterations or max(1, round(self.info.environment_steps / steps))

    @property
    def control_seeds(self) -> tuple[int, ...]:
        """Seeds of a policy that is trained from scratch, which a laptop can afford once."""
        return self.seeds[:1] if self.options.preset == "cpu" else self.seeds

    def conditions(self) -> dict[str, Any]:
        """What the results answer."""
        from forgetmimic_jax.training.checkpoint import policy_hash

        return {
            "robot": self.options.robot,
            "base": policy_hash(self.info),
            "base_environment_steps": self.info.environment_steps,
            "library": self.info.library_hash,
            "targets": list(self.targets),
            "preset": self.options.preset,
            "iterations": self.iterations,
            "seeds": len(self.seeds),
            "episodes": self.options.episodes,
            "set": list(itertools.chain(*self.options.set)),
            **({"physics": self.options.physics} if self.options.physics else {}),
        }

    def made_by(self) -> list[dict[str, Any]]:
        """Which code and machine made which of the runs used."""
        return made_by(self._origins)

    def trial(self, variant: Mapping[str, Any]) -> Trial:
        """A trial that differs from the default unlearning run by options of `unlearn`; `set` adds to the study's."""
        from forgetmimic_jax.studies.trials import make_trial

        options = self.options
        conditions = {
            "robot": options.robot,
            "base": self.base,
            "targets": ",".join(self.targets),
            "iterations": self.iterations,
            "episodes": options.episodes,
            "physics": options.physics,
            "library": options.library,
            "preset": "paper" if options.preset == "paper" else None,  # else the base's own settings
            "no_stop": True,  # rows are compared at the same budget
        }
        together = [*itertools.chain(*options.set), *variant.get("set", [])]
        return make_trial(options.trials, {**conditions, **variant, "set": together})

    def run(self, variants: Mapping[Key, Mapping[str, Any]], what: str) -> dict[Key, Path]:
        """Train and evaluate the variants that are not finished; returns the folders of those that are then.

        Args:
            variants: options of `unlearn` (see `trial`) by label and seed.
            what: for the progress line.

        Raises:
            InputError: every trial failed.
        """
        return self._run({key: self.trial(variant) for key, variant in variants.items()}, what, others=False)

    def _run(self, trials: Mapping[Key, Trial], what: str, *, others: bool) -> dict[Key, Path]:
        """See `run`; `others` says that trials beside these are finished already."""
        from forgetmimic_jax.studies.trials import run_trials

        missing = [trial for trial in trials.values() if self._finished(trial) is None]
        jobs, cluster = self.options.jobs, self.options.cluster
        failed = run_trials(missing, jobs=jobs, cluster=cluster, description=what) if missing else {}
        self.failed |= {trial.folder.name: reason for trial, reason in failed.items()}
        finished = self._folders(trials)
        if not finished and not others:
            raise InputError(f"{what}: every trial failed; the first: {next(iter(failed.values()))}")
        return finished

    def _folders(self, trials: Mapping[Key, Trial]) -> dict[Key, Path]:
        """The folders of the trials that are finished, whose origins it notes."""
        finished = {key: folder for key, trial in trials.items() if (folder := self._finished(trial))}
        self._origins |= {run_name(*key): origin_of(folder) for key, folder in finished.items()}
        return finished

    def _finished(self, trial: Trial) -> Path | None:
        """The folder of a trial that is finished, with --mix-commits also that of the same trial of other code."""
        from forgetmimic_jax.studies.trials import without_code

        if trial.finished:
            return trial.folder
        others = sorted(self.options.trials.glob("*/evaluation.json")) if self.options.mix_commits else []
        alike = (path.parent for path in others if without_code(path.parent.name) == without_code(trial.folder.name))
        return next(alike, None)

    def _stored(self, trial: Trial) -> Known | None:
        """What a study's JSON says of a trial, with --mix-commits also of the same trial of other code."""
        from forgetmimic_jax.studies.trials import without_code

        name = trial.folder.name
        if name in self._known or not self.options.mix_commits:
            return self._known.get(name)
        return next((known for of, known in self._known.items() if without_code(of) == without_code(name)), None)

    def over_seeds(
        self, variants: Mapping[str, Mapping[str, Any]], what: str, *, seeds: Mapping[str, Sequence[int]] | None = None
    ) -> dict[str, Any]:
        """Every variant with every seed: {"variants": {label: {"options", "trials", "seeds": {seed: summary}}}}.

        Runs only what neither a JSON nor a folder has. Ctrl-C leaves the trials that are finished by then, and
        `stopped` says so.

        Args:
            variants: by label, options of `unlearn`.
            what: for the progress line.
            seeds: by label, other seeds than the study's.
        """
        every = {label: (seeds or {}).get(label, self.seeds) for label in variants}
        keys: Iterable[Key] = sorted(((label, seed) for label in variants for seed in every[label]), key=lambda k: k[1])
        trials = {(label, seed): self.trial({**variants[label], "seed": seed}) for label, seed in keys}
        stored = {key: known for key, trial in trials.items() if (known := self._stored(trial))}
        self._origins |= {run_name(*key): known.made_by for key, known in stored.items()}
        missing = {key: trial for key, trial in trials.items() if key not in stored}
        try:
            folders = self._run(missing, what, others=bool(stored)) if missing else {}
        except Interrupted as stop:
            folders = self._folders(missing)
            if not folders and not stored:
                raise
            self.stopped = stop
            self.failed |= {trial.folder.name: "stopped" for key, trial in missing.items() if key not in folders}
        found = {key: (known.trial, known.summary) for key, known in stored.items()}
        found |= {key: (folder.name, summary(folder)) for key, folder in folders.items()}
        result = {}
        for label, variant in variants.items():
            runs = {seed: found[label, seed] for seed in every[label] if (label, seed) in found}
            if runs:
                result[label] = {
                    "options": {name: str(value) for name, value in variant.items()},
                    "trials": {str(seed): name for seed, (name, _) in runs.items()},
                    "seeds": {str(seed): run for seed, (_, run) in runs.items()},
                }
        return {"variants": result}

    def watched(self, times: int) -> list[str]:
        """Settings of a trial that is evaluated so often during training, on half of the study's episodes."""
        episodes = watched_episodes(self.options.episodes)
        return [f"evaluate_every={max(1, self.iterations // times)}", f"evaluate_episodes={episodes}"]

    def as_watched(self, policies: Mapping[str, Path], seed: int) -> dict[str, dict[str, dict[str, float]]]:
        """Policies, clip by clip, on the episodes on which a watched trial of this seed is evaluated."""
        from forgetmimic_jax.training.watch import clip_means

        rolled, names = self.rollouts(policies, episodes=watched_episodes(self.options.episodes), seed=seed)
        return {key: clip_means(rollout, names) for key, rollout in rolled.items()}

    def rollouts(
        self,
        policies: Mapping[Any, Path | None],
        clips: Sequence[Clip] | None = None,
        *,
        episodes: int | None = None,
        seed: int = 0,
    ) -> tuple[dict[Any, Rollout], tuple[str, ...]]:
        """Every policy on the same episodes, and the clips' names.

        Args:
            policies: checkpoints by any key; None is the zero-action baseline.
            clips: other clips than the library's.
            episodes: a clip; the study's by default.
            seed: of the episodes.
        """
        from forgetmimic_jax.evaluation.rollout import Evaluator
        from forgetmimic_jax.motion.library import build_library

        setup = self._setup()
        library = setup.library if clips is None else build_library(setup.robot, clips)
        evaluator = Evaluator(
            dataclasses.replace(setup, library=library), episodes=episodes or self.options.episodes, seed=seed
        )
        rolled = {}
        with progress("roll out", len(policies)) as report:
            for done, (key, path) in enumerate(policies.items(), start=1):
                rolled[key] = evaluator.rollout(self._policy(path, setup))
                report(done, 0, {})
        return rolled, library.names

    def unbounded(self, policies: Mapping[Any, Path | None]) -> dict[Any, dict[str, np.ndarray]]:
        """What every policy does on the targets without terminations: by its key, each number f[E] of each episode.

        Args:
            policies: checkpoints by any key; None is the zero-action baseline.
        """
        from forgetmimic_jax.evaluation.unbounded import episode_numbers, roll_out

        setup = self._setup()
        loaded = {key: self._policy(path, setup) for key, path in policies.items()}
        rolled = roll_out(setup, loaded, self.targets, episodes=self.options.episodes, seed=0)
        return {key: episode_numbers(rollout) for key, rollout in rolled.items()}

    def _setup(self) -> Setup:
        from forgetmimic_jax.settings.options import on_engine
        from forgetmimic_jax.tracking.setup import make_setup

        return make_setup(on_engine(self.config, self.options.physics))

    def _policy(self, path: Path | None, setup: Setup) -> Policy | None:
        from forgetmimic_jax.training import checkpoint

        return None if path is None else checkpoint.load_policy(checkpoint.read_info(path), setup.robot)


def watched_episodes(episodes: int) -> int:
    """Episodes a clip in an evaluation during training: half of the study's."""
    return max(1, episodes // 2)


def newest_policy(folder: Path) -> Path:
    """The checkpoint that a finished trial ended with."""
    from forgetmimic_jax.training.checkpoint import newest_checkpoint

    newest = newest_checkpoint(folder)
    assert newest is not None
    return newest
