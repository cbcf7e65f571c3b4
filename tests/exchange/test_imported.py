import dataclasses

import numpy as np
import pytest

from forgetmimic_jax.basics.errors import InputError
from forgetmimic_jax.exchange.imported import ImportedActor, check_actor, notes, with_actor, within_limit
from forgetmimic_jax.tracking.layouts import LAYOUTS

RANDOM = np.random.default_rng(0)


def array(*shape: int) -> np.ndarray:
    return RANDOM.normal(size=shape).astype(np.float32)


LAYERS = ((array(132, 16), array(16)), (array(16, 16), array(16)), (array(16, 29), array(29)))
NORMALIZED = ImportedActor(LAYERS, mean=array(132), scale=np.exp(array(132)), count=2e9, std=np.linspace(0.1, 1.0, 29))
RAW = ImportedActor(LAYERS)


def test_a_perceptron_by_hand():
    layers = ((np.array([[1.0], [2.0]]), np.array([-0.5])), (np.array([[3.0, -1.0]]), np.array([0.25, 0.0])))
    actor = ImportedActor(layers, mean=np.array([1.0, 0.0]), scale=np.array([2.0, 4.0]))
    # (3 - 1)/2 + 2 · 4/4 - 0.5 = 2.5, which ELU leaves; (1 - 1)/2 - 2 · 4/4 - 0.5 = -2.5, which becomes e^-2.5 - 1.
    expected = [[7.75, -2.5], [3.0 * (np.exp(-2.5) - 1.0) + 0.25, 1.0 - np.exp(-2.5)]]
    np.testing.assert_allclose(actor(np.array([[3.0, 4.0], [1.0, -4.0]])), expected)


@pytest.mark.parametrize("actor", [NORMALIZED, RAW])
def test_the_policy_acts_as_the_imported_actor(actor, policy, tiny_config):
    observations = array(50, 132) if actor.mean is None else actor.mean + 2.0 * actor.scale * array(50, 132)
    if actor is RAW:
        observations[:, :29] *= 20.0  # joint speeds are often beyond 10 rad/s
    made = with_actor(policy, actor, 0.4)
    expected = actor(observations)
    assert within_limit(made, observations).all()
    found = np.asarray(made.mean_action(observations))
    assert np.abs(found - expected).max() <= 1e-5 * np.abs(expected).max()


def test_the_critic_stays_and_the_statistics_count_at_most_what_ours_remember(policy):
    made = with_actor(policy, NORMALIZED, 0.4)
    assert made.critic is policy.critic
    assert float(made.actor_normalizer.count) == 1e8
    assert float(with_actor(policy, dataclasses.replace(NORMALIZED, count=500.0), 0.4).actor_normalizer.count) == 500.0


def test_noise_is_the_files_within_bounds_or_what_the_user_gave(policy):
    def noise(std) -> np.ndarray:
        made = with_actor(policy, dataclasses.replace(NORMALIZED, std=std), 0.4)
        return np.exp(np.asarray(made.actor["params"]["log_std"]))

    np.testing.assert_allclose(noise(NORMALIZED.std), NORMALIZED.std, rtol=1e-6)
    np.testing.assert_allclose(noise(None), 0.4, rtol=1e-6)
    np.testing.assert_allclose(noise(np.full(29, -1.0)), 0.05, rtol=1e-6)
    np.testing.assert_allclose(noise(np.full(29, 5.0)), 2.0, rtol=1e-6)


def test_an_observation_past_ten_standard_deviations_is_out(policy):
    made = with_actor(policy, NORMALIZED, 0.4)
    observations = np.tile(NORMALIZED.mean, (2, 1))
    observations[:, 7] += NORMALIZED.scale[7] * np.array([9.9, -10.1], np.float32)
    np.testing.assert_array_equal(within_limit(made, observations), [True, False])


def test_the_message_names_what_was_missing():
    assert [note.split(";")[0] for note in notes(RAW, 0.3)[1:]] == [
        "The file has no observation normaliser",
        "The file has no exploration noise",
    ]
    assert "standard deviation of 0.3" in notes(RAW, 0.3)[2]
    assert len(notes(NORMALIZED, 0.3)) == 1
    assert "bounds" in notes(dataclasses.replace(NORMALIZED, std=np.full(29, 3.0)), 0.3)[1]
    assert "critic starts fresh" in notes(NORMALIZED, 0.3)[0]


@pytest.mark.parametrize(
    ("actor", "message"),
    [
        (
            ImportedActor(((array(160, 8), array(8)), (array(8, 29), array(29)))),
            "observations: found 160; 132 are needed",
        ),
        (
            ImportedActor(((array(132, 8), array(8)), (array(8, 58), array(58)))),
            "actions: found 58; 29 are needed, one",
        ),
        (
            ImportedActor(((array(132, 8), array(8)), (array(9, 29), array(29)))),
            "layer 1: found weights [9, 29] (in, out",
        ),
        (
            ImportedActor(((array(132, 8), array(7)), (array(8, 29), array(29)))),
            "layer 0: found weights [132, 8] (in, ",
        ),
        (ImportedActor(((array(132, 29), array(29)),)), "found no hidden layer; one or more are needed"),
        (dataclasses.replace(NORMALIZED, mean=array(131)), "normaliser's mean: found [131] numbers; 132 are needed"),
        (dataclasses.replace(NORMALIZED, scale=array(1)), "normaliser's scale: found [1] numbers; 132 are needed"),
        (dataclasses.replace(NORMALIZED, std=array(28)), "exploration noise: found [28] numbers; 29 are needed"),
        (dataclasses.replace(NORMALIZED, mean=np.full(132, np.nan)), "found NaN or Inf among the weights; finite num"),
        (dataclasses.replace(NORMALIZED, scale=-NORMALIZED.scale), "normaliser's scale: found -"),
        (
            dataclasses.replace(NORMALIZED, scale=np.full(132, 1e-4)),
            "normaliser's scale: found 0.0001; more than 0.001",
        ),
    ],
)
def test_what_does_not_fit_is_refused(robot, tmp_path, actor, message):
    with pytest.raises(InputError) as error:
        check_actor(actor, LAYOUTS["wbc132"], robot, tmp_path)
    assert str(error.value).startswith(f"{tmp_path}: {message}")


def test_the_message_names_the_needed_observation_term_by_term(robot, tmp_path):
    with pytest.raises(InputError, match=r"in this order: ref_base_height 1, ref_base_lin_vel_b 3, .* actions 29$"):
        check_actor(
            ImportedActor(((array(160, 8), array(8)), (array(8, 29), array(29)))), LAYOUTS["wbc132"], robot, tmp_path
        )
