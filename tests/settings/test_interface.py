"""What a run takes from the policy that it continues from, and where two policies differ."""

import dataclasses

import pytest

from forgetmimic_jax.settings.config import ActionConfig, ObservationConfig, preset
from forgetmimic_jax.settings.interface import differences, with_interface


@pytest.fixture
def base():
    config = preset("paper")
    return dataclasses.replace(
        config,
        observation=ObservationConfig("mjlab160"),
        action=ActionConfig(mode="offset", scale={"left_knee_joint": 0.3}),
        physics=dataclasses.replace(config.physics, self_collision=True, substeps=2),
    )


def test_a_policy_brings_its_observations_its_actions_and_self_collision_and_no_other_setting(base):
    ours = preset("cpu")
    found = with_interface(ours, base)
    assert (found.observation, found.action) == (base.observation, base.action)
    assert found.physics == dataclasses.replace(ours.physics, self_collision=True)
    assert dataclasses.replace(found, observation=ours.observation, action=ours.action, physics=ours.physics) == ours


def test_another_robot_s_policy_brings_no_table_of_joints(base):
    found = with_interface(dataclasses.replace(preset("cpu"), robot="h2"), base)
    assert found.action == ActionConfig(mode="offset")
    assert found.physics.self_collision


def test_two_policies_differ_by_the_settings_of_their_interface_alone(base):
    ours = dataclasses.replace(preset("paper"), seed=3)
    assert sorted(differences(base, ours)) == [
        ("action.mode", "offset", "residual"),
        ("action.scale.left_knee_joint", 0.3, None),
        ("observation.layout", "mjlab160", "wbc132"),
        ("physics.self_collision", True, False),
    ]
