import dataclasses

import jax
import jax.numpy as jnp
import pytest

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.settings.config import Config, UnlearnConfig, preset, to_dict
from forgetmimic_jax.tracking.reward import Reward
from forgetmimic_jax.unlearning.method import Method
from forgetmimic_jax.unlearning.registry import find_method, method_of, methods, unlearning_config

NAMES = {
    *("arft", "retrain", "finetune", "random_reward", "decremental", "poisoning", "trajdeleter", "negated_reward"),
    *("gradient_ascent", "policy_edit", "distill"),
}


def test_every_module_with_a_method_is_one():
    assert methods().keys() == NAMES
    assert all(isinstance(method, Method) for method in methods().values())


def test_an_unknown_method_is_told():
    with pytest.raises(InputError, match=r"unlearn\.method: no method 'retrian'; did you mean 'retrain'\?"):
        find_method("retrian")


def test_without_targets_training_is_plain():
    config = dataclasses.replace(Config(), unlearn=UnlearnConfig((), method="negated_reward"))
    assert method_of(config) == Method()
    reward = Reward(*(jnp.full(1, value) for value in (6.0, 0.4, 0.75)), terms={})
    assert method_of(config).reward(config, reward, jnp.array([True]), jax.random.PRNGKey(0)) == pytest.approx(6.4)


def test_a_method_says_where_it_differs_from_ppo():
    def changes(name: str) -> set[str]:
        method = find_method(name)
        return {f.name for f in dataclasses.fields(Method) if getattr(method, f.name) != getattr(Method(), f.name)}

    assert {name: changes(name) for name in NAMES} == {
        "arft": {"reward", "settings"},
        "retrain": {"clips", "start", "result", "pace"},
        "distill": {"clips", "start", "pace"},
        "finetune": {"clips", "result"},
        "random_reward": {"reward"},
        "negated_reward": {"reward"},
        "gradient_ascent": {"loss"},
        "decremental": {"loss"},
        "poisoning": {"observation"},
        "trajdeleter": {"reward", "loss"},
        "policy_edit": {"loss", "simulate"},
    }


@pytest.mark.parametrize("base", [preset("paper"), preset("cpu")])
def test_unlearning_changes_exactly_three_things(base):
    base = dataclasses.replace(base, wrench=dataclasses.replace(base.wrench, max_gain=0.6), seed=3)
    before, after = (
        to_dict(base),
        to_dict(unlearning_config(base, UnlearnConfig(("punch", "kick"), settings={"penalty": 12.0}))),
    )
    changed = {
        (section, name): value
        for section, content in after.items()
        if isinstance(content, dict)
        for name, value in content.items()
        if value != before[section][name]
    }
    assert changed == {
        ("unlearn", "targets"): ["punch", "kick"],
        ("unlearn", "settings"): {"penalty": 12.0},
        ("sampling", "rule"): "uniform_clips",
        ("wrench", "max_gain"): 0.0,
    }
    assert [name for name in after if after[name] != before[name]] == ["sampling", "wrench", "unlearn"]


def test_retraining_is_the_base_s_own_training_without_the_targets():
    base = preset("paper")
    found = unlearning_config(base, UnlearnConfig(("punch",), method="retrain"))
    assert found == dataclasses.replace(
        base, unlearn=found.unlearn, sampling=dataclasses.replace(base.sampling, clips="kept")
    )


def test_a_method_carries_its_own_settings():
    found = unlearning_config(Config(), UnlearnConfig(("punch",)))
    assert found.unlearn.settings == {"penalty": 16.0}
    with pytest.raises(InputError, match=r"unlearn\.settings: retrain has no setting .penalty.; known: none"):
        unlearning_config(Config(), UnlearnConfig(("punch",), "retrain", {"penalty": 4.0}))
