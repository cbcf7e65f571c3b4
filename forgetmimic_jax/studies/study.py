"""A study: trials, what is measured of them, and how it is told: one JSON, one page with its table, one figure.

The JSON is the only source of the page and the figure. Every study takes the same options and finds the finished trials
of the others (`trials`) and what their JSON says of them; one whose JSON already answers what is asked runs nothing.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import sys
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import tyro
from rich.console import Console
from rich.markdown import Markdown

from forgetmimic_jax.basics.console import closing, progress
from forgetmimic_jax.basics.errors import InputError, Interrupted, run_command
from forgetmimic_jax.basics.files import write_atomically
from forgetmimic_jax.evaluation.plots import save
from forgetmimic_jax.evaluation.variants import over_seeds, summary, variant_bars, variant_table
from forgetmimic_jax.settings.config import Config, preset
from forgetmimic_jax.settings.options import Settings, at_least, comma_separated, override, replace_given

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from forgetmimic_jax.evaluation.metrics import Rollout
    from forgetmimic_jax.motion.clip import Clip
    from forgetmimic_jax.studies.trials import Trial

# Of a trial: enough to tell variants apart. On a laptop `make unlearn` goes on for longer, and the studies of one
# variant at that length say so.
ITERATIONS = {"cpu": 200, "paper": 1000}
RESULTS = Path(__file__).resolve().parents[2] / "experiments" / "results"
K = TypeVar("K", bound=Hashable)


@dataclass(kw_only=True)
class Options:
    """Run what is missing of a study, then write its JSON, its page and its figure."""

    robot: str = "g1"
    """Robot under robots/."""
    base: Path | None = None
    """Checkpoint that every trial starts from; the shipped data/ROBOT/base by default."""
    targets: str | None = None
    """Clips to forget, comma-separated; the library's default targets (g1: punch,kick) by default."""
    budget: Literal["cpu", "paper"] = "cpu"
    """cpu finishes on a laptop; paper takes the paper's settings and iterations, for a GPU."""
    iterations: int | None = None
    """PPO iterations of each trial; the budget's by default."""
    control_iterations: int | None = None
    """Iterations of the retrained control; as many steps as the base was trained for by default."""
    seeds: int = 3
    """Runs of each kind, with the seeds 0, 1, ...: what intervals are over."""
    episodes: int = 20
    """Evaluation episodes a clip."""
    jobs: int = 2
    """Trials at a time; each of them uses all cores of a CPU (docs/findings.md)."""
    trials: Path = Path("runs/trials")
    """Folder of the trials, in which every study finds the finished ones again."""
    physics: Literal["auto", "native", "mjx", "mjx-warp"] | None = None
    """Physics engine; auto is native on a CPU and mjx on a GPU or TPU."""
    library: Path | None = None
    """Folder of clips; the base's by default."""
    output: Path | None = None
    """Folder for NAME.json, NAME.md, NAME.png and NAME.svg; experiments/results/ROBOT by default."""
    draw: bool = False
    """Only write page and figure again, from the JSON."""
    set: Settings = field(default_factory=list)
    """Any other settings of every trial, such as ppo.learning_rate=1e-4."""


@dataclass(frozen=True)
class Study:
    """What makes a study.

    Args:
        name: of its files.
        title: what is asked, in a few words.
        measure: runs the trials; the JSON's `results`.
        tell: (document) → the page's body in Markdown: tables, and what has to be said of them.
        draw: (document) → its figure.
        iterations: of each trial, by budget.
        asks: what beside the options the answer depends on, such as the values of a sweep.
        retrains: whether a retrained control is among its trials.
        watches: whether it tells of evaluations on the way, on `watched_episodes`.
    """

    name: str
    title: str
    measure: Callable[[Lab], dict[str, Any]]
    tell: Callable[[Mapping[str, Any]], str]
    draw: Callable[[Mapping[str, Any]], Figure]
    iterations: Mapping[str, int] = field(default_factory=lambda: ITERATIONS)
    asks: Sequence[str] = ()
    retrains: bool = False
    watches: bool = False


class Lab:
    """Where a study's trials are run: the options, resolved."""

    def __init__(self, options: Options, iterations: int, known: Mapping[str, Any] | None = None):
        """Check the options.

        Args:
            options: of the study.
            iterations: of each trial.
            known: what is known already of trials, by their name (`known_trials`).
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
        robot = self.info.robot
        if robot != options.robot:
            raise InputError(f"{self.base}: robot: the checkpoint's is '{robot}', asked for '{options.robot}'")
        self.config: Config = replace_given(self.info.config, library=options.library)
        self.targets = default_targets(self.config) if options.targets is None else comma_separated(options.targets)
        if not self.targets:
            raise InputError("--targets: no clip named; name at least one to forget, such as --targets punch,kick")
        check_targets(self.targets, self.info.clips)
        self.seeds = tuple(range(options.seeds))
        self.failed: dict[str, str] = {}
        self.stopped: Interrupted | None = None
        self.known = known or {}

    @property
    def control_iterations(self) -> int:
        """Of a policy that is trained from scratch: as many environment steps as the base's unless told otherwise."""
        config = preset("paper") if self.options.budget == "paper" else self.config
        ppo = override(config, itertools.chain(*self.options.set)).ppo
        steps = ppo.num_envs * ppo.num_steps
        return self.options.control_iterations or max(1, round(self.info.environment_steps / steps))

    @property
    def control_seeds(self) -> tuple[int, ...]:
        """Of a policy that is trained from scratch, which a laptop can afford once."""
        return self.seeds[:1] if self.options.budget == "cpu" else self.seeds

    def asked(self) -> dict[str, Any]:
        """What a result is the answer to."""
        from forgetmimic_jax.training.checkpoint import fingerprint

        return {
            "robot": self.options.robot,
            "base": fingerprint(self.base)[:16],
            "base_environment_steps": self.info.environment_steps,
            "library": self.info.library_hash,
            "targets": list(self.targets),
            "budget": self.options.budget,
            "iterations": self.iterations,
            "seeds": len(self.seeds),
            "episodes": self.options.episodes,
            "set": list(itertools.chain(*self.options.set)),
            **({"physics": self.options.physics} if self.options.physics else {}),
        }

    def trial(self, variant: Mapping[str, Any]) -> Trial:
        """What differs from the default unlearning run as told by options of `forgetmimic_jax.unlearn`; `set` adds."""
        from forgetmimic_jax.studies.trials import make_trial

        options = self.options
        asked: dict[str, Any] = {"robot": options.robot, "base": self.base, "targets": ",".join(self.targets)}
        asked |= {"iterations": self.iterations, "episodes": options.episodes, "physics": options.physics}
        asked |= {"library": options.library, "preset": "paper" if options.budget == "paper" else None}
        together = [*itertools.chain(*options.set), *variant.get("set", [])]
        return make_trial(options.trials, asked | dict(variant) | ({"set": together} if together else {}))

    def run(self, variants: Mapping[K, Mapping[str, Any]], what: str, *, others: bool = False) -> dict[K, Path]:
        """Train and evaluate what differs from the default unlearning run as told; the folders of those that finished.

        Args:
            variants: by any key; see `trial`.
            what: is being done, for the progress line.
            others: trials beside these are finished already.

        Raises:
            InputError: every trial failed, and there are no others.
        """
        from forgetmimic_jax.studies.trials import run_trials

        trials = {key: self.trial(variant) for key, variant in variants.items()}
        failed = run_trials(list(trials.values()), jobs=self.options.jobs, description=what)
        self.failed |= {trial.folder.name: reason for trial, reason in failed.items()}
        finished = {key: trial.folder for key, trial in trials.items() if trial not in failed}
        if not finished and not others:
            raise InputError(f"{what}: every trial failed; the first: {next(iter(failed.values()))}")
        return finished

    def over_seeds(
        self, variants: Mapping[str, Mapping[str, Any]], what: str, *, seeds: Mapping[str, Sequence[int]] | None = None
    ) -> dict[str, Any]:
        """Every variant with every seed, and what they have in common over the seeds; runs only what is not known.

        Ctrl-C leaves the trials that are finished by then, and `stopped` says so.

        Args:
            variants: by label, options of `forgetmimic_jax.unlearn`.
            what: is being done.
            seeds: by label, other seeds than the study's.
        """
        every = {label: (seeds or {}).get(label, self.seeds) for label in variants}
        asked = sorted(((label, seed) for label in variants for seed in every[label]), key=lambda key: key[1])
        options = {(label, seed): {**variants[label], "seed": seed} for label, seed in asked}
        names = {key: self.trial(variant).folder.name for key, variant in options.items()}
        missing = {key: variant for key, variant in options.items() if names[key] not in self.known}
        folders: dict[tuple[str, int], Path] = {}
        try:
            folders = self.run(missing, what, others=len(missing) < len(options)) if missing else {}
        except Interrupted as stop:
            trials = {key: self.trial(variant) for key, variant in missing.items()}
            folders = {key: trial.folder for key, trial in trials.items() if trial.evaluation.is_file()}
            if not folders and len(missing) == len(options):
                raise
            self.stopped = stop
            self.failed |= {trial.folder.name: "stopped" for key, trial in trials.items() if key not in folders}
        found = {key: self.known[name] for key, name in names.items() if name in self.known}
        found |= {key: summary(folder) for key, folder in folders.items()}
        result = {}
        for label, variant in variants.items():
            runs = {seed: found[label, seed] for seed in every[label] if (label, seed) in found}
            if runs:
                result[label] = {
                    "options": {name: str(value) for name, value in variant.items()},
                    "trials": {str(seed): names[label, seed] for seed in runs},
                    "seeds": {str(seed): run for seed, run in runs.items()},
                    "over_seeds": over_seeds(list(runs.values())),
                }
        return {"variants": result}

    def watched(self, times: int) -> list[str]:
        """Settings of a trial that is evaluated so often on its way, on half of the study's episodes."""
        episodes = watched_episodes(self.options.episodes)
        return [f"evaluate_every={max(1, self.iterations // times)}", f"evaluate_episodes={episodes}"]

    def as_watched(self, policies: Mapping[K, Path], seed: int) -> dict[K, dict[str, dict[str, float]]]:
        """Policies, clip by clip, on the episodes on which a watched trial of this seed is evaluated."""
        from forgetmimic_jax.training.watch import clip_means

        rolled, names = self.rollouts(policies, episodes=watched_episodes(self.options.episodes), seed=seed)
        return {key: clip_means(rollout, names) for key, rollout in rolled.items()}

    def rollouts(
        self,
        policies: Mapping[K, Path | None],
        clips: Sequence[Clip] | None = None,
        *,
        episodes: int | None = None,
        seed: int = 0,
    ) -> tuple[dict[K, Rollout], tuple[str, ...]]:
        """Every policy on the same episodes, and the clips' names.

        Args:
            policies: checkpoints by any key; None is the zero action.
            clips: other clips than the library's.
            episodes: a clip; the study's by default.
            seed: of the episodes.
        """
        from forgetmimic_jax.evaluation.rollout import Evaluator
        from forgetmimic_jax.motion.library import build_library
        from forgetmimic_jax.settings.options import on_engine
        from forgetmimic_jax.tracking.setup import make_setup
        from forgetmimic_jax.training import checkpoint

        setup = make_setup(on_engine(self.config, self.options.physics))
        library = setup.library if clips is None else build_library(setup.robot, clips)
        evaluator = Evaluator(
            dataclasses.replace(setup, library=library), episodes=episodes or self.options.episodes, seed=seed
        )
        rolled = {}
        with progress("roll out", len(policies)) as report:
            for done, (key, path) in enumerate(policies.items(), start=1):
                policy = None if path is None else checkpoint.load_policy(checkpoint.read_info(path), setup.robot)
                rolled[key] = evaluator.rollout(policy)
                report(done, 0, {})
        return rolled, library.names


def watched_episodes(episodes: int) -> int:
    """A clip, in an evaluation on the way: half of the study's."""
    return max(1, episodes // 2)


def newest_policy(folder: Path) -> Path:
    """The checkpoint that a finished trial ended with."""
    from forgetmimic_jax.training.checkpoint import newest_checkpoint

    newest = newest_checkpoint(folder)
    assert newest is not None
    return newest


def known_trials(folder: Path) -> dict[str, Any]:
    """What the studies in a folder say of the trials of their variants, by the trial's name."""
    documents = [_read(path) for path in sorted(folder.glob("*.json"))]
    studies = [document for document in documents if isinstance(document, dict) and "study" in document]
    variants = [of for study in studies for of in study["results"].get("variants", {}).values()]
    return {name: of["seeds"][seed] for of in variants for seed, name in of.get("trials", {}).items()}


def conduct(study: Study, options: Options, next_command: str) -> None:
    """Measure what the JSON does not hold already, and tell it; exit code 1 where a trial failed.

    Raises:
        Interrupted: stopped; what was finished is told if the study can tell a part of it.
    """

    folder = options.output or RESULTS / options.robot
    from forgetmimic_jax.training.folder import check_writable

    check_writable(folder)
    path = folder / f"{study.name}.json"
    document, stopped = _read(path), None
    if options.draw:
        if document is None:
            raise InputError(f"{path}: not measured yet; leave --draw out")
    else:
        iterations = study.iterations[options.budget] if options.iterations is None else options.iterations
        lab = Lab(options, iterations, known_trials(folder))
        asked = lab.asked() | {"asks": list(study.asks)}
        if study.retrains:
            asked["control_iterations"] = lab.control_iterations
        if document is None or document["asked"] != asked or document["failed"]:
            results, stopped = study.measure(lab), lab.stopped
            document = {"schema": 1, "study": study.name, "asked": asked, "failed": lab.failed, "results": results}
            folder.mkdir(parents=True, exist_ok=True)
            write_atomically(path, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())
    files = {"numbers": path, "page": path.with_suffix(".md")}
    write_atomically(files["page"], page(study, document).encode())
    files |= {f"figure ({kind})": path.with_suffix(f".{kind}") for kind in ("png", "svg")}
    for kind in ("png", "svg"):
        save(study.draw(document), path.with_suffix(f".{kind}"))
    console = Console()
    console.print(Markdown(study.tell(document)))
    closing(files, next_command, console=console)
    if stopped:
        raise stopped
    if document["failed"]:
        print(f"{len(document['failed'])} trials failed; the same command tries them again", file=sys.stderr)
        sys.exit(1)


def _read(path: Path) -> dict[str, Any] | None:
    try:
        return json.loads(path.read_text()) if path.is_file() else None
    except ValueError as error:
        raise InputError(f"{path}: damaged: {error}; remove it to measure again") from None


def page(study: Study, document: Mapping[str, Any]) -> str:
    """The whole page in Markdown."""
    asked = document["asked"]
    variants = document["results"].get("variants", {}).values()
    own_targets = any("targets" in variant["options"] for variant in variants)
    targets = "" if own_targets else f"; targets {', '.join(asked['targets'])}"
    episodes = watched_episodes(asked["episodes"]) if study.watches else asked["episodes"]
    on_laptop = (
        "- Unlearning with the cpu budget holds the kept clips to the base (an anchor), weighs all clips the same and "
        "gives the targets half of the starts (`docs/findings.md`); the paper's has none of it, nor do rows called "
        "plain PPO."
    )
    lines = [
        f"# {study.title}",
        "",
        f"- Robot {asked['robot']}; base trained for {asked['base_environment_steps']:,} environment steps{targets}.",
        f"- {asked['iterations']:,} iterations a trial with the {asked['budget']} budget, {asked['seeds']} seed(s), "
        f"{episodes} episodes a clip.",
        *([on_laptop] if asked["budget"] == "cpu" else []),
        "- In square brackets: the 95 % interval over seeds (Student's t); the seed is the unit. One seed has none.",
        *(f"- Failed: `{name}`: {reason}" for name, reason in document["failed"].items()),
        "",
        study.tell(document),
        f"![{study.title}]({study.name}.png)",
        "",
    ]
    return "\n".join(lines)


def variants_study(
    name: str,
    title: str,
    variants: Callable[[Lab], Mapping[str, Mapping[str, Any]]],
    theirs: Mapping[str, Any],
    *,
    iterations: Mapping[str, int] = ITERATIONS,
    asks: Sequence[str] = (),
    tell: Callable[[Mapping[str, Any]], str] | None = None,
    draw: Callable[[Mapping[str, Any]], Figure] | None = None,
) -> Study:
    """A study of the usual kind: variants over seeds, a row of the table and a pair of bars each.

    Args:
        name: of its files.
        title: what is asked.
        variants: by label, the options of `forgetmimic_jax.unlearn` that a lab is to try.
        theirs: the paper's numbers.
        iterations: see `Study`.
        asks: see `Study`.
        tell: another page than the table, from the document.
        draw: another figure than the bars.
    """
    return Study(
        name=name,
        title=title,
        iterations=iterations,
        asks=asks,
        measure=lambda lab: lab.over_seeds(variants(lab), name),
        tell=tell or (lambda document: variant_table(document["results"]["variants"], theirs)),
        draw=draw or (lambda document: variant_bars(document["results"]["variants"])),
    )


def main(study: Study, options: type[Options] = Options, arguments: Iterable[str] | None = None) -> None:
    """The command of a study's file."""
    program = f"python -m experiments.{study.name}"
    given = tyro.cli(
        options,
        prog=program,
        description=f"{study.title}{'' if study.title.endswith('?') else '.'} {Options.__doc__}",
        args=None if arguments is None else list(arguments),
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    run_command(lambda: conduct(study, given, "make experiments"))
