"""What a report accepts to compare a run with, what it refuses, and what it counts as not measured."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from miniature import finished

from experiments.relearning import origins
from forgetmimic_jax import report
from forgetmimic_jax.evaluation.relearning import comparable_settings
from forgetmimic_jax.evaluation.repeats import Repeat
from forgetmimic_jax.settings.checked import from_dict
from forgetmimic_jax.settings.config import Config, load_config, save_config, to_dict
from forgetmimic_jax.training.checkpoint import policy_hash, read_info

FIRST, SECOND = "base 0, seed 0", "base 0, seed 1"
METRICS = ("tracking_reward", "survival_weighted_tracking", "success_rate", "episode_length")


def estimate(mean: float) -> dict:
    return {"mean": mean, "low": mean - 0.05, "high": mean + 0.05, "std": 0.1, "n": 3}


def skilled(policy: dict, target: float, kept: float) -> dict:
    """A policy of an evaluation whose skill is given."""
    clips = {
        name: clip | {"skill": estimate(target if clip["target"] else kept)} for name, clip in policy["clips"].items()
    }
    return policy | {"clips": clips}


@pytest.fixture(scope="module")
def run(unlearned_run, tmp_path_factory) -> Path:
    """The miniature run; by hand, its policy retains none of the target's skill and all of the other clips'."""
    folder = Path(shutil.copytree(unlearned_run.folder, tmp_path_factory.mktemp("compared") / "run"))
    document = json.loads((folder / "evaluation.json").read_text())
    document["policies"]["unlearned"] = skilled(document["policies"]["unlearned"], target=0.05, kept=0.95)
    (folder / "evaluation.json").write_text(json.dumps(document))
    return folder


@pytest.fixture
def document(run) -> dict:
    return json.loads((run / "evaluation.json").read_text())


@pytest.fixture
def make_control(run, document, tmp_path) -> Callable[..., Path]:
    """`make_control()`: a distilled control of the run, by its files. It never rolled out the target."""

    def make_control(*, config: dict[str, Any] | None = None, kept: float = 0.95, **fields) -> Path:
        """With other settings, another skill on the kept clips, or other fields of its evaluation."""
        folder = tmp_path / "control"
        folder.mkdir(exist_ok=True)
        settings = {"unlearn.method": "distill", "sampling.clips": "kept", "sampling.target_share": 0.0}
        settings |= {"unlearn.settings": {}, "unlearn.stop_every": 0}  # the penalty and the stop rule are arft's
        save_config(changed(load_config(run / "config.yaml"), settings | (config or {})), folder / "config.yaml")
        policy = skilled(document["policies"]["unlearned"], target=0.1, kept=kept)
        result = {"distill": "unlearned", "retrain": "retrained"}.get((config or {}).get("unlearn.method"), "unlearned")
        policies = {"base": document["policies"]["base"], result: policy}
        (folder / "evaluation.json").write_text(json.dumps(document | {"policies": policies} | fields))
        return folder

    return make_control


def changed(config: Config, settings: dict[str, Any]) -> Config:
    """A config with other values by their dotted names."""
    content = to_dict(config)
    for name, value in settings.items():
        *sections, field = name.split(".")
        table = content
        for section in sections:
            table = table[section]
        table[field] = value
    return from_dict(Config, content)


def curve(steps: float) -> dict:
    """The base tracks at 0.5; 0.4 of it, 80 %, is reached after so many steps on the targets."""
    return {
        "iterations": [0, 1, 2, 3],
        "target_steps": [0, steps / 2, steps, 2 * steps],
        "tracking": [0.1, 0.39, 0.4, 0.5],
    }


@pytest.fixture
def study(run, document) -> dict:
    """A relearning study of policies like the run's: two seeds, and a distilled and a retrained control."""
    config = load_config(run / "config.yaml")
    settings = comparable_settings(config)
    fresh = settings | {"sampling.clips": "kept", "sampling.target_share": 0.0}

    def origin(settings: dict) -> dict:
        return {"settings": settings, "kept_skill": {FIRST: estimate(0.95), SECOND: estimate(0.9)}}

    return {
        "conditions": {"library": document["library_hash"], "targets": document["targets"]},
        "results": {
            "base": {FIRST: 0.5, SECOND: 0.5},
            "starts": {
                "unlearned": {FIRST: curve(900), SECOND: curve(900)},
                "distilled": {FIRST: curve(1000), SECOND: curve(1000)},
                "retrained": {FIRST: curve(500)},
                "fresh": {FIRST: curve(2000), SECOND: curve(2000)},
            },
            "origins": {
                "bases": [document["policy_hashes"]["base"]],
                "starts": {
                    "unlearned": origin(settings),
                    "distilled": origin(fresh | {"unlearn.method": "distill"}),
                    "retrained": origin(fresh | {"unlearn.method": "retrain"}),
                },
            },
        },
    }


@pytest.fixture
def reported(run, tmp_path) -> Callable[..., dict]:
    """`reported(control, study)`: the page's facts."""

    def reported(control: Path | None = None, study: dict | None = None) -> dict:
        counts = tmp_path / "relearning.json"
        counts.write_text(json.dumps(study))
        options = report.Options(
            run=run, control=control, relearning=counts if study else None, films=0, output=tmp_path / "r.html"
        )
        printed = finished(report.main, options).printed
        facts = json.loads((tmp_path / "r.json").read_text())
        assert printed.startswith(f"{facts['verdict']['phrase']}: ")
        assert facts["commands"][1].endswith(f"--control {control} --relearning {counts}" if control and study else "")
        return facts

    return reported


def test_comparisons_that_belong_to_the_run_enter_the_verdict(make_control, study, reported):
    slow = reported(make_control(), study)
    assert slow["verdict"]["phrase"] == "consistent with retraining"
    assert "900 against 1,000; 900 against 1,000 target steps" in slow["verdict"]["reasons"][-1]
    assert not any("not measured" in limit or "not compared" in limit for limit in slow["limits"])
    assert "Relearning was measured on the study's own unlearned policies" in " ".join(slow["limits"])
    study["results"]["starts"]["unlearned"] = {FIRST: curve(100), SECOND: curve(100)}
    assert reported(make_control(), study)["verdict"]["phrase"] == "suppressed but recoverable"


def refusal(refused, run: Path, folder: Path, *, control: Path | None = None, study: dict | None = None) -> str:
    counts = folder / "relearning.json"
    counts.write_text(json.dumps(study))
    options = report.Options(
        run=run, control=control, relearning=counts if study is not None else None, films=0, output=folder / "r.html"
    )
    message = refused(report.main, options)
    return message.removeprefix(f"{counts}: ").removeprefix(f"{control}/")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"config": {"sampling.clips": "all"}},
            "config.yaml: sampling.clips: found all; accepted for a control: kept",
        ),
        (
            {"config": {"unlearn.method": "retrain", "sampling.clips": "all"}},
            "config.yaml: sampling.clips: found all; accepted for a control: kept",
        ),
        (
            {"config": {"unlearn.targets": ("nod",)}},
            "config.yaml: unlearn.targets: found ['nod']; accepted for a control: ['turn']",
        ),
        (
            {"config": {"unlearn.method": "finetune"}},
            "config.yaml: unlearn.method: found finetune; accepted for a control: distill or retrain",
        ),
        (
            {"config": {"unlearn.targets": ()}},
            "config.yaml: unlearn.method: found none; accepted for a control: distill or retrain",
        ),
        ({"episodes": 50}, "evaluation.json: episodes: found 50; accepted: 3, as in the unlearned run"),
        ({"seed": 1}, "evaluation.json: seed: found 1; accepted: 0, as in the unlearned run"),
        ({"robot": "h2"}, "evaluation.json: robot: found h2; accepted: g1, as in the unlearned run"),
        ({"library_hash": "x"}, "evaluation.json: library_hash: found x; accepted: "),
        ({"targets": ["nod"]}, "evaluation.json: targets: found ['nod']; accepted: ['turn'], as in the unlearned run"),
        ({"policy_hashes": {"base": "x"}}, "evaluation.json: policy_hashes.base: found x; accepted: "),
        (
            {"config": {"unlearn.method": "retrain"}, "policies": {}},
            "evaluation.json: policies: found ; accepted: an evaluation with the policy retrained",
        ),
        ({"policies": 3}, "evaluation.json: not an evaluation, or damaged: "),
    ],
)
def test_a_control_of_something_else_is_refused(refused, run, make_control, tmp_path, given, message):
    assert refusal(refused, run, tmp_path, control=make_control(**given)).startswith(message)


def test_the_run_itself_is_no_control(refused, run, tmp_path):
    message = "config.yaml: unlearn.method: found arft; accepted for a control: distill or retrain"
    assert refusal(refused, run, tmp_path, control=run) == message


def test_a_control_that_does_not_say_its_base_is_not_measured(make_control, study, reported):
    facts = reported(make_control(policy_hashes={}), study)
    assert facts["verdict"]["phrase"] == "inconclusive"
    (why,) = [reason for reason in facts["verdict"]["reasons"] if "was not used" in reason]
    assert why.endswith("control/evaluation.json does not say of which base it is; evaluate it again.")
    assert why in facts["limits"]


def test_an_incompetent_control_is_not_measured(make_control, study, reported):
    """The bound is on the whole interval: 0.84 ± 0.05 reaches below 80 %."""
    assert reported(make_control(kept=0.851), study)["verdict"]["phrase"] == "consistent with retraining"
    for kept, retained in ((0.84, "84 % [79, 89]"), (0.03, "3 % [0, 8]")):
        facts = reported(make_control(kept=kept), study)
        assert facts["verdict"]["phrase"] == "inconclusive"
        (why,) = [reason for reason in facts["verdict"]["reasons"] if "was not used" in reason]
        assert f"it retains {retained} of the kept clips' skill; a control needs at least 80 % of it" in why
        assert why in facts["limits"]


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("robot", "h2"),
        ("unlearn.method", "decremental"),
        ("unlearn.settings.penalty", 8.0),
        ("unlearn.targets", ["nod"]),
        ("iterations", 200),
        ("preset", "paper"),
        ("ppo.num_envs", 16),
        ("sampling.rule", "adaptive"),
    ],
)
def test_curves_of_policies_trained_in_another_way_are_refused(refused, run, study, tmp_path, setting, value):
    settings = study["results"]["origins"]["starts"]["unlearned"]["settings"]
    ours = settings[setting]
    settings[setting] = value
    assert refusal(refused, run, tmp_path, study=study) == (
        f"results.origins.starts.unlearned.{setting}: found {value}; accepted: {ours}, as in the unlearned run"
    )


def test_a_run_that_was_evaluated_on_its_way_is_as_long_as_that(refused, run, study, tmp_path):
    copy = Path(shutil.copytree(run, tmp_path / "copy"))
    (copy / "checkpoints" / "00000002").rename(copy / "checkpoints" / "00000001")
    meta = json.loads((copy / "checkpoints" / "00000001" / "meta.json").read_text())
    (copy / "checkpoints" / "00000001" / "meta.json").write_text(json.dumps(meta | {"iteration": 1}))
    text = (copy / "evaluation.json").read_text().replace("00000002", "00000001")
    (copy / "evaluation.json").write_text(text)
    message = refusal(refused, copy, tmp_path, study=study)
    assert message.startswith("results.origins.starts.unlearned.iterations: found 2; accepted: 1")


def test_a_study_of_something_else_is_refused(refused, run, study, tmp_path):
    def refused_when(change: Callable[[dict], Any]) -> str:
        copy = json.loads(json.dumps(study))
        change(copy)
        return refusal(refused, run, tmp_path, study=copy)

    assert refused_when(lambda of: of["conditions"].update(library="x")).startswith(
        "conditions.library: found x; accepted: "
    )
    assert refused_when(lambda of: of["conditions"].update(targets=["nod"])).startswith(
        "conditions.targets: found ['nod']; accepted: ["
    )
    assert refused_when(lambda of: of["results"]["origins"].update(bases=["x"])).startswith(
        "results.origins.bases: found x; accepted: "
    )
    assert refused_when(lambda of: of["results"]["starts"].pop("unlearned")).startswith(
        "not a relearning study, or damaged: "
    )
    assert refused_when(lambda of: of["results"]["origins"].update(starts=3)).startswith(
        "not a relearning study, or damaged: "
    )
    assert refused_when(lambda of: of.clear()).startswith("not a relearning study, or damaged: KeyError: 'conditions'")

    def all_clips(of: dict) -> None:
        of["results"]["origins"]["starts"]["distilled"]["settings"]["sampling.clips"] = "all"

    assert refused_when(all_clips) == (
        "results.origins.starts.distilled: sampling.clips: found all; accepted for a control: kept"
    )


def test_of_a_study_on_several_bases_the_runs_of_the_reports_base_count(make_control, study, reported):
    results, other = study["results"], "base 1, seed 0"
    results["origins"]["bases"] = [*results["origins"]["bases"], "x"]
    results["base"][other] = 0.5
    for start, steps in (("unlearned", 100), ("distilled", 1000)):  # on the other base it is faster than the control
        results["starts"][start][other] = curve(steps)
        results["origins"]["starts"][start]["kept_skill"][other] = estimate(0.95)
    assert reported(make_control(), study)["verdict"]["phrase"] == "consistent with retraining"
    results["origins"]["bases"].reverse()
    facts = reported(make_control(), study)
    assert facts["verdict"]["phrase"] == "suppressed but recoverable"
    assert "100 against 1,000 target steps" in facts["verdict"]["reasons"][-1]


def test_a_study_that_does_not_say_how_its_policies_were_trained_is_not_measured(make_control, study, reported):
    del study["results"]["origins"]
    facts = reported(make_control(), study)
    assert facts["verdict"]["phrase"] == "inconclusive"
    (why,) = [reason for reason in facts["verdict"]["reasons"] if "was not used" in reason]
    assert why.endswith("does not say how its policies were trained; run that study again.")
    assert why in facts["limits"]


def test_relearning_is_compared_with_the_control_of_the_reports_own_kind(make_control, study, reported):
    # Against the retrained policy's 500 steps the unlearned one is no faster either, but with seed 0 alone.
    facts = reported(make_control(config={"unlearn.method": "retrain"}), study)
    assert facts["verdict"]["phrase"] == "consistent with retraining"
    assert facts["verdict"]["reasons"][-1].endswith("seed by seed, 900 against 500 target steps.")
    del study["results"]["starts"]["retrained"]
    facts = reported(make_control(config={"unlearn.method": "retrain"}), study)
    assert facts["verdict"]["phrase"] == "inconclusive"
    assert facts["verdict"]["reasons"][-1].endswith("has no policy made by retrain, as the control is.")


def test_curves_of_an_incompetent_control_are_not_measured(make_control, study, reported):
    kept = study["results"]["origins"]["starts"]["distilled"]["kept_skill"]
    kept[SECOND] = estimate(0.84)
    facts = reported(make_control(), study)
    assert facts["verdict"]["phrase"] == "inconclusive"
    assert "the distilled policy retains 95 % [90, 100], 84 % [79, 89] of the kept clips' skill" in " ".join(
        facts["verdict"]["reasons"]
    )
    del kept[SECOND]
    assert "retains 95 % [90, 100], an unknown share of" in " ".join(reported(make_control(), study)["limits"])


def test_the_study_writes_what_the_report_needs(base_run, unlearned_run, run, study, reported):
    """The run itself stands for the unlearned policies of a study with one seed."""
    info = read_info(base_run.checkpoint(4))
    written = origins(
        SimpleNamespace(bases=[info]),
        {("unlearned", Repeat(0, 0)): unlearned_run.folder, ("distilled", Repeat(0, 0)): run},
    )
    assert written.bases == [policy_hash(info)]
    ours = study["results"]["origins"]["starts"]
    assert written.starts["unlearned"].settings == ours["unlearned"]["settings"]
    kept = written.starts["distilled"].kept_skill[FIRST]
    assert (kept.mean, kept.low, kept.high) == pytest.approx((0.95, 0.9, 1.0))
    written.starts["distilled"].settings |= ours["distilled"]["settings"]
    study["results"]["origins"] = json.loads(msgspec.json.encode(written))
    del study["results"]["starts"]["distilled"][SECOND]
    assert "seed by seed, 900 against 1,000 target steps" in " ".join(reported(None, study)["verdict"]["reasons"])


def test_without_a_control_the_first_competent_kind_is_taken(study, reported):
    study["results"]["starts"]["unlearned"] = {FIRST: curve(100), SECOND: curve(100)}
    facts = reported(None, study)
    assert facts["verdict"]["phrase"] == "suppressed but recoverable"
    assert "100 against 1,000; 100 against 1,000 target steps" in facts["verdict"]["reasons"][-1]
    study["results"]["origins"]["starts"]["distilled"]["kept_skill"][FIRST] = estimate(0.1)
    assert "seed by seed, 100 against 500 target steps" in reported(None, study)["verdict"]["reasons"][-1]
    study["results"]["origins"]["starts"]["retrained"]["kept_skill"][FIRST] = estimate(0.1)
    facts = reported(None, study)
    assert facts["verdict"]["phrase"] == "inconclusive"
    assert any("the distilled policy retains 10 %" in limit and "the retrained" in limit for limit in facts["limits"])
