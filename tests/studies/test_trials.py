"""A trial's folder says what it is, and its flags make its settings."""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import pytest

from forgetmimic_jax import unlearn
from forgetmimic_jax.basics.provenance import provenance
from forgetmimic_jax.motion.library import DATA_DIR
from forgetmimic_jax.settings.options import parse
from forgetmimic_jax.studies import trials
from forgetmimic_jax.studies.trials import make_trial, without_code
from forgetmimic_jax.training.start import base_folder
from forgetmimic_jax.training.unlearning_run import config_of
from forgetmimic_jax.unlearning import method


@pytest.fixture
def base(tmp_path) -> Path:
    return Path(shutil.copytree(base_folder("g1"), tmp_path / "base"))


def test_a_trials_folder_says_what_it_is_and_its_flags_make_its_settings(tmp_path, base):
    found = make_trial(tmp_path, {"base": base, "iterations": 5, "seed": 2, "method": "arft"})
    assert re.fullmatch(rf"arft-punch\+kick-s2-[0-9a-f]{{8}}-{provenance().code}", found.folder.name)
    assert found.flags == ("--iterations", "5", "--seed", "2", "--base", str(base))
    wanted = {"base": base, "iterations": 5, "penalty": 8.0, "wrench": True, "sampler": None, "targets": "run, walk"}
    other = make_trial(tmp_path, {**wanted, "physics": "native", "set": ["ppo.base_kl=0.5", "ppo.epochs=7"]})
    assert other.folder.name.startswith("arft-run+walk-s0-")
    assert without_code(other.folder.name) + f"-{provenance().code}" == other.folder.name
    config = other.config
    assert (config.unlearn.settings, config.ppo.base_kl, config.ppo.epochs) == ({"penalty": 8.0}, 0.5, 7)
    assert (config.iterations, other.task.iterations, config.physics.engine) == (5, 5, "native")
    assert config.wrench.max_gain > 0.0
    for trial in (found, other):  # what the process makes of the flags is the trial's config
        assert config_of(parse(unlearn.Options, "unlearn", trial.flags)) == trial.config


def test_the_same_question_has_the_same_folder_wherever_its_base_lies(tmp_path, base):
    wanted = {"base": base, "iterations": 5, "penalty": 8.0}
    moved = Path(shutil.copytree(base, tmp_path / "moved"))
    same = make_trial(tmp_path, {"penalty": 8.0, "iterations": 5, "method": "arft", "base": moved})
    assert make_trial(tmp_path, wanted).folder == same.folder
    assert make_trial(tmp_path, {**wanted, "targets": "punch,kick"}).folder == same.folder  # the default
    different = [{"penalty": 9.0}, {"iterations": 6}, {"seed": 1}, {"set": ["ppo.base_kl=0.5"]}, {"episodes": 3}]
    folders = {make_trial(tmp_path, wanted | change).folder for change in different}
    meta = json.loads((base / "meta.json").read_text())
    # A copy that another commit on another machine wrote is the same policy; another policy file is not.
    (base / "meta.json").write_text(json.dumps({**meta, "made": {"code": "0123abcd", "processor": "another"}}))
    assert make_trial(tmp_path, wanted).folder == same.folder
    files = {**meta["files"], "policy.safetensors": 64 * "0"}
    (base / "meta.json").write_text(json.dumps({**meta, "files": files}))
    folders.add(make_trial(tmp_path, wanted).folder)
    library = Path(
        shutil.copytree(DATA_DIR / "g1", tmp_path / "library", ignore=shutil.ignore_patterns("base", "unlearned-*"))
    )
    assert make_trial(tmp_path, {**wanted, "base": moved, "library": library}).folder == same.folder
    (library / "punch.npz").write_bytes((library / "kick.npz").read_bytes())
    folders.add(make_trial(tmp_path, {**wanted, "base": moved, "library": library}).folder)
    assert len(folders | {same.folder}) == 8


def test_a_default_that_changes_makes_another_trial(tmp_path, base, monkeypatch):
    before = make_trial(tmp_path, {"base": base, "iterations": 5})
    monkeypatch.setitem(method.SHORT, "learning_rate", 2e-4)
    assert make_trial(tmp_path, {"base": base, "iterations": 5}).folder != before.folder


def test_other_code_or_versions_make_another_trial(tmp_path, base, monkeypatch):
    found = [make_trial(tmp_path, {"base": base, "iterations": 5}).folder.name]
    other = dataclasses.replace(provenance(), code="0123abcd")
    monkeypatch.setattr(trials, "provenance", lambda: other)
    found.append(make_trial(tmp_path, {"base": base, "iterations": 5}).folder.name)
    assert found[1] == f"{without_code(found[0])}-0123abcd"
    other = dataclasses.replace(provenance(), mujoco="2.3.0")
    monkeypatch.setattr(trials, "provenance", lambda: other)
    found.append(make_trial(tmp_path, {"base": base, "iterations": 5}).folder.name)
    assert without_code(found[2]) != without_code(found[0])


@pytest.mark.parametrize("note", ["evaluation.json", "checkpoints/00000005/meta.json"])
def test_a_trial_that_other_code_made_a_part_of_has_failed_and_says_so(tmp_path, base, note):
    trial = make_trial(tmp_path, {"base": base, "iterations": 5})
    here = {"made": {"code": provenance().code}}
    for path in ("evaluation.json", "checkpoints/00000005/meta.json"):
        (trial.folder / path).parent.mkdir(parents=True, exist_ok=True)
        (trial.folder / path).write_text(json.dumps(here))
    assert trial.finished
    assert trials.run_trials([trial], jobs=1, cluster=None, description="try") == {}
    (trial.folder / note).write_text(json.dumps({"made": {"code": "0123abcd"}}))
    assert not trial.finished
    (reason,) = trials.run_trials([trial], jobs=1, cluster=None, description="try").values()
    assert reason == (
        f"code 0123abcd made a part of it, as the checkout changed meanwhile; remove {trial.folder} to run it again"
    )
