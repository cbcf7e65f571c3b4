import dataclasses

import pytest
import yaml

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.settings.checked import from_dict
from forgetmimic_jax.settings.config import (
    Config,
    PPOConfig,
    TerminationConfig,
    UnlearnConfig,
    config_hash,
    load_config,
    preset,
    save_config,
    to_dict,
    validate,
)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "config.yaml"


def changed(**ppo) -> Config:
    return dataclasses.replace(Config(), ppo=dataclasses.replace(PPOConfig(), **ppo))


def test_the_paper_preset_has_the_papers_numbers():
    config = preset("paper")
    assert (config.physics.timestep, config.physics.substeps, config.max_episode_steps) == (0.005, 4, 500)
    ppo = config.ppo
    assert (ppo.num_steps, ppo.epochs, ppo.minibatches) == (24, 5, 4)
    assert (ppo.learning_rate, ppo.schedule, ppo.target_kl) == (1e-3, "adaptive", 0.01)
    assert (ppo.discount, ppo.gae_lambda, ppo.clip_range, ppo.entropy_cost) == (0.99, 0.95, 0.2, 0.005)
    assert (ppo.value_cost, ppo.clip_value, ppo.max_gradient_norm) == (1.0, True, 1.0)
    assert ppo.actor_layers == (1024, 512, 256, 128)
    assert ppo.critic_layers == (1024, 1024, 512, 256)
    assert (config.sampling.bin_seconds, config.sampling.smoothing, config.sampling.uniform_ratio) == (4.0, 0.005, 0.15)
    assert (config.wrench.sensitivity, config.wrench.max_gain) == (0.8, 0.6)
    assert config.unlearn == UnlearnConfig(targets=(), method="arft", settings={})


@pytest.mark.parametrize("name", ["paper", "cpu"])
def test_a_preset_names_itself_and_is_valid(name):
    assert preset(name).preset == name
    validate(preset(name))


def test_an_unknown_preset_is_refused():
    with pytest.raises(InputError, match="preset 'cpus': did you mean 'cpu'"):
        preset("cpus")


@pytest.mark.parametrize("name", ["paper", "cpu"])
def test_a_saved_config_is_read_back_equal(path, name):
    config = dataclasses.replace(
        preset(name), library="clips", unlearn=UnlearnConfig(targets=("punch", "kick"), settings={"penalty": 8.5})
    )
    save_config(config, path)
    assert load_config(path) == config
    assert [file.name for file in path.parent.iterdir()] == ["config.yaml"]


def test_a_config_file_may_leave_settings_out(path):
    path.write_text("ppo:\n  learning_rate: 0.5\n")
    assert load_config(path) == changed(learning_rate=0.5)


def test_a_whole_number_serves_as_a_float(path):
    path.write_text("ppo: {learning_rate: 1}\n")
    assert isinstance(load_config(path).ppo.learning_rate, float)


def test_the_hash_is_of_the_content():
    assert config_hash(Config()) == config_hash(from_dict(Config, to_dict(Config()), "here"))
    assert len(config_hash(Config())) == 16
    assert int(config_hash(Config()), 16) > 0


def test_the_hash_sees_every_setting_that_changes_a_result():
    hashes = {
        config_hash(config)
        for config in (
            Config(),
            changed(learning_rate=1e-4),
            dataclasses.replace(Config(), seed=1),
            dataclasses.replace(Config(), unlearn=UnlearnConfig(("punch",))),
            dataclasses.replace(Config(), unlearn=UnlearnConfig(("kick",))),
        )
    }
    assert len(hashes) == 5


@pytest.mark.parametrize("name", ["iterations", "checkpoint_every", "evaluate_every", "evaluate_episodes"])
def test_the_hash_does_not_see_how_long_or_how_often(name):
    assert config_hash(dataclasses.replace(Config(), **{name: 7})) == config_hash(Config())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"pppo": {}}, "here: no setting 'pppo'; did you mean 'ppo'?"),
        ({"ppo": {"learning_rat": 1}}, "here: no setting 'ppo.learning_rat'; did you mean 'learning_rate'?"),
        ({1: 2}, "here: no setting '1'; known: preset, robot, library, base, seed, iterations, "),
        ({"ppo": 3}, "here: ppo: found 3; accepted: a table of settings"),
        ([1], "here: found [1]; accepted: a table of settings"),
        (None, "here: found None; accepted: a table of settings"),
        ({"seed": 1.5}, "here: seed: found 1.5; accepted: a whole number from 0 to 4294967295"),
        ({"seed": True}, "here: seed: found True; accepted: a whole number from 0 to 4294967295"),
        ({"ppo": {"clip_range": True}}, "here: ppo.clip_range: found True; accepted: a number above 0"),
        ({"ppo": {"clip_range": "1"}}, "here: ppo.clip_range: found '1'; accepted: a number above 0"),
        ({"ppo": {"clip_value": 1}}, "here: ppo.clip_value: found 1; accepted: true or false"),
        (
            {"ppo": {"actor_layers": 256}},
            "here: ppo.actor_layers: found 256; accepted: a list of: a whole number from 1",
        ),
        (
            {"ppo": {"actor_layers": [256, "x"]}},
            "here: ppo.actor_layers: found 'x'; accepted: a whole number from 1",
        ),
        (
            {"ppo": {"schedule": "cosine"}},
            "here: ppo.schedule: found 'cosine'; accepted: adaptive, adaptive_iteration, fixed, trapezoid",
        ),
        ({"unlearn": {"targets": "punch"}}, "here: unlearn.targets: found 'punch'; accepted: a list of: text"),
        ({"library": 5}, "here: library: found 5; accepted: text"),
        (
            {"unlearn": {"settings": {"penalty": "high"}}},
            "here: unlearn.settings: found {'penalty': 'high'}; accepted: a table of: a number",
        ),
        (
            {"noise": {"push_interval": [1.0]}},
            "here: noise.push_interval: found [1.0]; accepted: a list of 2: a number from 0",
        ),
        ({"action": {"mode": "absolute"}}, "here: action.mode: found 'absolute'; accepted: residual, offset"),
        (
            {"action": {"scale": {"left_knee_joint": -1}}},
            "here: action.scale: found {'left_knee_joint': -1}; accepted: a table of: a number above 0",
        ),
        ({"action": {"damping": 3}}, "here: action.damping: found 3; accepted: a table of: a number from 0"),
    ],
)
def test_a_bad_setting_is_refused_with_its_place_and_what_is_accepted(content, message):
    with pytest.raises(InputError) as caught:
        from_dict(Config, content, "here")
    assert str(caught.value).startswith(message)


def test_a_missing_file_is_refused(path):
    with pytest.raises(InputError, match=r"config\.yaml: no such config"):
        load_config(path)


@pytest.mark.parametrize("content", [b"ppo: [1\n", b"ppo: \xff\n"])
def test_a_file_that_is_no_yaml_is_refused_in_one_line(path, content):
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"config\.yaml: not YAML") as caught:
        load_config(path)
    assert "\n" not in str(caught.value)


def test_an_empty_file_is_refused(path):
    path.write_text("")
    with pytest.raises(InputError, match="accepted: a table of settings"):
        load_config(path)


def test_the_file_is_plain_yaml(path):
    save_config(Config(), path)
    content = yaml.safe_load(path.read_text())
    assert content["ppo"]["actor_layers"] == [1024, 512, 256, 128]
    assert content["library"] is None


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (changed(epochs=0), "ppo.epochs: found 0; accepted: a whole number from 1"),
        (changed(learning_rate=0.0), "ppo.learning_rate: found 0.0; accepted: a number above 0"),
        (changed(learning_rate=float("nan")), "ppo.learning_rate: found nan; accepted: a number above 0"),
        (changed(discount=1.01), "ppo.discount: found 1.01; accepted: a number from 0 to 1"),
        (changed(entropy_cost=-1.0), "ppo.entropy_cost: found -1.0; accepted: a number from 0"),
        (changed(actor_layers=(8, 0)), "ppo.actor_layers: found 0; accepted: a whole number from 1"),
        (changed(num_envs=1, num_steps=2, minibatches=3), "ppo.minibatches: found 3; accepted: 1 to"),
        (changed(num_envs=6, branches=4), "ppo.branches: found 4; accepted: a divisor of num_envs = 6"),
        (
            dataclasses.replace(Config(), sampling=dataclasses.replace(Config().sampling, target_share=0.5)),
            "sampling.target_share: found 0.5 with no targets; accepted: 0, or a share where",
        ),
        (
            dataclasses.replace(
                Config(),
                sampling=dataclasses.replace(Config().sampling, target_share=0.5, clips="kept"),
                unlearn=UnlearnConfig(targets=("kick",)),
            ),
            "sampling.target_share: found 0.5 with sampling.clips = kept; accepted: 0, or a share where",
        ),
        (
            dataclasses.replace(Config(), termination=TerminationConfig(contact_force=2000.0)),
            "termination.contact_force: found 2000.0; accepted: 0 to 100 body weights",
        ),
        (dataclasses.replace(Config(), seed=-1), "seed: found -1; accepted: a whole number from 0 to 4294967295"),
        (
            dataclasses.replace(Config(), evaluate_every=-1),
            "evaluate_every: found -1; accepted: a whole number from 0",
        ),
        (
            dataclasses.replace(Config(), reward=dataclasses.replace(Config().reward, survival=float("inf"))),
            "reward.survival: found inf; accepted: a finite number",
        ),
        (
            dataclasses.replace(Config(), reward=dataclasses.replace(Config().reward, foot_slip=-0.1)),
            "reward.foot_slip: found -0.1; accepted: 0 (this term is not computed)",
        ),
        (
            dataclasses.replace(Config(), noise=dataclasses.replace(Config().noise, push_interval=(1.0,))),
            "noise.push_interval: found [1.0]; accepted: a list of 2: a number from 0",
        ),
    ],
)
def test_a_number_that_no_run_can_work_with_is_refused(config, message):
    with pytest.raises(InputError) as caught:
        validate(config)
    assert str(caught.value).startswith(message)
