"""The G1's policy on the H2: the same action for the same joints, whatever the order they stand in."""

import dataclasses
import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from orders import isaac_order

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.motion.library import DATA_DIR
from forgetmimic_jax.policy.policy import init_policy
from forgetmimic_jax.robot.model import load_robot
from forgetmimic_jax.settings.config import ActionConfig, ObservationConfig, preset
from forgetmimic_jax.tracking.layouts import LAYOUTS
from forgetmimic_jax.training.carried_over import REMEMBERED, carried_over, policy_for
from forgetmimic_jax.training.checkpoint import read_info

PRIVATE = 7  # what the critic alone sees, here
TINY = preset("cpu")
TINY = dataclasses.replace(TINY, ppo=dataclasses.replace(TINY.ppo, actor_layers=(8, 8), critic_layers=(8,)))
# Layout, action mode, and whether the policy of the G1 has Isaac Lab's order of joints.
CASES = {
    "wbc132": ("wbc132", "residual", False),
    "root132": ("root132", "residual", False),
    "mjlab154": ("mjlab154", "offset", False),
    "mjlab160 of Isaac Lab": ("mjlab160", "offset", True),
}


@pytest.fixture(scope="module", params=CASES.values(), ids=CASES)
def config(request, robot):
    layout, mode, isaac = request.param
    order = isaac_order(robot) if isaac else ()
    return dataclasses.replace(TINY, observation=ObservationConfig(layout), action=ActionConfig(mode, order))


@pytest.fixture(scope="module")
def layout(config):
    return LAYOUTS[config.observation.layout]


@pytest.fixture(scope="module")
def g1(config):
    """The G1 in its policy's order of joints."""
    return load_robot("g1", action=config.action)


@pytest.fixture(scope="module")
def h2():
    return load_robot("h2")


@pytest.fixture(scope="module")
def theirs(g1, layout):
    """A policy of the G1 that has seen something: no mean is 0, no variance 1, no noise like another."""
    size = layout.size(g1.num_joints)
    policy = init_policy(TINY.ppo, g1.num_joints, size, size + PRIVATE, jax.random.PRNGKey(1))
    policy = jax.tree.map(lambda x: x + 0.1 * jax.random.normal(jax.random.PRNGKey(x.size), x.shape), policy)

    def seen(normalizer):
        sizes = normalizer.mean.shape
        return dataclasses.replace(
            normalizer, variance=0.5 + jax.random.uniform(jax.random.PRNGKey(2), sizes), count=jnp.float32(3e7)
        )

    normalizers = {name: seen(getattr(policy, name)) for name in ("actor_normalizer", "critic_normalizer")}
    return dataclasses.replace(policy, **normalizers)


@pytest.fixture(scope="module")
def carried(g1, h2, theirs, config, layout):
    size = layout.size(h2.num_joints)
    fresh = init_policy(TINY.ppo, h2.num_joints, size, size + PRIVATE, jax.random.PRNGKey(0))
    return carried_over(theirs, config, g1, h2, fresh)


def by_joint(robot, field):
    """Constants of a robot, by the names of its joints."""
    return dict(zip(robot.joint_names, np.asarray(getattr(robot.arrays, field), np.float64), strict=True))


def action_there(g1, h2, mode, joint, action):
    """What the G1's action of a joint is for the H2: the same, or the one of the same joint target."""
    if mode == "residual":
        return action
    pose, scale, other_pose, other_scale = (
        by_joint(of, field)[joint] for of in (g1, h2) for field in ("default_joint_pos", "action_scale")
    )
    return (pose + scale * action - other_pose) / other_scale


def same_scene(g1, h2, config, observation, head):
    """What the H2 sees where the G1 sees `observation` [n, features]: its joints by name, `head` [n, 2] the others."""
    layout, order = LAYOUTS[config.observation.layout], config.action.joint_order or g1.joint_names
    pose, other_pose = (by_joint(of, "default_joint_pos") for of in (g1, h2))
    seen = []
    for term, place in layout.places(29).items():
        values = observation[:, place]
        if values.shape[1] % 29:
            seen.append(values * (1.03 / 0.793 if term.endswith("_height") else 1.0))
            continue
        for part in np.split(values, values.shape[1] // 29, axis=1):  # reference angles, then reference velocities
            for other, joint in enumerate(h2.joint_names):
                if joint not in order:
                    seen.append(head[:, [other - 15]])
                    continue
                column = part[:, [order.index(joint)]]
                if term == "joint_pos":
                    column = column + pose[joint] - other_pose[joint]
                if term == "actions":
                    column = action_there(g1, h2, config.action.mode, joint, column)
                seen.append(column)
    return np.concatenate(seen, axis=1)


@pytest.fixture(scope="module")
def scenes(g1, h2, config, layout):
    """An observation of the G1 at its mean height, and the same of the H2, with the head at rest."""
    observation = np.random.default_rng(0).normal(size=(5, layout.size(29)))
    observation[:, heights(layout)] = 0.0  # the height scales; its spread is the source's
    return observation, same_scene(g1, h2, config, observation, np.zeros((5, 2)))


def heights(layout):
    """Where a layout has a height above the floor: in the first place, or nowhere."""
    return [0] if next(iter(layout.sensor_noise)).endswith("_height") else []


def level(normalizer, layout):
    """Heights are 0 in the scenes, and so is here the mean of them, which differs between the robots."""
    return dataclasses.replace(normalizer, mean=normalizer.mean.at[np.array(heights(layout), int)].set(0.0))


def at_no_height(policy, layout):
    return dataclasses.replace(policy, actor_normalizer=level(policy.actor_normalizer, layout))


def test_a_joint_does_what_it_did_and_a_new_one_starts_at_action_0(g1, h2, theirs, carried, scenes, config, layout):
    before, after = (
        np.asarray(at_no_height(policy, layout).mean_action(jnp.asarray(seen)))
        for policy, seen in zip((theirs, carried), scenes, strict=True)
    )
    order = config.action.joint_order or g1.joint_names
    for place, joint in enumerate(h2.joint_names):
        expected = np.zeros(5)
        if joint in order:
            expected = action_there(g1, h2, config.action.mode, joint, before[:, order.index(joint)])
        np.testing.assert_allclose(after[:, place], expected, atol=1e-4, err_msg=joint)
    assert [h2.joint_names[place] for place in np.flatnonzero(~after.any(0))] == ["head_pitch_joint", "head_yaw_joint"]


def test_the_head_is_not_heard(h2, g1, carried, scenes, config):
    observation, seen = scenes
    other = same_scene(g1, h2, config, observation, np.full((5, 2), 0.4))
    assert np.abs(other - seen).max() == pytest.approx(0.4)
    actions = [np.asarray(carried.mean_action(jnp.asarray(each))) for each in (seen, other)]
    np.testing.assert_array_equal(*actions)


def test_the_mean_height_grows_with_the_robot_and_the_statistics_count_for_less(theirs, carried, layout):
    for place in heights(layout):
        ratio = float(carried.actor_normalizer.mean[place] / theirs.actor_normalizer.mean[place])
        assert ratio == pytest.approx(1.03 / 0.793, rel=1e-5)
    assert float(carried.actor_normalizer.count) == float(carried.critic_normalizer.count) == REMEMBERED


def test_the_critic_values_what_it_sees_as_before(theirs, carried, scenes, layout):
    private = np.random.default_rng(1).normal(size=(5, PRIVATE))
    values = []
    for policy, observation in zip((theirs, carried), scenes, strict=True):
        seen = jnp.asarray(np.concatenate([observation, private], axis=1))
        normalizer = level(policy.critic_normalizer, layout)
        values.append(np.asarray(dataclasses.replace(policy, critic_normalizer=normalizer).value(seen)))
    np.testing.assert_allclose(values[1], values[0], atol=1e-4)
    assert np.ptp(values[0]) > 0.1


def test_what_it_explores_goes_with_the_joint(g1, h2, theirs, carried, config):
    """In units of action; of an action on the default pose, in rad."""
    before, after = (np.asarray(policy.actor["params"]["log_std"]) for policy in (theirs, carried))
    order, scales = config.action.joint_order or g1.joint_names, [by_joint(of, "action_scale") for of in (g1, h2)]
    for place, joint in enumerate(h2.joint_names):
        expected = before[order.index(joint)] if joint in order else before.mean()
        if config.action.mode == "offset" and joint in order:
            expected += np.log(scales[0][joint] / scales[1][joint])
        assert after[place] == pytest.approx(expected, abs=1e-6), joint


def test_a_joint_that_only_the_source_has_is_left_out(g1, h2, theirs, carried, config, layout):
    size = layout.size(g1.num_joints)
    fresh = init_policy(TINY.ppo, g1.num_joints, size, size + PRIVATE, jax.random.PRNGKey(0))
    back = carried_over(carried, config, h2, g1, fresh)
    for there, here in zip(jax.tree.leaves((theirs.actor, theirs.critic)), jax.tree.leaves((back.actor, back.critic)),
                           strict=True):  # fmt: skip
        np.testing.assert_allclose(here, there, atol=0.0 if config.action.mode == "residual" else 1e-6)
    np.testing.assert_allclose(back.actor_normalizer.mean, theirs.actor_normalizer.mean, rtol=1e-5, atol=1e-6)


def test_a_checkpoint_of_a_robot_that_has_changed_since_is_refused(h2, tmp_path):
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
        (
            {"joint_names": ("tail_joint",), "policy_joints": np.array([0])},
            "joints: 'g1' has none that is called as one of 'h2'",
        ),
    ],
)
def test_a_robot_that_nothing_can_be_had_from_is_refused(h2, change, message):
    with pytest.raises(InputError, match=f"base: {message}"):
        policy_for(dataclasses.replace(h2, **change), read_info(DATA_DIR / "g1" / "base"))
