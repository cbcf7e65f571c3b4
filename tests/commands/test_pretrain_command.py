"""The command around pretraining: its settings, and what it says before it trains."""

import dataclasses
import shutil
from pathlib import Path

import pytest
from miniature import TINY

from forgetmimic_jax import pretrain
from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion import quality
from forgetmimic_jax.motion.library import DATA_DIR
from forgetmimic_jax.settings.config import Config, UnlearnConfig, load_config, preset, save_config
from forgetmimic_jax.tracking.setup import make_setup
from forgetmimic_jax.unlearning.registry import unlearning_config

PHASES = [*TINY, "evaluate_every=4"]


def config_of(**given):
    return pretrain.config_of(pretrain.Options(**given), Path("run"))


def test_a_base_from_nothing_in_at_most_120_million_steps():
    config = config_of()
    assert (config.base, config.library, config.robot) == (None, None, "g1")
    assert config.iterations * config.ppo.num_envs * config.ppo.num_steps == 88_473_600
    assert (config.evaluate_every, config.checkpoint_every, config.evaluate_episodes) == (100, 50, 20)
    assert config.noise.enabled
    assert config.physics.self_collision
    assert config.ppo == preset("cpu").ppo


def test_a_library_of_ones_own_starts_from_the_shipped_base_with_its_observations(library_folder, tmp_path):
    shipped = DATA_DIR / "g1" / "base"
    found = config_of(library=library_folder)
    assert found.base == str(shipped)
    assert found.observation == load_config(shipped / "config.yaml").observation
    fresh = config_of(library=library_folder, base=Path("none"))
    assert (fresh.base, fresh.observation) == (None, Config().observation)
    other = Path(shutil.copytree(DATA_DIR / "h2" / "base", tmp_path / "other"))
    observation = dataclasses.replace(Config().observation, layout="mjlab154")
    save_config(dataclasses.replace(load_config(other / "config.yaml"), observation=observation), other / "config.yaml")
    found = config_of(library=library_folder, base=other)
    assert (found.base, found.observation) == (str(other), observation)


def test_the_same_command_continues_a_run_from_a_random_policy(library_folder, tmp_path):
    fresh = pretrain.Options(library=library_folder, base=Path("none"))
    save_config(pretrain.config_of(fresh, tmp_path), tmp_path / "config.yaml")
    again = dataclasses.replace(fresh, resume=True)
    assert pretrain.config_of(again, tmp_path) == pretrain.config_of(fresh, tmp_path)
    with pytest.raises(InputError, match="--base: found other, but the run to resume has none; leave the flag out"):
        pretrain.config_of(dataclasses.replace(again, base=Path("other")), tmp_path)


def test_a_control_is_trained_from_nothing_without_its_clips(library_folder, refused, tmp_path):
    found = config_of(library=library_folder, without=" turn, nod")
    assert (found.base, found.unlearn.targets, found.unlearn.method) == (None, ("turn", "nod"), "retrain")
    assert (found.sampling.clips, found.ppo) == ("kept", config_of().ppo)
    save_config(found, tmp_path / "config.yaml")
    again = pretrain.Options(library=library_folder, without="turn,nod", resume=True)
    assert pretrain.config_of(again, tmp_path) == found
    assert pretrain.config_of(dataclasses.replace(again, without=None), tmp_path) == found
    with pytest.raises(InputError, match="--without: found turn, but the run to resume has turn,nod; leave the flag"):
        pretrain.config_of(dataclasses.replace(again, without="turn"), tmp_path)


def test_a_control_starts_from_no_policy_that_may_know_its_clips(library_folder, refused, tmp_path):
    base = DATA_DIR / "g1" / "base"
    given = pretrain.Options(robot="h2", library=library_folder, without="turn", base=base)
    message = refused(pretrain.main, given)
    assert message == f"{base}: unlearn.method: found none; accepted for a control: distill or retrain"
    control = Path(shutil.copytree(base, tmp_path / "control"))
    config = unlearning_config(load_config(base / "config.yaml"), UnlearnConfig(("turn",), "retrain"))
    save_config(config, control / "config.yaml")
    found = pretrain.config_of(dataclasses.replace(given, base=control), tmp_path)
    assert (found.robot, found.base, found.unlearn.targets) == ("h2", str(control), ("turn",))


def test_what_the_phases_cannot_work_with_is_refused_in_one_line(refused, library_folder):
    def refusal_of(*settings: str) -> str:
        options = pretrain.Options(library=library_folder, base=Path("none"), set=[[*PHASES, *settings]])
        return refused(pretrain.main, options)

    every = "accepted: a multiple of checkpoint_every = 2, from it on"
    assert refusal_of("evaluate_every=0") == f"evaluate_every: found 0; {every}"
    assert refusal_of("evaluate_every=3") == f"evaluate_every: found 3; {every}"
    assert refusal_of("ppo.schedule=fixed") == "ppo.schedule: found fixed; accepted: adaptive, adaptive_iteration"
    assert refusal_of("pretrain.patience=0") == "--set: pretrain.patience: found 0; accepted: a whole number from 1"


def test_an_infeasible_clip_is_named_with_its_numbers(library_folder, monkeypatch, capsys):
    measured = quality.measure

    def worse(robot, clip):
        found = measured(robot, clip)
        if clip.name != "nod":
            return found
        worst = {
            "missing_acceleration": " (at 0.62 s, frame 31)",
            "motor_load": " (left_knee_joint at 0.24 s, frame 12)",
        }
        return dataclasses.replace(found, missing_acceleration=9.5, motor_load=2.93, worst=worst)

    monkeypatch.setattr(quality, "measure", worse)
    setup = make_setup(dataclasses.replace(preset("cpu"), library=str(library_folder)))
    pretrain.warn_of_infeasible(setup)
    assert capsys.readouterr().err.splitlines() == [
        "warning: nod may be infeasible: for 0.2 s it needs 9.5 m/s^2 that no contact gives (at 0.62 s, frame 31)",
        "warning: nod may be infeasible: for 0.1 s it needs 2.93 times a motor's torque limit "
        "(left_knee_joint at 0.24 s, frame 12)",
    ]
