"""Where a study's trials run: its options, checked, and what they make of a trial, a rollout or a table."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from forgetmimic_jax.basics.console import progress
from forgetmimic_jax.basics.errors import InputError, Interrupted
from forgetmimic_jax.basics.provenance import made_here
from forgetmimic_jax.evaluation.repeats import Repeat
from forgetmimic_jax.settings.config import Config, preset
from forgetmimic_jax.settings.options import at_least, comma_separated, override, replace_given
from forgetmimic_jax.studies.document import Known, made_by, origin_of, run_name
from forgetmimic_jax.studies.options import Options
from forgetmimic_jax.studies.variants import summary

if TYPE_CHECKING:
    import numpy as np

    from forgetmimic_jax.evaluation.metrics import Rollout
    from forgetmimic_jax.motion.clip import Clip
    from forgetmimic_jax.policy.policy import Policy
    from forgetmimic_jax.studies.trials import Trial
    from forgetmimic_jax.tracking.setup import Setup
    from forgetmimic_jax.training.checkpoint import CheckpointInfo

FOLDERS = ("base", "library")  # options that name a place on this machine
SEEDS = 3  # of one base, or of a study without a base
Key = tuple[str, Repeat]  # a run: its label, and from which base with which seed


class Lab:
    """The options of a study, checked, and the runs that it has used."""

    def __init__(
        self, options: Options, iterations: int, known: Mapping[str, Known] | None = None, *, fresh: bool = False
    ):
        """Check the options.

        Args:
            options: of the study.
            iterations: of each trial.
            known: what the JSON of studies says of trials, by the trial's name (`known_trials`).
            fresh: the study trains fresh policies, so that its unit is the seed, however many bases there are.
        """
        from forgetmimic_jax.studies.executor import at_a_time
        from forgetmimic_jax.studies.policies import find_bases, find_controls
        from forgetmimic_jax.tracking.setup import check_targets, default_targets

        self.jobs = at_a_time(options.jobs, options.cluster, few=2)
        at_least(1, "--episodes", options.episodes)
        at_least(1, "--iterations", iterations)
        self.options, self.iterations = options, iterations
        self.bases = find_bases(options)
        self.seeds = (1 if len(self.bases) > 1 and not fresh else SEEDS) if options.seeds is None else options.seeds
        at_least(1, "--seeds", self.seeds)
        self.config: Config = replace_given(self.bases[0].config, library=options.library)
        self.targets = default_targets(self.config) if options.targets is None else comma_separated(options.targets)
        if not self.targets:
            raise InputError("--targets: no clip named; name at least one to forget, such as --targets punch,kick")
        check_targets(self.targets, self.bases[0].clips)
        self.controls = find_controls(options, self.targets, self.bases)
        seeds = range(self.seeds)  # of all bases first, so that a study that is stopped has as many of each
        self.repeats = tuple(Repeat(base, seed) for seed in seeds for base in range(len(self.bases)))
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
        return self.options.control_iterations or max(1, round(self.bases[0].environment_steps / steps))

    @property
    def retrained(self) -> dict[Repeat, dict[str, Any]]:
        """The retrained control, by repeat as options of `trial`: the controls there are, or training from scratch.

        A laptop can afford to train once.
        """
        if self.controls:
            return {Repeat(base, 0): {"control": True} for base in range(len(self.controls))}
        repeats = self.repeats[:1] if self.options.preset == "cpu" else self.repeats
        return {repeat: {"method": "retrain", "iterations": self.control_iterations} for repeat in repeats}

    def conditions(self) -> dict[str, Any]:
        """What the results answer."""
        return {
            "robot": self.options.robot,
            "bases": [_policy(base) for base in self.bases],
            "library": self.bases[0].library_hash,
            "targets": list(self.targets),
            "preset": self.options.preset,
            "iterations": self.iterations,
            "seeds": self.seeds,
            "episodes": self.options.episodes,
            "set": list(itertools.chain(*self.options.set)),
            **({"physics": self.options.physics} if self.options.physics else {}),
        }

    def control_conditions(self) -> dict[str, Any]:
        """Of a study that has the retrained control: which one."""
        if self.controls:
            return {"controls": [_policy(control) for control in self.controls]}
        return {"control_iterations": self.control_iterations}

    def made_by(self) -> list[dict[str, Any]]:
        """Which code and machine made which of the runs used."""
        return made_by(self._origins)

    def trial(self, variant: Mapping[str, Any], repeat: Repeat) -> Trial:
        """A trial that differs from the default unlearning run by options of `unlearn`.

        Args:
            variant: the options; `set` adds to the study's. `control`: the evaluation of the control of the base.
            repeat: the base and the seed, where the options do not name others.
        """
        from forgetmimic_jax.studies.trials import control_trial, make_trial

        options, base = self.options, self.bases[repeat.base]
        if "control" in variant:
            control = self.controls[repeat.base]
            return control_trial(
                options.trials, control, base, episodes=options.episodes, seed=repeat.seed, physics=options.physics
            )
        conditions = {
            "robot": options.robot,
            "base": base.path,
            "seed": repeat.seed,
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
            variants: options of `trial` by label and repeat.
            what: for the progress line.

        Raises:
            InputError: every trial failed.
        """
        return self._run({key: self.trial(variant, key[1]) for key, variant in variants.items()}, what, others=False)

    def _run(self, trials: Mapping[Key, Trial], what: str, *, others: bool) -> dict[Key, Path]:
        """See `run`; `others` says that trials beside these are finished already."""
        from forgetmimic_jax.studies.trials import run_trials

        missing = [trial for trial in trials.values() if self._finished(trial) is None]
        jobs, cluster = self.jobs, self.options.cluster
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

    def over_repeats(
        self,
        variants: Mapping[str, Mapping[str, Any]],
        what: str,
        *,
        others: Mapping[str, Mapping[Repeat, Mapping[str, Any]]] | None = None,
    ) -> dict[str, Any]:
        """Every variant with every repeat: {"variants": {label: {"options", "trials", "runs": {repeat: summary}}}}.

        Runs only what neither a JSON nor a folder has. Ctrl-C leaves the trials that are finished by then, and
        `stopped` says so.

        Args:
            variants: by label, options of `trial`.
            what: for the progress line.
            others: more variants by label, with options and repeats of their own.
        """
        every: dict[str, Mapping[Repeat, Mapping[str, Any]]] = {
            label: dict.fromkeys(self.repeats, variant) for label, variant in variants.items()
        }
        every |= others or {}
        keys = [(label, repeat) for repeat in self.repeats for label, of in every.items() if repeat in of]
        trials = {(label, repeat): self.trial(every[label][repeat], repeat) for label, repeat in keys}
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
        for label, of in every.items():
            runs = {repeat: found[label, repeat] for repeat in of if (label, repeat) in found}
            if runs:
                result[label] = {
                    "options": {
                        name: str(value) for name, value in next(iter(of.values())).items() if name not in FOLDERS
                    },
                    "trials": {str(repeat): name for repeat, (name, _) in runs.items()},
                    "runs": {str(repeat): run for repeat, (_, run) in runs.items()},
                }
        return {"variants": result}

    def watched(self, times: int) -> list[str]:
        """Settings of a trial that is evaluated so often during training, on half of the study's episodes."""
        episodes = watched_episodes(self.options.episodes)
        return [f"evaluate_every={max(1, self.iterations // times)}", f"evaluate_episodes={episodes}"]

    def as_watched(self, policies: Mapping[str, Path], seed: int) -> dict[str, dict[str, dict[str, float]]]:
        """Policies, clip by clip, on the episodes on which a watched trial of this seed is evaluated."""
        from forgetmimic_jax.training.watch import clip_means, seed_of_episodes

        episodes = watched_episodes(self.options.episodes)
        rolled, names = self.rollouts(policies, episodes=episodes, seed=seed_of_episodes(seed))
        return {key: clip_means(rollout, names) for key, rollout in rolled.items()}

    def rollouts(
        self,
        policies: Mapping[Any, Path | None],
        clips: Sequence[Clip] | None = None,
        *,
        episodes: int | None = None,
        seed: int = 0,
        noise: bool = False,
    ) -> tuple[dict[Any, Rollout], tuple[str, ...]]:
        """Every policy on the same episodes, and the clips' names.

        Args:
            policies: checkpoints by any key, which names a run where it is a label and a repeat; None is the
                zero-action baseline.
            clips: other clips than the library's.
            episodes: a clip; the study's by default.
            seed: of the episodes.
            noise: with the randomisation, the pushes and the sensor noise of training.
        """
        from forgetmimic_jax.evaluation.rollout import Evaluator
        from forgetmimic_jax.motion.library import build_library

        setup = self._setup()
        library = setup.library if clips is None else build_library(setup.robot, clips)
        setup = dataclasses.replace(setup, library=library)
        evaluator = Evaluator(setup, episodes=episodes or self.options.episodes, seed=seed, noise=noise)
        rolled = {}
        with progress("roll out", len(policies)) as show:
            for done, (key, path) in enumerate(policies.items(), start=1):
                rolled[key] = evaluator.rollout(self._policy(path, setup))
                show(done, 0, {})
        here = dataclasses.asdict(made_here())  # what no trial made was made here
        self._origins = {run_name(*key): here for key in policies if isinstance(key, tuple)} | self._origins
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


def _policy(of: CheckpointInfo) -> dict[str, Any]:
    """A base or a control in the JSON."""
    from forgetmimic_jax.training.checkpoint import policy_hash

    return {"policy": policy_hash(of), "environment_steps": of.environment_steps}


def watched_episodes(episodes: int) -> int:
    """Episodes a clip in an evaluation during training: half of the study's."""
    return max(1, episodes // 2)


def newest_policy(folder: Path) -> Path:
    """The checkpoint that a finished trial ended with or, where it trained nothing, that it evaluated."""
    from forgetmimic_jax.evaluation.document import FILE, read_evaluation
    from forgetmimic_jax.training.checkpoint import newest_checkpoint

    return newest_checkpoint(folder) or Path(read_evaluation(folder / FILE).checkpoint)
