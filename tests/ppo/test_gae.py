import jax.numpy as jnp
import numpy as np
import pytest

from forgetmimic_jax.ppo.gae import centre_branches, generalized_advantages


def by_loops(reward, value, next_value, terminated, truncated, discount, gae_lambda) -> np.ndarray:
    """Equation 16 of Schulman et al. as a sum: Σ_l (γλ)^l δ_{t+l} up to the episode's or the rollout's end."""
    steps, envs = reward.shape
    advantage = np.zeros((steps, envs))
    for env in range(envs):
        for begin in range(steps):
            weight = 1.0
            for step in range(begin, steps):
                bootstrap = 0.0 if terminated[step, env] else next_value[step, env]
                advantage[begin, env] += weight * (reward[step, env] + discount * bootstrap - value[step, env])
                if terminated[step, env] or truncated[step, env]:
                    break
                weight *= discount * gae_lambda
    return advantage


def advantages(*arrays, discount=0.99, gae_lambda=0.95):
    return [np.asarray(x) for x in generalized_advantages(*map(jnp.asarray, arrays), discount, gae_lambda)]


def column(*values, dtype=np.float32) -> np.ndarray:
    return np.array(values, dtype)[:, None]


def flags(*values) -> np.ndarray:
    return column(*values, dtype=bool)


def test_two_steps_by_hand():
    advantage, target = advantages(
        column(1.0, 2.0), column(0.5, 1.0), column(1.0, 3.0), flags(0, 0), flags(0, 0), discount=0.5, gae_lambda=0.5
    )
    # δ = (1 + 0.5·1 − 0.5, 2 + 0.5·3 − 1) = (1, 2.5); A_0 = 1 + 0.25·2.5
    np.testing.assert_allclose(advantage, column(1.625, 2.5))
    np.testing.assert_allclose(target, column(2.125, 3.5))


def test_a_termination_has_no_future():
    advantage, _ = advantages(column(1.0, 5.0), column(0.5, 9.0), column(100.0, 7.0), flags(1, 0), flags(0, 0))
    np.testing.assert_allclose(advantage[0], 1.0 - 0.5)


def test_a_truncation_keeps_the_value_of_its_last_state_and_nothing_of_the_next_episode():
    rest = [column(0.5, 9.0), column(4.0, 7.0), flags(0, 0), flags(1, 0)]
    advantage, _ = advantages(column(1.0, 5.0), *rest)
    np.testing.assert_allclose(advantage[0], 1.0 + 0.99 * 4.0 - 0.5)
    other_future, _ = advantages(column(1.0, -500.0), *rest)
    np.testing.assert_allclose(other_future[0], advantage[0])


def test_the_rollouts_end_is_bootstrapped():
    advantage, _ = advantages(column(1.0), column(0.5), column(2.0), flags(0), flags(0))
    np.testing.assert_allclose(advantage[0], 1.0 + 0.99 * 2.0 - 0.5)


def test_not_a_number_after_a_termination_reaches_nothing():
    advantage, target = advantages(column(1.0, 1.0), column(0.5, 0.5), column(np.nan, 1.0), flags(1, 0), flags(0, 0))
    assert np.isfinite(advantage).all()
    assert np.isfinite(target).all()


@pytest.mark.parametrize("seed", range(5))
def test_advantages_equal_the_sum_over_each_episode(seed):
    rng = np.random.default_rng(seed)
    shape = (24, 6)
    reward, value, next_value = (rng.standard_normal(shape).astype(np.float32) for _ in range(3))
    ending = rng.random(shape)
    terminated, truncated = ending < 0.1, (ending >= 0.1) & (ending < 0.2)
    advantage, target = advantages(reward, value, next_value, terminated, truncated)
    expected = by_loops(reward, value, next_value, terminated, truncated, 0.99, 0.95)
    np.testing.assert_allclose(advantage, expected, atol=1e-5)
    np.testing.assert_allclose(target, expected + value, atol=1e-5)


def test_branches_are_measured_against_each_other():
    advantage = jnp.array([[1.0, 4.0, 10.0, 0.0]])
    centred = centre_branches(advantage, jnp.zeros((1, 4), bool), 2)
    np.testing.assert_allclose(centred, [[-3.0, 3.0, 10.0, -10.0]])
    centred = centre_branches(advantage, jnp.zeros((1, 4), bool), 4)
    np.testing.assert_allclose(centred, [[1 - 14 / 3, 4 - 11 / 3, 10 - 5 / 3, 0 - 5]], rtol=1e-6)


def test_a_branch_whose_episode_ended_is_left_alone():
    advantage = jnp.array([[1.0, 4.0, 7.0], [1.0, 4.0, 7.0], [1.0, 4.0, 7.0]])
    done = jnp.array([[False, True, False], [False, False, False], [True, False, False]])
    expected = [[1 - 5.5, 4 - 4.0, 7 - 2.5], [1 - 7.0, 4.0, 7 - 1.0], [1 - 7.0, 4.0, 7 - 1.0]]
    np.testing.assert_allclose(centre_branches(advantage, done, 3), expected)


def test_what_the_critic_gets_wrong_of_a_shared_state_cancels():
    rng = np.random.default_rng(0)
    advantage, error = rng.standard_normal((3, 8)), np.repeat(rng.standard_normal((3, 2)), 4, axis=1)
    done = jnp.zeros((3, 8), bool)
    np.testing.assert_allclose(
        centre_branches(jnp.asarray(advantage + error), done, 4),
        centre_branches(jnp.asarray(advantage), done, 4),
        atol=1e-5,
    )
