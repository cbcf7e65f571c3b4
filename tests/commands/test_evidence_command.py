"""Evidence in miniature: the trainings are real, the rollouts are those of the toy world."""

import contextlib
import dataclasses
import io
import json
import shutil
from pathlib import Path

import pytest
from miniature import finished
from toy import ToyStage

from forgetmimic_jax import evidence, report
from forgetmimic_jax.attacks import case as cases
from forgetmimic_jax.attacks import fakes, judged
from forgetmimic_jax.attacks.control import read_control
from forgetmimic_jax.attacks.document import read_evidence
from forgetmimic_jax.attacks.verdict import RULES, judge
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.settings.config import UnlearnConfig, load_config, save_config
from forgetmimic_jax.settings.options import parse
from forgetmimic_jax.studies import executor
from forgetmimic_jax.tracking.setup import make_setup
from forgetmimic_jax.training.checkpoint import policy_hash, read_info
from forgetmimic_jax.unlearning.registry import unlearning_config

SMALL = {"control_iterations": 1, "recovery_iterations": 1, "relearning_iterations": 1, "episodes": 4}


@pytest.fixture(scope="module", autouse=True)
def no_physics():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cases, "Stage", ToyStage)
        yield


@pytest.fixture(scope="module")
def run(unlearned_run, tmp_path_factory) -> Path:
    return Path(shutil.copytree(unlearned_run.folder, tmp_path_factory.mktemp("attacked") / "run"))


def printed_by(options: evidence.Options) -> str:
    """What the command prints."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        evidence.main(options)
    return text.getvalue()


@pytest.fixture(scope="module")
def printed(run) -> str:
    return printed_by(evidence.Options(run=str(run), **SMALL))


def test_every_attack_is_in_the_document(run, printed, base_run):
    document = read_evidence(run / "evidence.json")
    for attack in (
        *("originals", "near_duplicates", "splices", "look_alikes", "recovery", "relearning", "held_out", "numerics"),
        *("membership", "safety"),
    ):
        assert getattr(document, attack) is not None, attack
    assert document.targets == ["turn"]
    assert document.policy_hashes["unlearned"] == policy_hash(read_info(run / "checkpoints" / "00000002"))
    assert document.policy_hashes["base"] == policy_hash(read_info(base_run.checkpoint(4)))
    assert document.recovery.after.keys() == document.recovery.before.keys() == {"turn"}
    assert set(document.recovery.after["turn"]) == {"base", "unlearned", "control"}
    assert set(document.near_duplicates.families) <= {
        f"turn, {family}" for family in ("speed", "mirrored", "amplitude", "turned", "noise", "half", "blended")
    }
    assert judge(document).phrase in printed


def test_the_control_is_distilled_beside_the_run_with_another_seed(run, printed):
    config = load_config(run.with_name("run-control") / "config.yaml")
    assert (config.unlearn.method, config.sampling.clips, config.seed) == ("distill", "kept", 1)
    assert config.unlearn.targets == ("turn",)
    assert (run.with_name("run-control") / "evaluation.json").is_file()


def test_the_page_has_every_attack_and_the_command(run, printed):
    text = (run / "evidence.md").read_text()
    for said in (
        *("# Evidence: turn forgotten by arft (G1)", "## Near-duplicates", "## Splices", "## Look-alikes"),
        *("## Fine-tuning on the kept clips alone", "## Relearning", "## Other numerics", "## Membership"),
        *("## Without terminations", "## The rule", "![What brought it back](evidence.png)", "RECOVERY_ITERATIONS=1"),
    ):
        assert said in text, said
    assert (run / "evidence.png").read_bytes().startswith(b"\x89PNG")


def test_a_second_start_makes_nothing_again(run, printed, monkeypatch):
    before = (run / "evidence.json").read_bytes()
    monkeypatch.setattr(cases, "Stage", None)  # nothing is rolled out
    parts = {path: path.stat().st_mtime_ns for path in (run / "evidence").rglob("*.json")}
    printed_by(evidence.Options(run=str(run), **SMALL))
    assert (run / "evidence.json").read_bytes() == before
    assert {path: path.stat().st_mtime_ns for path in (run / "evidence").rglob("*.json")} == parts


def test_what_is_missing_alone_is_made(run, printed):
    before = json.loads((run / "evidence.json").read_text())
    (run / "evidence" / "splices.json").unlink()
    printed_by(evidence.Options(run=str(run), **SMALL))
    assert json.loads((run / "evidence.json").read_text()) == before


def test_the_report_takes_its_verdict_from_the_evidence(run, printed):
    finished(report.main, report.Options(run=run, films=0, output=run / "report.html"))
    facts = json.loads((run / "report.json").read_text())
    verdict = judge(read_evidence(run / "evidence.json"))
    assert facts["verdict"] == json.loads(json.dumps(dataclasses.asdict(verdict)))
    assert facts["rules"] == RULES
    assert not any("Not tested: the attacks" in limit for limit in facts["limits"])


def test_evidence_of_another_policy_is_refused(run, printed, tmp_path, refused):
    copy = Path(shutil.copytree(run, tmp_path / "run"))
    document = json.loads((copy / "evidence.json").read_text())
    document["policy_hashes"]["unlearned"] = "another"
    (copy / "evidence.json").write_text(json.dumps(document))
    message = refused(report.main, report.Options(run=copy, films=0, output=copy / "report.html"))
    assert message.startswith(f"{copy}/evidence.json: policy_hashes.unlearned: found another; accepted: ")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"run": "nowhere"}, "nowhere: no run with a checkpoint"),
        (
            {"control": Path("nowhere")},
            "nowhere: no such folder; name a run of distill, retrain or pretrain, or ",
        ),
        ({"episodes": 1}, "--episodes: found 1; accepted: 2 or more"),
        ({"relearning_iterations": 0}, "--relearning-iterations: found 0; accepted: 1 or more"),
    ],
)
def test_bad_input_is_refused(run, refused, given, message):
    assert refused(evidence.main, evidence.Options(**{"run": str(run), **SMALL, **given})).startswith(message)


def test_a_run_that_unlearned_by_another_method_is_no_control(run, unlearned_run, refused):
    message = refused(evidence.main, evidence.Options(run=str(run), control=unlearned_run.folder))
    newest = unlearned_run.checkpoint(2)
    assert message == f"{newest}: unlearn.method: found arft; accepted for a control: distill or retrain"


def test_a_policy_that_was_pretrained_without_the_targets_is_a_control(unlearned_run, base_run, tmp_path):
    folder = Path(shutil.copytree(base_run.checkpoint(4), tmp_path / "control"))
    config = load_config(folder / "config.yaml")
    save_config(unlearning_config(config, UnlearnConfig(("turn",), "retrain")), folder / "config.yaml")
    info = read_info(unlearned_run.checkpoint(2))
    found = read_control(folder, info, make_setup(info.config))
    assert (found.path, found.base, found.config.unlearn.method) == (folder, None, "retrain")
    meta = json.loads((folder / "meta.json").read_text())
    (folder / "meta.json").write_text(json.dumps(meta | {"base": "x"}))
    assert read_control(folder, info, make_setup(info.config)).base == "x"  # another robot's control
    save_config(unlearning_config(config, UnlearnConfig(("turn",), "distill")), folder / "config.yaml")
    with pytest.raises(InputError, match=rf"control: base: found x; accepted: {info.base}, as in the unlearned run"):
        read_control(folder, info, make_setup(info.config))


def test_other_numbers_of_everything_are_other_evidence(run, printed, refused):
    message = refused(evidence.main, evidence.Options(run=str(run), **{**SMALL, "episodes": 6}))
    assert message.startswith(f"{run}/evidence/conditions.json: scale: found ")
    assert message.endswith(f"remove the folder {run}/evidence to start again")


def test_the_fakes_and_another_distilled_policy_are_judged(run, printed, monkeypatch):
    trained = {}

    def copied(info, base, folder, **given):
        trained[folder.name] = given
        if not folder.exists():
            shutil.copytree(run, folder)

    def verdict(case, parts, name, policy, document):
        assert callable(policy.mean_action)
        return judged.Judged("failed", (f"Caught: {name}.",))

    monkeypatch.setattr(evidence, "_unlearn", copied)
    monkeypatch.setattr(fakes, "falls_on_targets_alone", lambda setup, base, targets, kept: base)
    monkeypatch.setattr(judged, "judged", verdict)
    printed_by(evidence.Options(run=str(run), fakes=True, **SMALL))
    rows = [line for line in (run / "evidence.md").read_text().splitlines() if "Caught" in line]
    assert len(rows) == 7
    assert "| λ = 8 | failed | Caught: λ = 8. | 0 |" in rows
    printed_by(evidence.Options(run=str(run), **SMALL))
    assert "| λ = 8 | failed |" in (run / "evidence.md").read_text()  # from fakes.json
    assert trained["run-lambda-8"] == {"penalty": 8.0, "iterations": 1, "seed": 0}
    assert trained["run-distilled"] == {"method": "distill", "iterations": 1, "seed": 2}
    assert trained["run-control"] == {"method": "distill", "iterations": 1, "seed": 1}


def test_a_fake_that_passes_is_said(run, printed, monkeypatch, capfd):
    monkeypatch.setattr(evidence, "_unlearn", lambda info, base, folder, **given: None)
    monkeypatch.setattr(fakes, "fakes", lambda *given: {"the base itself": lambda: None})
    monkeypatch.setattr(judged, "judged", lambda *given: judged.Judged("inconclusive", ("Not sure.",)))
    for name in ("run-lambda-8", "run-distilled"):
        shutil.copytree(run, run.with_name(name), dirs_exist_ok=True)
    evidence.main(evidence.Options(run=str(run), fakes=True, **SMALL))
    warned = [line for line in capfd.readouterr().err.splitlines() if "should be" in line]
    assert [line.split(":")[1].strip() for line in warned] == ["the base itself", "λ = 8", "distilled again"]
    assert "the verdict should be consistent with retraining" in warned[-1]
    assert all("the verdict should be failed" in line for line in warned[:-1])


def test_a_run_of_other_targets_beside_is_refused(run, base_run, tmp_path):
    folder = Path(shutil.copytree(run, tmp_path / "run-lambda-8"))
    for path in folder.rglob("config.yaml"):
        path.write_text(path.read_text().replace("  - turn\n", "  - nod\n"))
    message = (
        r"run-lambda-8: unlearn.targets: found \['nod'\]; accepted: \['turn'\]; remove the folder to make it again"
    )
    with pytest.raises(InputError, match=message):
        evidence._unlearn(read_info(run), base_run.checkpoint(4), folder, penalty=8.0)


def test_every_run_to_attack_is_a_task(run, tmp_path, monkeypatch):
    runs, where = [shutil.copytree(run, tmp_path / name) for name in ("a", "b")], {"jobs": 3, "cluster": "tcp://a:8786"}
    for folder in runs:
        (folder / "evidence.json").unlink(missing_ok=True)
    given = []
    monkeypatch.setattr(executor, "run_tasks", lambda tasks, **how: given.append((tasks, how)) or {})
    one = evidence.Options(run="a", full=True, recovery_iterations=7)
    evidence.main(dataclasses.replace(one, run=",".join(map(str, runs)), **where))
    ((tasks, how),) = given
    assert {name: how[name] for name in where} == where
    for folder, task in zip(runs, tasks, strict=True):
        assert parse(evidence.Options, "evidence", task.flags) == dataclasses.replace(one, run=str(folder))
        assert (task.folder, task.command, task.last, task.adds) == (folder, "evidence", "evidence.json", True)


def test_evidence_of_another_scale_does_not_count_as_finished(run, printed, tmp_path, monkeypatch, refused):
    several = evidence.Options(run=f"{run},{shutil.copytree(run, tmp_path / 'b')}", **SMALL)
    larger = dataclasses.replace(several, episodes=SMALL["episodes"] + 1)
    found = f"{run / 'evidence.json'}: of {SMALL['episodes']} episodes a clip and 1 training(s) of each kind; "
    wanted = f"accepted: {SMALL['episodes'] + 1} and 1; attack this run alone, or remove the file"
    assert refused(evidence.main, larger) == found + wanted
    given = []
    monkeypatch.setattr(executor, "run_tasks", lambda tasks, **how: given.extend(tasks) or {})
    evidence.main(several)
    evidence.main(dataclasses.replace(several, fakes=True))
    assert [task.last for task in given] == ["evidence.json"] * 2 + ["fakes.json"] * 2
