"""Rollouts and trainings of the attacks in the simulation, in miniature."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from trees import assert_same

from forgetmimic_jax.attacks.fine_tuning import FineTuning, attack_config, shares
from forgetmimic_jax.attacks.rollouts import Stage
from forgetmimic_jax.evaluation.metrics import episode_metrics
from forgetmimic_jax.evaluation.rollout import Evaluator
from forgetmimic_jax.policy.policy import init_policy
from forgetmimic_jax.tracking.layouts import find_layout
from forgetmimic_jax.tracking.observation import critic_size


@pytest.fixture(scope="module")
def policy(small_setup):
    layout, robot = find_layout(small_setup.config.observation.layout), small_setup.robot
    sizes = layout.size(robot.num_joints), critic_size(layout, robot)
    return init_policy(small_setup.config.ppo, robot.num_joints, *sizes, jax.random.PRNGKey(0))


def test_tracking_is_that_of_an_evaluation_and_falls_do_not_end_the_recording(small_setup, clips, policy):
    stage = Stage(small_setup, list(clips.values()), episodes=2, seed=3)
    found = stage.perform({"policy": policy, "zero_action": None})
    evaluator = Evaluator(small_setup, episodes=2, seed=3)
    for name, of in (("policy", policy), ("zero_action", None)):
        expected = evaluator.rollout(of)
        np.testing.assert_array_equal(found.length[name], expected.length)
        np.testing.assert_array_equal(found.start_frame, expected.start_frame)
        np.testing.assert_allclose(
            found.tracked(name), episode_metrics(expected)["survival_weighted_tracking"], rtol=1e-5
        )
    fell = found.length["zero_action"] < found.horizon
    assert fell.any()
    # Past its fall the robot lies on the floor, farther from the reference than before, and that is recorded.
    steps = np.arange(found.movement.shape[1])
    length, deviation = found.length["zero_action"][:, None], found.deviation["zero_action"]
    before, after = steps < length, (steps >= length) & (steps < found.horizon[:, None])
    assert deviation[after].mean() > 2.0 * deviation[before].mean()
    assert deviation[before].min() > 0.0


def test_a_stand_has_no_motion_content_and_the_reference_has_all_of_it(small_setup, clips, policy):
    """The clips are the default pose that sways by 0.05 rad: nearly a stand, so no motion content is defined."""
    found = Stage(small_setup, [clips["sway"]], episodes=1, seed=0, from_start=True).perform({"policy": policy})
    assert found.movement.max() < 0.05**2
    assert np.isnan(found.content("policy")).all()
    assert found.start_frame.tolist() == [0]


def test_a_fine_tuning_starts_where_it_should_and_leaves_its_start_alone(small_setup, clips, policy):
    training = FineTuning(small_setup, list(clips.values()))
    before, seen = jax.tree.map(jnp.copy, policy), []

    def after(done, learned, steps):
        seen.append((done, steps))
        return done == 2

    learned = training.train(policy, shares([], ["sway", "nod"]), iterations=9, seed=0, after=after)
    assert [done for done, _ in seen] == [1, 2]
    assert all(steps["turn"] == 0 for _, steps in seen)
    assert sum(seen[0][1].values()) == 8 * 12  # environments and steps of an iteration
    assert_same(policy, before)
    assert not jnp.array_equal(learned.log_std, policy.log_std)
    again = training.train(policy, shares(["turn"], ["sway"]), iterations=1, seed=0, after=after)
    assert seen[-1][1]["nod"] == 0
    assert seen[-1][1]["turn"] > 0
    assert not jnp.array_equal(again.log_std, learned.log_std)


def test_an_attack_trains_without_anything_that_holds_it_back(small_setup):
    sampling = dataclasses.replace(small_setup.config.sampling, first_frame=0.5)
    config = attack_config(dataclasses.replace(small_setup.config, sampling=sampling))
    assert config.sampling.first_frame == 0.0
    assert config.ppo.base_kl == 0.0
    assert config.ppo.schedule == "fixed"
    assert config.wrench.max_gain == 0.0
    assert config.unlearn.targets == ()
    assert config.sampling.clips == "all"
    assert config.ppo.num_envs == small_setup.config.ppo.num_envs


def test_half_of_the_starts_are_the_targets():
    assert shares(["a", "b"], ["c"]) == {"a": 0.25, "b": 0.25, "c": 0.5}
    assert shares([], ["c", "d"]) == {"c": 0.5, "d": 0.5}
