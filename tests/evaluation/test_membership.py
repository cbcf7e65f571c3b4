import numpy as np
import pytest
from scipy import stats

from forgetmimic_jax.evaluation.membership import attack, auc, discriminant, features


def test_auc_by_hand():
    # of six pairs the member is above in three and equal in one
    assert auc(np.array([1.0, 3.0]), np.array([0.0, 1.0, 4.0])) == pytest.approx((1 + 0.5 + 2) / 6)


def test_auc_of_two_normal_scores_is_the_normal_integral():
    rng = np.random.default_rng(0)
    members, others = rng.normal(1.0, 1.0, 4000), rng.normal(0.0, 1.0, 4000)
    assert auc(members, others) == pytest.approx(stats.norm.cdf(1.0 / np.sqrt(2.0)), abs=0.01)


def test_the_discriminant_is_the_bayes_direction_of_two_normals_with_one_covariance():
    rng = np.random.default_rng(1)
    covariance = np.array([[1.0, 0.3, 0.0], [0.3, 2.0, 0.5], [0.0, 0.5, 1.5]])
    shift = np.array([1.0, -0.5, 0.8])
    noise = rng.multivariate_normal(np.zeros(3), covariance, size=(2, 40_000))
    direction, threshold = discriminant(noise[0] + shift, noise[1])
    expected = np.linalg.solve(covariance, shift)
    cosine = direction @ expected / np.linalg.norm(direction) / np.linalg.norm(expected)
    assert cosine == pytest.approx(1.0, abs=1e-3)
    assert threshold == pytest.approx(direction @ shift / 2.0, abs=0.02)


def test_what_differs_is_distinguished_and_what_does_not_is_guessed():
    rng = np.random.default_rng(2)
    noise = [rng.normal(size=(2000, 3)) for _ in range(4)]
    apart = attack((noise[0] + 8.0, noise[1]), (noise[2] + 8.0, noise[3]))
    assert (apart.accuracy, apart.auc, apart.tpr_at_5_percent_fpr) == pytest.approx((1.0, 1.0, 1.0))
    alike = attack((noise[0] + 8.0, noise[1]), (noise[2], noise[3]))
    assert alike.accuracy == pytest.approx(0.5, abs=0.01)
    assert alike.auc == pytest.approx(0.5, abs=0.03)
    assert alike.tpr_at_5_percent_fpr == pytest.approx(0.05, abs=0.02)
    assert alike.marked_at_5_percent_fpr == pytest.approx(0.05, abs=0.02)


def test_the_true_positive_rate_is_at_a_threshold_that_one_in_twenty_others_passes():
    others = np.arange(100.0)[:, None] * np.ones(3)
    members = np.full((10, 3), 95.5)
    found = attack((members, others), (members, others))
    assert found.tpr_at_5_percent_fpr == 1.0
    found = attack((members, others), (members - 2.0, others))
    assert found.tpr_at_5_percent_fpr == 0.0
    found = attack((members, others), (members - 91.0, others))  # 4.5: below all but five
    assert (found.tpr_at_5_percent_fpr, found.marked_at_5_percent_fpr) == (0.0, 1.0)
    assert attack((members, others), (members - 90.0, others)).marked_at_5_percent_fpr == 0.0


def test_features_are_scored_against_a_clip_and_its_image_alone(make_rollout):
    member = make_rollout(clip=[0, 0, 1], horizon=[4, 4, 4], length=[4, 4, 4], reward=[0.9, 0.7, 0.5])
    twin = make_rollout(clip=[0, 0, 1], horizon=[4, 4, 4], length=[2, 4, 4], reward=[0.5, 0.7, 0.5])
    known, other = features(member, twin)
    pair = np.array([0.9, 0.7, 0.5, 0.7])
    np.testing.assert_allclose(known[:2, 0], (pair[:2] - 0.7) / pair.std())
    np.testing.assert_allclose(other[:2, 0], (pair[2:] - 0.7) / pair.std())
    ended = np.array([1.0, 1.0, 0.0, 1.0])
    np.testing.assert_allclose(other[:2, 1], (ended[2:] - 0.75) / ended.std())
    share = np.array([1.0, 1.0, 0.5, 1.0])
    np.testing.assert_allclose(other[:2, 2], (share[2:] - share.mean()) / share.std())
    np.testing.assert_array_equal(known[2], 0.0)  # nothing differs, so nothing is said
