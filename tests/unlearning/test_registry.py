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
    *("gradient_ascent", "policy_edit", "distill", "stand"),
}


def test_every_module_with_a_method_is_one():
    assert methods().keys() == NAMES
    assert all(isinstance(method, Method) for method in methods().values())


def test_an_unknown_method_is_refused():
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
        "arft": {"reward", "settings", "stop_every"},
        "retrain": {"clips", "start", "result", "pace"},
        "distill": {"clips", "start", "pace"},
        "finetune": {"clips", "result"},
        "random_reward": {"reward", "stop_every"},
        "negated_reward": {"reward", "stop_every"},
        "gradient_ascent": {"loss", "stop_every"},
        "decremental": {"loss"},
        "poisoning": {"observation"},
        "trajdeleter": {"reward", "loss"},
        "policy_edit": {"loss", "simulate"},
        "stand": {"loss", "teach", "runs_on", "settings", "pace", "instead"},
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


def test_only_retraining_starts_at_first_frames_as_the_base_did():
    base = dataclasses.replace(Config(), sampling=dataclasses.replace(Config().sampling, first_frame=0.3))
    for method, share in {"retrain": 0.3, "arft": 0.0, "distill": 0.0}.items():
        assert unlearning_config(base, UnlearnConfig(("punch",), method)).sampling.first_frame == share


def test_what_is_taught_instead_is_the_stand_unless_a_clip_is_named():
    def instead(name: str, given: str | None = None) -> str | None:
        return unlearning_config(Config(), UnlearnConfig(("punch",), name, instead=given)).unlearn.instead

    assert (instead("stand"), instead("stand", "walk"), instead("arft")) == ("stand", "walk", None)
    message = "unlearn.instead: found walk; accepted: nothing, since arft teaches nothing in the place of the targets"
    with pytest.raises(InputError, match=f"^{message}$"):
        instead("arft", "walk")


@pytest.mark.parametrize("name", sorted(NAMES))
def test_a_stop_rule_is_for_the_methods_whose_reward_pushes_the_targets_down(name):
    unlearn = UnlearnConfig(("punch",), name, stop_every=20)
    if name in ("arft", "random_reward", "negated_reward", "gradient_ascent"):
        assert unlearning_config(Config(), unlearn).unlearn.stop_every == 20
        return
    message = rf"^unlearn\.stop_every: found 20; accepted: 0, since {name} has no stop rule$"
    with pytest.raises(InputError, match=message):
        unlearning_config(Config(), unlearn)


def test_a_method_carries_its_own_settings():
    found = unlearning_config(Config(), UnlearnConfig(("punch",)))
    assert found.unlearn.settings == {"penalty": 16.0}
    with pytest.raises(InputError, match=r"unlearn\.settings: retrain has no setting .penalty.; known: none"):
        unlearning_config(Config(), UnlearnConfig(("punch",), "retrain", {"penalty": 4.0}))
