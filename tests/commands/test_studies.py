"""Sweeps and studies in miniature. Trials run in this process, where the miniature's iteration is compiled already."""

import contextlib
import dataclasses
import importlib
import json
import shutil
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from pathlib import Path

import numpy as np
import pytest
from miniature import Run, finished
from safetensors.numpy import load_file
from scipy import stats

from forgetmimic_jax import evaluate, sweep, unlearn
from forgetmimic_jax.basics.errors import InputError, Interrupted
from forgetmimic_jax.basics.provenance import provenance
from forgetmimic_jax.evaluation.repeats import Repeat
from forgetmimic_jax.motion.library import library_hash
from forgetmimic_jax.settings.config import UnlearnConfig, load_config, save_config
from forgetmimic_jax.settings.options import parse
from forgetmimic_jax.studies import conduct, executor, trials
from forgetmimic_jax.studies.executor import Place
from forgetmimic_jax.studies.lab import Lab, newest_policy
from forgetmimic_jax.studies.options import Options as StudyOptions
from forgetmimic_jax.studies.targets import targets_study
from forgetmimic_jax.studies.task import run_task
from forgetmimic_jax.studies.variants import estimates, summary
from forgetmimic_jax.tracking.setup import make_setup
from forgetmimic_jax.training import start
from forgetmimic_jax.training.checkpoint import load_policy, policy_hash, read_info
from forgetmimic_jax.training.watch import Watch, clip_means
from forgetmimic_jax.unlearning.registry import unlearning_config

STUDIES = (
    *("validity", "comparison", "penalty", "heat_map", "motion_types", "physical_behaviour", "training_dynamics"),
    *("relearning", "membership", "number_of_targets", "stand", "from_scratch"),
)

FIRST, SECOND = "base 0, seed 0", "base 0, seed 1"


class InProcess(Executor):
    """Runs a trial as soon as it is submitted, in this process."""

    def submit(self, run, task, *_, **__) -> Future:
        result: Future = Future()
        try:
            unlearn.main(parse(unlearn.Options, "unlearn", [*task.flags, "--output", str(task.folder)]))
            result.set_result(None)
        except InputError as error:
            result.set_result(str(error))
        return result


@contextlib.contextmanager
def in_process(jobs: int) -> Iterator[Place]:
    yield Place(InProcess(), run_task, lambda folders: None)


def options(of: type, base_run: Run, folder: Path, **given):
    return of(**{
        **{"bases": str(base_run.checkpoint(4)), "targets": "turn", "iterations": 2, "episodes": 2, "seeds": 2},
        **{"trials": folder / "trials", "output": folder / "out", **given},
    })  # fmt: skip


@pytest.fixture(scope="module")
def swept(base_run, tmp_path_factory) -> tuple[Path, str]:
    """A sweep over two seeds, from its trials to its files; its folder, and what it printed."""
    folder = tmp_path_factory.mktemp("sweep")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(executor, "on_this_machine", in_process)
        wanted = options(sweep.Options, base_run, folder, kind="seeds")
        run = finished(sweep.main, wanted)
    return folder, run.printed


def test_a_sweep_writes_numbers_page_and_figure(swept):
    folder, printed = swept
    assert sorted(path.name for path in (folder / "out").iterdir()) == ["seeds.json", "seeds.md", "seeds.png"]
    assert (folder / "out" / "seeds.png").read_bytes().startswith(b"\x89PNG")
    page = (folder / "out" / "seeds.md").read_text()
    assert page.startswith("# The default run (1 base × 2 seeds)\n")
    assert "- Robot g1; 1 base × 2 seeds; bases trained for 128 environment steps; targets: turn." in page
    assert "2 iterations a run with the cpu preset, 2 episodes a clip." in page
    here = provenance()
    assert f"- Made by code {here.code} (commit {here.commit[:7]}), Python {here.python}, JAX {here.jax}, " in page
    cores = "1 core" if here.cores == 1 else f"{here.cores} cores"
    assert f", {cores} of {here.processor}.\n" in page
    assert "## What it says of the claim" in page
    assert "*paper: λ = 16*" in page
    assert "Next: make experiments" in printed


def test_its_numbers_are_those_of_the_trials_over_the_seeds(swept):
    folder, _ = swept
    document = json.loads((folder / "out" / "seeds.json").read_text())
    variant = document["results"]["variants"]["λ = 16"]
    runs = sorted((folder / "trials").glob("*/evaluation.json"))
    assert len(runs) == 2
    for group in ("target", "kept"):
        for metric in ("survival_weighted_tracking", "episode_length"):
            values = [json.loads(run.read_text())["policies"]["unlearned"][group][metric]["mean"] for run in runs]
            found = estimates(variant)["policy"][group][metric]
            low, high = stats.t.interval(0.95, 1, loc=np.mean(values), scale=stats.sem(values))
            assert (found["mean"], found["low"], found["high"]) == pytest.approx((np.mean(values), low, high), rel=1e-4)
    first = [json.loads(log.read_text().splitlines()[0]) for log in (folder / "trials").glob("*/metrics.jsonl")]
    measured = [row["target/lambda_crit"] for row in first if row["target/step_share"] > 0.0]
    assert 1 <= len(measured) <= 2
    crit = estimates(variant)["lambda_crit"]
    assert (crit["mean"], crit["n"]) == (pytest.approx(np.mean(measured)), len(measured))
    assert document["failed"] == {}


def test_the_same_command_again_runs_nothing(swept, base_run, monkeypatch):
    folder, _ = swept
    monkeypatch.setattr(trials, "run_trials", None)
    before = {path: path.read_bytes() for path in (folder / "out").iterdir()}
    run = finished(sweep.main, options(sweep.Options, base_run, folder, kind="seeds"))
    assert {path: path.read_bytes() for path in (folder / "out").iterdir()} == before
    assert "λ = 16" in run.printed


def test_other_seeds_find_the_finished_trials(swept, base_run, monkeypatch, tmp_path):
    folder, _ = swept
    monkeypatch.setattr(executor, "on_this_machine", None)
    wanted = options(sweep.Options, base_run, folder, kind="seeds", seeds=1, output=tmp_path)
    finished(sweep.main, wanted)
    document = json.loads((tmp_path / "seeds.json").read_text())
    assert document["results"]["variants"]["λ = 16"]["runs"].keys() == {FIRST}


def test_a_further_seed_runs_alone_where_the_numbers_of_the_others_are_stored(swept, base_run, monkeypatch, tmp_path):
    folder, _ = swept
    (stored,) = json.loads((folder / "out" / "seeds.json").read_text())["results"]["variants"].values()
    shutil.copy(folder / "out" / "seeds.json", tmp_path / "another_study.json")
    ordered = []

    def stand_in(wanted, **_):
        ordered.extend(wanted)
        for trial in wanted:
            shutil.copytree(folder / "trials" / stored["trials"][FIRST], trial.folder)
        return {}

    monkeypatch.setattr(trials, "run_trials", stand_in)
    given = {"seeds": 3, "trials": tmp_path / "trials", "output": tmp_path}
    finished(sweep.main, options(sweep.Options, base_run, tmp_path, kind="seeds", **given))
    assert [trial.flags[trial.flags.index("--seed") + 1] for trial in ordered] == ["2"]
    (extended,) = json.loads((tmp_path / "seeds.json").read_text())["results"]["variants"].values()
    assert list(extended["runs"].items())[:2] == list(stored["runs"].items())
    assert estimates(extended)["policy"]["kept"]["episode_length"]["n"] == 3


def test_a_further_seed_that_fails_leaves_the_others_and_is_named(swept, base_run, monkeypatch, tmp_path):
    shutil.copy(swept[0] / "out" / "seeds.json", tmp_path)
    monkeypatch.setattr(trials, "run_trials", lambda wanted, **_: dict.fromkeys(wanted, "no luck"))
    given = {"seeds": 3, "trials": tmp_path / "trials", "output": tmp_path}
    with pytest.raises(SystemExit) as exit_:
        sweep.main(options(sweep.Options, base_run, tmp_path, kind="seeds", **given))
    assert exit_.value.code == 1
    document = json.loads((tmp_path / "seeds.json").read_text())
    assert list(document["results"]["variants"]["λ = 16"]["runs"]) == [FIRST, SECOND]
    assert list(document["failed"].values()) == ["no luck"]


def test_runs_of_other_bases_are_replaced_after_a_line(swept, base_run, monkeypatch, tmp_path):
    text = (swept[0] / "out" / "seeds.json").read_text().replace(provenance().code, "0123abcd")
    policy = policy_hash(read_info(base_run.checkpoint(4)))
    (tmp_path / "seeds.json").write_text(text.replace(policy, "f" * 16))
    monkeypatch.setattr(executor, "on_this_machine", None)
    wanted = options(sweep.Options, base_run, swept[0], kind="seeds", output=tmp_path)
    run = finished(sweep.main, wanted)
    assert "seeds.json: its runs are of other bases, so the new ones replace them" in run.printed.replace("\n", "")
    document = json.loads((tmp_path / "seeds.json").read_text())
    assert [group["code"] for group in document["made_by"]] == [provenance().code]


def test_policies_of_another_robot_skip_a_study_with_a_line(base_run, capsys):
    study = importlib.import_module("experiments.number_of_targets")
    conduct.main(study.STUDY, study.H2Options, ["--bases", str(base_run.checkpoint(4))])
    expected = "number_of_targets: skipped: it is of the h2, and --bases names policies of the g1\n"
    assert capsys.readouterr().out == expected


OTHER = dataclasses.replace(provenance(), code="0123abcd", commit="f" * 40)


@pytest.fixture
def by_other_code(swept, tmp_path) -> Path:
    """A folder with the swept numbers and trials as if other code had made them."""
    text = (swept[0] / "out" / "seeds.json").read_text()
    for name in ("code", "commit"):
        text = text.replace(getattr(provenance(), name), getattr(OTHER, name))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "seeds.json").write_text(text)
    for trial in (swept[0] / "trials").glob("*-s*/"):
        copy = shutil.copytree(trial, tmp_path / "trials" / trial.name.replace(provenance().code, OTHER.code))
        evaluation = json.loads((trial / "evaluation.json").read_text())
        (copy / "evaluation.json").write_text(json.dumps(evaluation | {"made": dataclasses.asdict(OTHER)}))
    return tmp_path


def test_numbers_of_other_code_that_answer_the_question_stay_and_say_so(by_other_code, base_run, monkeypatch):
    monkeypatch.setattr(trials, "run_trials", None)
    before = (by_other_code / "out" / "seeds.json").read_bytes()
    finished(sweep.main, options(sweep.Options, base_run, by_other_code, kind="seeds"))
    assert (by_other_code / "out" / "seeds.json").read_bytes() == before
    assert "- Made by code 0123abcd (commit fffffff), " in (by_other_code / "out" / "seeds.md").read_text()


def test_rows_of_other_code_are_not_added_to(by_other_code, base_run, refused, monkeypatch):
    monkeypatch.setattr(trials, "run_trials", None)
    message = refused(sweep.main, options(sweep.Options, base_run, by_other_code, kind="seeds", seeds=3))
    assert "seeds.json: made by code 0123abcd (commit fffffff) with JAX " in message
    assert message.endswith("--mix-commits puts their runs into one table, another --output keeps them apart")


def mixed(by_other_code: Path, base_run: Run, swept: Path, monkeypatch, **given) -> tuple[list[str], Path]:
    """The seeds that a sweep over three of them runs with --mix-commits, and where it wrote."""
    ran = []

    def stand_in(wanted, **_):
        ran.extend(trial.flags[trial.flags.index("--seed") + 1] for trial in wanted)
        for trial in wanted:
            shutil.copytree(next((swept / "trials").glob("*-s1-*/")), trial.folder)
        return {}

    monkeypatch.setattr(trials, "run_trials", stand_in)
    wanted = options(sweep.Options, base_run, by_other_code, kind="seeds", seeds=3, mix_commits=True, **given)
    finished(sweep.main, wanted)
    return ran, wanted.output


@pytest.mark.parametrize("known", ["numbers", "folders"])
def test_rows_of_other_code_are_mixed_in_where_the_user_says_so(
    by_other_code, base_run, swept, tmp_path, monkeypatch, known
):
    given = {"trials": tmp_path / "none"} if known == "numbers" else {"output": tmp_path / "new"}
    ran, output = mixed(by_other_code, base_run, swept[0], monkeypatch, **given)
    assert ran == ["2"]
    (variant,) = json.loads((output / "seeds.json").read_text())["results"]["variants"].values()
    codes = {seed: name.rpartition("-")[2] for seed, name in variant["trials"].items()}
    assert codes == {FIRST: "0123abcd", SECOND: "0123abcd", "base 0, seed 2": provenance().code}
    lines = [line for line in (output / "seeds.md").read_text().splitlines() if line.startswith("- Made by")]
    assert len(lines) == 2
    by_code = {code: line for line in lines for code in set(codes.values()) if f"code {code} " in line}
    assert by_code["0123abcd"].endswith(": λ = 16 (base 0, seeds 0, 1).")
    assert by_code[provenance().code].endswith(": λ = 16 (base 0, seed 2).")


def test_trials_of_other_code_are_not_found(by_other_code, base_run, tmp_path, monkeypatch):
    monkeypatch.setattr(trials, "run_trials", lambda wanted, **_: dict.fromkeys(wanted, f"{len(wanted)} wanted for"))
    wanted = options(sweep.Options, base_run, by_other_code, kind="seeds", output=tmp_path / "new")
    with pytest.raises(InputError, match="2 wanted for"):
        sweep.main(wanted)


def test_the_files_can_be_drawn_from_the_numbers_alone(swept, tmp_path):
    folder, _ = swept
    shutil.copy(folder / "out" / "seeds.json", tmp_path)
    finished(sweep.main, sweep.Options(kind="seeds", draw=True, output=tmp_path, bases="gone"))
    for name in ("seeds.md", "seeds.png"):
        assert (tmp_path / name).read_bytes() == (folder / "out" / name).read_bytes()


def test_a_trial_that_fails_is_named_on_the_page_and_in_the_exit_code(swept, base_run, tmp_path, capsys, monkeypatch):
    wanted = options(sweep.Options, base_run, tmp_path, kind="seeds")
    first, second = sorted((swept[0] / "trials").glob("*-s*/"))
    shutil.copytree(first, tmp_path / "trials" / first.name)

    def results() -> tuple[dict, str]:
        document = json.loads((tmp_path / "out" / "seeds.json").read_text())
        return document["failed"], " ".join(repeat[-1] for repeat in document["results"]["variants"]["λ = 16"]["runs"])

    with monkeypatch.context() as patch:
        patch.setattr(trials, "run_trials", lambda wanted, **_: {trial: "no luck" for trial in wanted})
        with pytest.raises(SystemExit) as exit_:
            sweep.main(wanted)
    assert exit_.value.code == 1
    assert "1 trials failed; the same command tries them again" in capsys.readouterr().err
    assert results() == ({second.name: "no luck"}, "0")
    assert f"- Failed: `{second.name}`: no luck" in (tmp_path / "out" / "seeds.md").read_text()
    shutil.copytree(second, tmp_path / "trials" / second.name)
    sweep.main(wanted)  # tries what failed again
    assert results() == ({}, "0 1")


def test_what_is_finished_when_it_is_stopped_is_named(swept, base_run, tmp_path, monkeypatch):
    wanted = options(sweep.Options, base_run, tmp_path, kind="seeds")
    name = next((swept[0] / "trials").glob("*-s0-*/")).name

    def stop(after):
        def stand_in(wanted, **_):
            for trial in wanted[:after]:
                shutil.copytree(swept[0] / "trials" / name, trial.folder)
            raise Interrupted("stopped")

        with monkeypatch.context() as patch:
            patch.setattr(trials, "run_trials", stand_in)
            with pytest.raises(Interrupted):
                sweep.main(wanted)

    stop(after=0)
    assert not (tmp_path / "out").exists()
    stop(after=1)
    document = json.loads((tmp_path / "out" / "seeds.json").read_text())
    assert list(document["results"]["variants"]["λ = 16"]["runs"]) == [FIRST]
    assert list(document["failed"].values()) == ["stopped"]
    assert "`: stopped\n" in (tmp_path / "out" / "seeds.md").read_text()
    stop(after=0)  # and wanted again, it continues with what is missing
    document = json.loads((tmp_path / "out" / "seeds.json").read_text())
    assert list(document["results"]["variants"]["λ = 16"]["runs"]) == [FIRST]


def test_where_every_trial_fails_nothing_is_written(refused, base_run, tmp_path, monkeypatch):
    monkeypatch.setattr(trials, "run_trials", lambda wanted, **_: dict.fromkeys(wanted, "no luck"))
    message = refused(sweep.main, options(sweep.Options, base_run, tmp_path, kind="seeds"))
    assert message == "seeds: every trial failed; the first: no luck"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"kind": "lambda", "values": ["four"]}, "--values: could not convert string to float: 'four'; accepted: "),
        ({"kind": "lambda", "values": ["0"]}, "--values: found 0; accepted: penalties above 0, such as 4 8 16"),
        ({"kind": "sampler", "values": ["uniform"]}, "--values: no sampler 'uniform'; known: uniform_clips, "),
        ({"kind": "targets", "values": ["trun"]}, "targets: no clip 'trun' in the library; did you mean 'turn'?"),
        ({"kind": "seeds", "seeds": 0}, "--seeds: found 0; accepted: 1 or more"),
        ({"kind": "seeds", "jobs": 0}, "--jobs: found 0; accepted: 1 or more"),
        ({"kind": "seeds", "iterations": 0}, "--iterations: found 0; accepted: 1 or more"),
        ({"kind": "seeds", "targets": ","}, "--targets: no clip named; name at least one to forget, such as "),
        ({"kind": "seeds", "targets": "sway,turn,nod"}, "targets: all 3 clips of the library; leave at least one"),
        ({"kind": "seeds", "bases": "nowhere"}, "nowhere: no such checkpoint folder"),
        ({"kind": "seeds", "robot": "h2"}, "robot: found 'g1'; --robot is 'h2'"),
        ({"kind": "seeds", "draw": True}, "seeds.json: not measured yet; leave --draw out"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(refused, base_run, tmp_path, given, message):
    assert message in refused(sweep.main, options(sweep.Options, base_run, tmp_path, **given))


def test_a_damaged_file_of_numbers_is_refused(refused, base_run, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "seeds.json").write_text("{")
    message = refused(sweep.main, options(sweep.Options, base_run, tmp_path, kind="seeds"))
    assert "seeds.json: damaged: " in message
    assert message.endswith("; remove it to measure again")


def test_help_lists_what_a_study_takes(capsys):
    validity = importlib.import_module("experiments.validity").STUDY
    commands = (
        lambda: parse(sweep.Options, "sweep", ["--help"]),
        lambda: conduct.main(validity, arguments=["--help"]),
    )
    for command in commands:
        with pytest.raises(SystemExit) as exit_:
            command()
        assert exit_.value.code == 0
        text = capsys.readouterr().out
        for flag in ("--preset {cpu,paper}", "--mix-commits", "--seeds {None}|INT", "--jobs {None}|INT", "--draw"):
            assert flag in text


@pytest.fixture(scope="module")
def watched_run(base_run, tmp_path_factory) -> Run:
    """An unlearning run that was evaluated on its way, which stands for every trial of a study below."""
    output = tmp_path_factory.mktemp("runs") / "watched"
    wanted = unlearn.Options(
        base=base_run.checkpoint(4), targets="turn", iterations=2, episodes=2, output=output, set=[["evaluate_every=1"]]
    )
    return finished(unlearn.main, wanted)


def test_a_sweep_on_two_bases_has_every_seed_from_each_of_them(swept, base_run, tmp_path, monkeypatch):
    ordered = []

    def stand_in(wanted, **_):
        for trial in wanted:
            given = parse(unlearn.Options, "unlearn", trial.flags)
            ordered.append((given.base, given.seed))
            shutil.copytree(next((swept[0] / "trials").glob("*-s1-*/")), trial.folder)
        return {}

    monkeypatch.setattr(trials, "run_trials", stand_in)
    first, second = base_run.checkpoint(4), base_run.checkpoint(2)
    finished(sweep.main, options(sweep.Options, base_run, tmp_path, kind="seeds", bases=f"{first}, {second}"))
    assert ordered == [(first, 0), (second, 0), (first, 1), (second, 1)]  # every base before a further seed
    document = json.loads((tmp_path / "out" / "seeds.json").read_text())
    assert [base["environment_steps"] for base in document["conditions"]["bases"]] == [128, 64]
    variant = document["results"]["variants"]["λ = 16"]
    assert list(variant["runs"]) == [FIRST, "base 1, seed 0", SECOND, "base 1, seed 1"]
    assert estimates(variant)["policy"]["kept"]["episode_length"]["n"] == 2
    page = (tmp_path / "out" / "seeds.md").read_text()
    assert page.startswith("# The default run (2 bases × 2 seeds)\n")
    assert "bases trained for 128 and 64 environment steps; targets: turn." in page
    assert "interval over the n bases (Student's t)" in page


def test_bases_that_cannot_stand_beside_each_other_are_refused(base_run, tmp_path, refused):
    other = Path(shutil.copytree(base_run.checkpoint(4), tmp_path / "other"))
    config = (other / "config.yaml").read_text()
    (other / "config.yaml").write_text(config.replace("mode: residual", "mode: offset"))
    bases = f"{base_run.checkpoint(4)},{other}"
    message = refused(sweep.main, options(sweep.Options, base_run, tmp_path, kind="seeds", bases=bases))
    assert message == (f"{other}: action.mode: found offset; accepted: residual, as in {base_run.checkpoint(4)}")


@pytest.mark.parametrize("name", STUDIES)
def test_every_study_comes_to_its_page_and_figure(name, base_run, watched_run, tmp_path, monkeypatch):
    ordered = []

    def stand_in(wanted, **_):
        for trial in dict.fromkeys(wanted):
            ordered.append(trial)
            parse(unlearn.Options, "unlearn", trial.flags)  # every flag is one of the command's
            if not trial.folder.exists():
                shutil.copytree(watched_run.folder, trial.folder)
        return {}

    monkeypatch.setattr(trials, "run_trials", stand_in)
    module = importlib.import_module(f"experiments.{name}")
    other_clips = name in ("motion_types", "number_of_targets")
    subject = targets_study(("turn", "nod"), name, module.STUDY.title) if other_clips else module.STUDY
    given = options(StudyOptions, base_run, tmp_path)
    run = finished(lambda given: conduct.conduct(subject, given, "make experiments"), given)
    out = tmp_path / "out"
    assert sorted(path.suffix for path in out.glob(f"{name}.*")) == [".json", ".md", ".png"]
    assert ordered
    page = (out / f"{name}.md").read_text()
    assert page.startswith(f"# {subject.title} ({'2 seeds' if name == 'from_scratch' else '1 base × 2 seeds'})\n")
    assert "nan" not in page
    assert run.printed


def test_overlap_forgets_the_half_of_a_clip_from_a_base_that_knew_the_whole(base_run, tmp_path, monkeypatch):
    monkeypatch.setattr(executor, "on_this_machine", in_process)
    study = importlib.import_module("experiments.overlap").overlap_study(
        {"sway_first_half": "sway_second_half"}, "sway"
    )
    given = options(StudyOptions, base_run, tmp_path, seeds=1, jobs=1)
    finished(lambda given: conduct.conduct(study, given, "make experiments"), given)
    document = json.loads((tmp_path / "out" / "overlap.json").read_text())
    (trial,) = (tmp_path / "trials").glob("arft-sway_first_half-*/")
    assert document["results"]["variants"]["sway_first_half"]["options"] == {"targets": "sway_first_half"}
    assert document["results"]["distances"]["sway_first_half"].keys() == {"sway_second_half", "turn", "nod"}
    (base,) = (tmp_path / "trials").glob("halves-of-sway-*/base-*")
    tensors = [load_file(folder / "policy.safetensors") for folder in (base, base_run.checkpoint(4))]
    assert all(np.array_equal(tensors[0][name], tensors[1][name]) for name in tensors[0] if name != "failure_level")
    assert load_config(trial / "config.yaml").base == str(base)
    page = (tmp_path / "out" / "overlap.md").read_text()
    assert "\nOurs, not in the paper: What lies near a target loses more than what lies far from it.\n" in page
    assert "\n| sway_first_half | **sway_second_half** | 0." in page


def test_generality_rolls_the_bases_out_on_clips_that_they_never_saw(base_run, library_folder, tmp_path):
    module = importlib.import_module("experiments.generality")
    given = options(module.HeldOutOptions, base_run, tmp_path, held_out=str(library_folder))
    finished(lambda given: conduct.conduct(module.STUDY, given, "make experiments"), given)
    document = json.loads((tmp_path / "out" / "generality.json").read_text())
    assert document["conditions"]["held_out"] == {library_folder.name: library_hash(library_folder)}
    kinds = document["results"]["kinds"]
    own, noise, mirrored, slower, faster, other = (of["base"]["base 0, seed 0"] for of in kinds.values())
    assert list(own) == list(noise) == ["sway", "turn", "nod"]
    assert list(mirrored) == ["sway_mirrored", "turn_mirrored", "nod_mirrored"]
    assert (next(iter(slower)), next(iter(faster))) == ("sway_speed_0.75", "sway_speed_1.25")
    assert own == other  # the library that was named is the base's own
    assert own != noise
    page = (tmp_path / "out" / "generality.md").read_text()
    assert "\nOurs, not in the paper: A base completes most episodes of the mirror images of its clips" in page
    assert "\n| mirror images | 3 | " in page
    assert page.startswith("# What does a base know beyond its clips? (1 base)\n")
    assert "\n- 2 episodes a clip.\n- Made by code " in page
    assert "KL" not in page


@pytest.fixture
def control(base_run, tmp_path) -> Path:
    """The base as if it had been pretrained without `turn`."""
    folder = Path(shutil.copytree(base_run.checkpoint(4), tmp_path / "control"))
    config = load_config(folder / "config.yaml")
    save_config(unlearning_config(config, UnlearnConfig(("turn",), "retrain")), folder / "config.yaml")
    return folder


def test_a_control_stands_for_the_retrained_policy_and_is_evaluated_beside_its_base(base_run, control, tmp_path):
    of = Lab(options(StudyOptions, base_run, tmp_path, controls=str(control)), iterations=2)
    policy = policy_hash(read_info(control))
    assert of.control_conditions() == {"controls": [{"policy": policy, "environment_steps": 128}]}
    assert of.retrained == {Repeat(0, 0): {"control": True}}
    trial = of.trial({"control": True}, Repeat(0, 0))
    assert (trial.command, trial.task.iterations) == ("evaluate", 0)
    given = parse(evaluate.Options, "evaluate", [*trial.flags, "--output", str(trial.folder)])
    finished(evaluate.main, given)
    assert trial.finished
    assert newest_policy(trial.folder) == control
    document = json.loads((trial.folder / "evaluation.json").read_text())
    assert (document["targets"], document["episodes"], document["seed"]) == (["turn"], 2, 0)
    assert document["policy_hashes"] == {"base": policy, "retrained": policy}
    found = summary(trial.folder)
    assert found["policy"]["clips"] == found["base"]["clips"]  # of one policy on the same episodes
    assert found.keys() == {"policy", "base", "zero_action"}


def test_shipped_bases_and_controls_are_found_without_a_flag(base_run, control, tmp_path, monkeypatch):
    shipped = {"base": base_run.checkpoint(4), "base-1": base_run.checkpoint(2), "control": control}
    for name, folder in shipped.items():
        shutil.copytree(folder, tmp_path / "data" / "g1" / name)
    monkeypatch.setattr(start, "DATA_DIR", tmp_path / "data")
    of = Lab(options(StudyOptions, base_run, tmp_path, bases=None), iterations=2)
    assert [info.path.name for info in of.bases] == ["base", "base-1"]
    assert [info.path.name for info in of.controls] == ["control"]
    assert list(of.retrained) == [Repeat(0, 0)]
    assert of.trial({}, Repeat(1, 0)).folder != of.trial({}, Repeat(0, 0)).folder
    other = Lab(options(StudyOptions, base_run, tmp_path, bases=None, targets="nod"), iterations=2)
    assert other.controls == ()  # the shipped one is of other targets


def test_a_policy_is_rolled_out_on_the_episodes_of_a_watched_trial(base_run, tmp_path):
    of, path = Lab(options(StudyOptions, base_run, tmp_path, episodes=4), iterations=2), base_run.checkpoint(4)
    setup = make_setup(dataclasses.replace(of.config, seed=3, evaluate_episodes=2))
    row = Watch(setup, tmp_path, 0).measure(load_policy(read_info(path), setup.robot), 0, 0)
    assert of.as_watched({"base": path}, seed=3) == {"base": row["clips"]}
    evaluated, names = of.rollouts({"base": path}, episodes=2, seed=3)
    assert clip_means(evaluated["base"], names) != row["clips"]  # the best is chosen by other episodes


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"controls": "BASE"}, "unlearn.method: found none; accepted for a control: distill or retrain"),
        ({"targets": "nod"}, "unlearn.targets: found ['turn']; accepted for a control: ['nod']"),
        ({"controls": "CONTROL,CONTROL/"}, "--controls: found 2; accepted: one for each base at most, here 1"),
    ],
)
def test_what_is_no_control_is_refused(base_run, control, tmp_path, given, message):
    given = {"controls": "CONTROL"} | given
    places = {"CONTROL": str(control), "BASE": str(base_run.checkpoint(4))}
    for name, place in places.items():
        given["controls"] = given["controls"].replace(name, place)
    with pytest.raises(InputError) as refused:
        Lab(options(StudyOptions, base_run, tmp_path, **given), iterations=2)
    assert str(refused.value).endswith(message)


def test_the_comparison_asks_for_every_method_and_every_sampler_with_and_without_the_wrench(
    base_run, watched_run, tmp_path, monkeypatch
):
    ordered = {}

    def stand_in(wanted, **_):
        for trial in wanted:
            given = parse(unlearn.Options, "unlearn", trial.flags)
            ordered[given.method, given.penalty or 16.0, given.sampler, given.wrench, given.clips, given.seed] = given
            if not trial.folder.exists():
                shutil.copytree(watched_run.folder, trial.folder)
        return {}

    monkeypatch.setattr(trials, "run_trials", stand_in)
    module = importlib.import_module("experiments.comparison")
    given = options(StudyOptions, base_run, tmp_path, control_iterations=7)
    finished(lambda given: conduct.conduct(module.STUDY, given, ""), given)
    from forgetmimic_jax.unlearning.registry import methods

    assert {key[0] for key in ordered} == methods().keys()
    samplers = {key[2:4] for key in ordered if key[0] == "arft" and key[1] == 16.0}
    every = (None, "uniform_bins", "frozen", "adaptive")
    assert samplers == {(sampler, wrench) for sampler in every for wrench in (False, True)}
    assert {key[4] for key in ordered if key[0] == "finetune"} == {None, "all"}
    assert [given.iterations for key, given in ordered.items() if key[0] == "retrain"] == [7]  # once, on a laptop
    assert {key[5] for key in ordered if key[0] != "retrain"} == {0, 1}
