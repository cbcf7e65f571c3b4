"""The G1's policy on the H2: the same action for the same joints, whatever the order they stand in."""

import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.library import DATA_DIR
from forgetmimic_jax.policy.policy import init_policy
from forgetmimic_jax.robot.model import load_robot
from forgetmimic_jax.settings.config import preset
from forgetmimic_jax.tracking.layouts import LAYOUTS
from forgetmimic_jax.training.carried_over import REMEMBERED, carried_over, policy_for
from forgetmimic_jax.training.checkpoint import read_info

LAYOUT = LAYOUTS["wbc132"]
PRIVATE = 7  # what the critic alone sees, here
TINY = preset("cpu")
TINY = dataclasses.replace(TINY, ppo=dataclasses.replace(TINY.ppo, actor_layers=(8, 8), critic_layers=(8,)))


@pytest.fixture(scope="module")
def h2():
    return load_robot("h2")


@pytest.fixture(scope="module")
def theirs(robot):
    """A policy of the G1 that has seen something: no mean is 0, no variance 1, no noise like another."""
    size = LAYOUT.size(robot.num_joints)
    policy = init_policy(TINY.ppo, robot.num_joints, size, size + PRIVATE, jax.random.PRNGKey(1))
    policy = jax.tree.map(lambda x: x + 0.1 * jax.random.normal(jax.random.PRNGKey(x.size), x.shape), policy)

    def seen(normalizer):
        sizes = normalizer.mean.shape
        return dataclasses.replace(
            normalizer, variance=0.5 + jax.random.uniform(jax.random.PRNGKey(2), sizes), count=jnp.float32(3e7)
        )

    normalizers = {name: seen(getattr(policy, name)) for name in ("actor_normalizer", "critic_normalizer")}
    return dataclasses.replace(policy, **normalizers)


@pytest.fixture(scope="module")
def carried(robot, h2, theirs):
    size = LAYOUT.size(h2.num_joints)
    fresh = init_policy(TINY.ppo, h2.num_joints, size, size + PRIVATE, jax.random.PRNGKey(0))
    return carried_over(theirs, LAYOUT, robot, h2, fresh)


def parts(observation, num_joints):
    return {name: observation[..., place] for name, place in LAYOUT.places(num_joints).items()}


def same_scene(robot, h2, observation, head):
    """What the H2 sees where the G1 sees `observation` [n, 132]: its joints by name, `head` [n, 2] at the others."""
    g1, default = parts(observation, robot.num_joints), dict(zip(robot.joint_names, np.asarray(
        robot.arrays.default_joint_pos), strict=True))  # fmt: skip
    others = dict(zip(h2.joint_names, np.asarray(h2.arrays.default_joint_pos), strict=True))
    seen = []
    for name, values in g1.items():
        if values.shape[1] != robot.num_joints:
            seen.append(values * (1.03 / 0.793 if name == "ref_base_height" else 1.0))
            continue
        columns = []
        for place, joint in enumerate(h2.joint_names):
            if joint not in robot.joint_names:
                columns.append(head[:, place - 15])
                continue
            column = values[:, robot.joint_names.index(joint)]
            columns.append(column + default[joint] - others[joint] if name == "joint_pos" else column)
        seen.append(np.stack(columns, axis=1))
    return np.concatenate(seen, axis=1)


@pytest.fixture(scope="module")
def scenes(robot, h2):
    """An observation of the G1 at its mean height, and the same of the H2, with the head at rest."""
    observation = np.random.default_rng(0).normal(size=(5, LAYOUT.size(robot.num_joints)))
    observation[:, 0] = 0.0  # the height scales; its spread is the source's
    return observation, same_scene(robot, h2, observation, np.zeros((5, 2)))


def at_no_height(policy):
    """Heights are 0 in the scenes, and so is here the mean of them, which differs between the robots."""
    normalizer = policy.actor_normalizer
    level = dataclasses.replace(normalizer, mean=normalizer.mean.at[0].set(0.0))
    return dataclasses.replace(policy, actor_normalizer=level)


def test_a_joint_does_what_it_did_and_a_new_one_follows_the_reference(robot, h2, theirs, carried, scenes):
    before, after = (
        np.asarray(at_no_height(policy).mean_action(jnp.asarray(seen)))
        for policy, seen in zip((theirs, carried), scenes, strict=True)
    )
    for place, joint in enumerate(h2.joint_names):
        expected = before[:, robot.joint_names.index(joint)] if joint in robot.joint_names else np.zeros(5)
        np.testing.assert_allclose(after[:, place], expected, atol=1e-5, err_msg=joint)
    assert [h2.joint_names[place] for place in np.flatnonzero(~after.any(0))] == ["head_pitch_joint", "head_yaw_joint"]


def test_the_head_is_not_heard(h2, robot, carried, scenes):
    observation, seen = scenes
    other = same_scene(robot, h2, observation, np.full((5, 2), 0.4))
    assert np.abs(other - seen).max() == pytest.approx(0.4)
    actions = [np.asarray(carried.mean_action(jnp.asarray(each))) for each in (seen, other)]
    np.testing.assert_array_equal(*actions)


def test_the_mean_height_grows_with_the_robot_and_the_statistics_count_for_less(theirs, carried):
    ratio = float(carried.actor_normalizer.mean[0] / theirs.actor_normalizer.mean[0])
    assert ratio == pytest.approx(1.03 / 0.793, rel=1e-5)
    assert float(carried.actor_normalizer.count) == float(carried.critic_normalizer.count) == REMEMBERED


def test_the_critic_values_what_it_sees_as_before(theirs, carried, scenes):
    private = np.random.default_rng(1).normal(size=(5, PRIVATE))
    values = []
    for policy, observation in zip((theirs, carried), scenes, strict=True):
        normalizer = policy.critic_normalizer
        level = dataclasses.replace(normalizer, mean=normalizer.mean.at[0].set(0.0))
        seen = jnp.asarray(np.concatenate([observation, private], axis=1))
        values.append(np.asarray(dataclasses.replace(policy, critic_normalizer=level).value(seen)))
    np.testing.assert_allclose(values[1], values[0], atol=1e-4)
    assert np.ptp(values[0]) > 0.1


def test_what_it_explores_goes_with_the_joint(robot, h2, theirs, carried):
    before, after = (np.asarray(policy.actor["params"]["log_std"]) for policy in (theirs, carried))
    for place, joint in enumerate(h2.joint_names):
        expected = before[robot.joint_names.index(joint)] if joint in robot.joint_names else before.mean()
        assert after[place] == pytest.approx(expected), joint


def test_a_joint_that_only_the_source_has_is_left_out(robot, h2, theirs, carried):
    size = LAYOUT.size(robot.num_joints)
    fresh = init_policy(TINY.ppo, robot.num_joints, size, size + PRIVATE, jax.random.PRNGKey(0))
    back = carried_over(carried, LAYOUT, h2, robot, fresh)
    for there, here in zip(jax.tree.leaves((theirs.actor, theirs.critic)), jax.tree.leaves((back.actor, back.critic)),
                           strict=True):  # fmt: skip
        np.testing.assert_array_equal(here, there)
    np.testing.assert_allclose(back.actor_normalizer.mean, theirs.actor_normalizer.mean, rtol=1e-5, atol=1e-6)


def test_a_checkpoint_of_a_robot_that_has_changed_since_is_told(h2, tmp_path):
    folder = tmp_path / "base"
    shutil.copytree(DATA_DIR / "g1" / "base", folder)
    meta = json.loads((folder / "meta.json").read_text())
    (folder / "meta.json").write_text(json.dumps({**meta, "joints": meta["joints"][::-1]}))
    with pytest.raises(InputError, match="base: joints: not those of robots/g1 today"):
        policy_for(h2, read_info(folder))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"key_bodies": ("pelvis", "torso_link")}, r"key_bodies: 'g1' has 14; 2 are needed, as 'h2' has"),
        ({"joint_names": ("tail_joint",)}, "joints: 'g1' has none that is called as one of 'h2'"),
    ],
)
def test_a_robot_that_nothing_can_be_had_from_is_told(h2, change, message):
    with pytest.raises(InputError, match=f"base: {message}"):
        policy_for(dataclasses.replace(h2, **change), read_info(DATA_DIR / "g1" / "base"))
