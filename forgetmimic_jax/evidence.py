"""Attack an unlearned policy and say what survived: `forgetmimic evidence --run runs/unlearn-g1-001`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from forgetmimic_jax.basics.errors import InputError, Interrupted, run_command
from forgetmimic_jax.settings.options import at_least, comma_separated, flags_of, parse

if TYPE_CHECKING:
    from forgetmimic_jax.attacks.case import Case, Scale
    from forgetmimic_jax.attacks.document import EvidenceDocument
    from forgetmimic_jax.attacks.parts import Parts
    from forgetmimic_jax.training.checkpoint import CheckpointInfo


AGAIN = "distilled again"  # what is judged beside the fakes, and is none


@dataclass
class Options:
    """Try to bring back what a run forgot, beside its base and a control that never rolled out a target.

    Near-duplicates, splices and look-alikes of the targets, fine-tuning on the kept clips alone, relearning, half a
    target, other numerics, membership inference and episodes without terminations. Every finished attack stays in the
    run's folder evidence/; the same command continues. The report takes its verdict from evidence.json.
    """

    run: str
    """Folder of the run. Several, comma-separated, are attacked side by side; those that have an evidence.json already
    are left as they are."""
    control: Path | None = None
    """Run of METHOD=distill or retrain with the same base and targets, or of `make pretrain WITHOUT=TARGETS`;
    RUN-control by default, which is distilled if it is missing."""
    base: Path | None = None
    """Checkpoint that the run started from; the one its settings name by default."""
    full: bool = False
    """Three trainings of each kind, whose intervals are then over trainings, and twice the episodes (hours)."""
    episodes: int | None = None
    """Episodes a clip; 20 by default, with --full 40."""
    recovery_iterations: int | None = None
    """Iterations of the fine-tuning on the kept clips alone; 100 by default."""
    relearning_iterations: int | None = None
    """Iterations of relearning at most; 200 by default, with --full 300."""
    control_iterations: int | None = None
    """Iterations of a control that is made; the method's by default."""
    fakes: bool = False
    """Judge the judge too: six fakes, which must fail, and another distilled policy, which must not (an hour)."""
    jobs: int | None = None
    """With several runs, so many at a time on this machine, which share its cores evenly; by default one on each GPU,
    or 1 without a GPU."""
    cluster: str | None = None
    """Address of a dask scheduler, such as tcp://host:8786, whose workers attack the runs (docs/cluster.md)."""


def main(options: Options) -> None:
    """Find or make the control, attack, judge and write."""
    from forgetmimic_jax.attacks import control, gather
    from forgetmimic_jax.attacks.case import Case
    from forgetmimic_jax.attacks.document import CONTROL, FILE, write_document
    from forgetmimic_jax.attacks.figure import draw
    from forgetmimic_jax.attacks.judged import FILE as JUDGED
    from forgetmimic_jax.attacks.judged import read_judged
    from forgetmimic_jax.attacks.page import page
    from forgetmimic_jax.attacks.parts import Parts
    from forgetmimic_jax.attacks.verdict import judge
    from forgetmimic_jax.basics.console import closing, command_line, say
    from forgetmimic_jax.basics.files import write_atomically
    from forgetmimic_jax.basics.provenance import provenance
    from forgetmimic_jax.evaluation.metrics import BASE, UNLEARNED
    from forgetmimic_jax.evaluation.plots import save
    from forgetmimic_jax.motion.kinematics import resample
    from forgetmimic_jax.motion.library import read_library
    from forgetmimic_jax.tracking.setup import library_folder
    from forgetmimic_jax.training import checkpoint
    from forgetmimic_jax.training.comparison import load_comparison

    provenance()  # of the code that is loaded now; a checkout may change while attacks train
    scale, runs = _scale(options), [Path(name) for name in comma_separated(options.run)]
    if len(runs) > 1 or options.cluster:
        return _several(options, runs)
    run = runs[0]
    newest, info = _unlearned(run)
    compared = load_comparison(newest, robot=info.robot, base=options.base)
    setup, base = compared.setup, compared.info["base"]
    beside = options.control or control.beside(run)
    if options.control is None:
        _make_control(options, info, base.path, beside)
    other = control.read_control(beside, info, setup)
    own = next(name for name in compared.policies if name != "base")
    policies = {
        BASE: compared.policies["base"],
        UNLEARNED: compared.policies[own],
        CONTROL: checkpoint.load_policy(other, setup.robot),
    }
    hashes = {BASE: base, UNLEARNED: info, CONTROL: other}
    clips = {
        clip.name: resample(clip, 1.0 / setup.config.physics.control_step)
        for clip in read_library(setup.robot, library_folder(setup.config), setup.library.names)
    }
    case = Case(setup, clips, compared.targets, policies, scale, seed=0)
    policy_hashes = {name: checkpoint.policy_hash(of) for name, of in hashes.items()}
    parts = Parts(run / "evidence", setup, gather.conditions(case, policy_hashes))
    try:
        document = gather.gather(
            case,
            parts,
            method=info.config.unlearn.method,
            control_method=other.config.unlearn.method,
            policy_hashes=policy_hashes,
        )
    except KeyboardInterrupt:
        raise Interrupted("stopped; finished attacks are kept; the same command continues") from None
    files = {"evidence": run / FILE, "page": run / "evidence.md", "figure": run / "evidence.png"}
    write_document(files["evidence"], document)
    save(draw(document), files["figure"])
    if options.fakes:
        _judge_fakes(options, case, parts, document, info, base.path)
    names = [field.name for field in dataclasses.fields(options) if field.name not in ("jobs", "cluster")]
    given = {name: getattr(options, name) or None for name in names} | {"run": run}
    command = command_line("evidence", **given)
    text = page(document, files["figure"].name, command, read_judged(run / JUDGED))
    write_atomically(files["page"], text.encode())
    verdict = judge(document)
    say(f"{verdict.phrase}: {' '.join(verdict.reasons)}")
    closing(files, command_line("report", run=run))


def _unlearned(run: Path) -> tuple[Path, CheckpointInfo]:
    """The newest checkpoint of an unlearning run, and what it says of itself."""
    from forgetmimic_jax.training import checkpoint
    from forgetmimic_jax.training.folder import check_writable

    newest = checkpoint.newest_checkpoint(run)
    if newest is None:
        raise InputError(f"{run}: no run with a checkpoint")
    info = checkpoint.read_info(newest)
    if not info.config.unlearn.targets:
        raise InputError(f"{newest}: no clip was to be forgotten; accepted: a run of `make unlearn`")
    check_writable(run)
    return newest, info


def _several(options: Options, runs: Sequence[Path]) -> None:
    """The evidence on each run, in a process of its own."""
    from forgetmimic_jax.attacks.document import FILE, read_evidence
    from forgetmimic_jax.attacks.judged import FILE as JUDGED
    from forgetmimic_jax.basics.console import command_line
    from forgetmimic_jax.studies.executor import at_a_time, run_together
    from forgetmimic_jax.studies.task import Task

    jobs, scale = at_a_time(options.jobs, options.cluster), _scale(options)
    tasks, last = [], JUDGED if options.fakes else FILE
    for run in runs:
        _unlearned(run)
        if (run / FILE).is_file():
            found = read_evidence(run / FILE)
            if (found.episodes, found.seeds) != (scale.episodes, scale.seeds):
                raise InputError(
                    f"{run / FILE}: of {found.episodes} episodes a clip and {found.seeds} training(s) of each kind; "
                    f"accepted: {scale.episodes} and {scale.seeds}; attack this run alone, or remove the file"
                )
        flags = flags_of(dataclasses.replace(options, run=str(run), jobs=None, cluster=None))
        tasks.append(Task(run, "evidence", flags, iterations=0, last=last, adds=True))
    following = command_line("report", run=runs[0])
    run_together(tasks, following, description="evidence", jobs=jobs, cluster=options.cluster)


def _scale(options: Options) -> Scale:
    """How much is simulated and trained."""
    from forgetmimic_jax.attacks.case import Scale
    from forgetmimic_jax.attacks.gather import FULL

    scale = FULL if options.full else Scale()
    for flag in ("episodes", "recovery_iterations", "relearning_iterations", "control_iterations"):
        if (value := getattr(options, flag)) is not None:
            at_least(2 if flag == "episodes" else 1, f"--{flag.replace('_', '-')}", value)
    if options.episodes is not None:
        share = options.episodes / scale.episodes
        every = ("target_episodes", "variant_episodes", "kept_variant_episodes")
        fewer = {name: max(2, round(share * getattr(scale, name))) for name in every}
        scale = dataclasses.replace(scale, episodes=options.episodes, **fewer)
    recovery = options.recovery_iterations or scale.recovery_iterations
    return dataclasses.replace(
        scale,
        recovery_iterations=recovery,
        held_out_iterations=min(scale.held_out_iterations, recovery),
        relearning_iterations=options.relearning_iterations or scale.relearning_iterations,
    )


def _make_control(options: Options, info: CheckpointInfo, base: Path, folder: Path) -> None:
    """Make a control by the method distill: with another seed than the run's, which may be distilled itself."""
    from forgetmimic_jax.attacks import control

    given = {"method": control.METHOD, "iterations": options.control_iterations, "seed": info.config.seed + 1}
    _unlearn(info, base, folder, **given)


def _unlearn(info: CheckpointInfo, base: Path, folder: Path, **given: Any) -> None:
    """A run on the robot, base, clips and targets of another, unless it is finished; one that stopped continues.

    Raises:
        InputError: the folder has a run of another base or of other targets.
    """
    from forgetmimic_jax import unlearn
    from forgetmimic_jax.attacks import control
    from forgetmimic_jax.training.checkpoint import newest_checkpoint, policy_hash, read_info

    config = info.config
    if newest_checkpoint(folder):
        found, wanted = read_info(folder), policy_hash(read_info(base))
        for name, theirs, ours in (
            ("base", found.base, wanted),
            ("unlearn.targets", sorted(found.config.unlearn.targets), sorted(config.unlearn.targets)),
        ):
            if theirs != ours:
                raise InputError(
                    f"{folder}: {name}: found {theirs}; accepted: {ours}; remove the folder to make it again"
                )
    if control.is_finished(folder):
        return
    unlearn.main(
        unlearn.Options(
            robot=config.robot,
            targets=",".join(config.unlearn.targets),
            preset=config.preset if config.preset != read_info(base).config.preset else None,  # type: ignore[arg-type]
            base=base,
            physics=config.physics.engine,
            library=None if config.library is None else Path(config.library),
            output=folder,
            resume=newest_checkpoint(folder) is not None,
            **given,
        )
    )


def _judge_fakes(
    options: Options, case: Case, parts: Parts, evidence: EvidenceDocument, info: CheckpointInfo, base: Path
) -> None:
    """Judge every fake and another distilled policy, and write the verdicts."""
    from forgetmimic_jax.attacks import control
    from forgetmimic_jax.attacks.document import write_document
    from forgetmimic_jax.attacks.fakes import fakes
    from forgetmimic_jax.attacks.judged import FILE, Judged, judged
    from forgetmimic_jax.attacks.verdict import CONSISTENT, FAILED
    from forgetmimic_jax.basics.console import say, warn
    from forgetmimic_jax.evaluation.metrics import BASE
    from forgetmimic_jax.policy.policy import Policy
    from forgetmimic_jax.training import checkpoint

    run = parts.folder.parent

    def trained(name: str, **given: Any) -> Policy:
        folder = run.with_name(f"{run.name}-{name}")
        _unlearn(info, base, folder, **given)
        newest = checkpoint.newest_checkpoint(folder)
        assert newest is not None
        return checkpoint.load_policy(checkpoint.read_info(newest), case.setup.robot)

    own = case.policies[BASE]
    assert isinstance(own, Policy)
    seed, iterations = info.config.seed, options.control_iterations
    policies = {
        **fakes(case.setup, own, case.chosen(case.targets), case.chosen(case.kept)),
        "λ = 8": lambda: trained("lambda-8", penalty=8.0, iterations=iterations, seed=seed),
        AGAIN: lambda: trained("distilled", method=control.METHOD, iterations=iterations, seed=seed + 2),
    }
    found: dict[str, Judged] = {}
    for name, make in policies.items():
        found[name] = judged(case, parts, name, make(), evidence)
        say(f"{name}: {found[name].phrase}")
        if name == AGAIN and found[name].phrase != CONSISTENT:
            warn(f"{name}: the verdict should be {CONSISTENT}, since this policy never saw a target")
        if name != AGAIN and found[name].phrase != FAILED:
            warn(f"{name}: the verdict should be {FAILED}, since nothing was forgotten; more episodes may decide it")
    write_document(run / FILE, found)


if __name__ == "__main__":
    run_command(lambda: main(parse(Options, "evidence")))
