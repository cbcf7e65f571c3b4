import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from forgetmimic_jax.basics import rotation

COUNT = 200
TOLERANCE = {"rtol": 1e-5, "atol": 2e-6}


def wxyz(turn: Rotation) -> np.ndarray:
    return turn.as_quat(scalar_first=True).astype(np.float32)


def same_turn(a, b):
    """Equal up to the sign that a quaternion does not care about."""
    dot = np.abs(np.sum(np.asarray(a, np.float64) * np.asarray(b, np.float64), axis=-1))
    np.testing.assert_allclose(dot, 1.0, atol=1e-5)


@pytest.fixture
def turns():
    return Rotation.random(COUNT, rng=0), Rotation.random(COUNT, rng=1)


@pytest.fixture
def vectors():
    return np.random.default_rng(2).normal(size=(COUNT, 3)).astype(np.float32)


def test_multiply_composes(turns):
    a, b = turns
    same_turn(rotation.multiply(wxyz(a), wxyz(b)), wxyz(a * b))


def test_rotate_and_back(turns, vectors):
    a, _ = turns
    np.testing.assert_allclose(rotation.rotate(wxyz(a), vectors), a.apply(vectors), **TOLERANCE)
    np.testing.assert_allclose(rotation.rotate_inverse(wxyz(a), vectors), a.inv().apply(vectors), **TOLERANCE)
    np.testing.assert_allclose(
        rotation.rotate_inverse(wxyz(a), rotation.rotate(wxyz(a), vectors)), vectors, **TOLERANCE
    )


@pytest.mark.parametrize("size", [0.0, 1e-8, 1e-5, 1e-3, 1.0, 3.1])
def test_rotation_vectors(vectors, size):
    vectors = size * vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    quat = rotation.from_rotation_vector(vectors)
    same_turn(quat, wxyz(Rotation.from_rotvec(vectors)))
    np.testing.assert_allclose(rotation.to_rotation_vector(quat), vectors, rtol=1e-4, atol=2e-6)


def test_a_rotation_vector_takes_the_short_way(turns):
    a, _ = turns
    np.testing.assert_allclose(rotation.to_rotation_vector(-wxyz(a)), a.as_rotvec(), rtol=1e-4, atol=1e-4)


def test_difference_takes_b_to_a(turns):
    a, b = turns
    step = rotation.from_rotation_vector(rotation.difference(wxyz(a), wxyz(b)))
    same_turn(rotation.multiply(step, wxyz(b)), wxyz(a))


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.7, 1.0])
def test_slerp_is_scipys(turns, fraction):
    for a, b in zip(*(wxyz(turn)[:20] for turn in turns), strict=True):
        both = Rotation.from_quat([a, b], scalar_first=True)
        expected = wxyz(Slerp([0.0, 1.0], both)(fraction))
        same_turn(rotation.slerp(a, b, fraction), expected)
        same_turn(rotation.slerp(a, -b, fraction), expected)


def test_angle_between(turns):
    a, b = turns
    np.testing.assert_allclose(rotation.angle_between(wxyz(a), wxyz(b)), (a * b.inv()).magnitude(), atol=1e-5)
    np.testing.assert_allclose(rotation.angle_between(wxyz(a), -wxyz(a)), 0.0, atol=1e-3)


def test_euler_angles_turn_about_the_fixed_axes(vectors):
    same_turn(rotation.from_euler(vectors), wxyz(Rotation.from_euler("xyz", vectors)))


def test_yaw_only_leaves_a_turn_without_twist_about_z(turns):
    a, _ = turns
    yaw = rotation.yaw_only(wxyz(a))
    np.testing.assert_allclose(np.asarray(yaw)[:, 1:3], 0.0)
    rest = np.asarray(rotation.multiply(rotation.conjugate(yaw), wxyz(a)))
    np.testing.assert_allclose(rest[:, 3], 0.0, atol=1e-6)


@pytest.mark.parametrize("angle", [-3.0, -0.4, 0.0, 1.0, 3.1])
def test_yaw_only_is_exact_for_a_pure_yaw(angle):
    same_turn(rotation.yaw_only(wxyz(Rotation.from_euler("z", angle))), wxyz(Rotation.from_euler("z", angle)))


def test_yaw_only_turns_with_the_world(turns):
    a, _ = turns
    turn = wxyz(Rotation.from_euler("z", 0.7))
    expected = rotation.multiply(turn, rotation.yaw_only(wxyz(a)))
    same_turn(rotation.yaw_only(rotation.multiply(turn, wxyz(a))), expected)


def test_matrix_columns(turns):
    a, _ = turns
    expected = np.concatenate([a.as_matrix()[:, :, 0], a.as_matrix()[:, :, 1]], axis=1)
    np.testing.assert_allclose(rotation.to_matrix_columns(wxyz(a)), expected, **TOLERANCE)


@pytest.mark.parametrize(
    "function",
    [rotation.normalize, rotation.to_rotation_vector, rotation.yaw_only, rotation.from_rotation_vector],
)
def test_values_and_gradients_stay_finite_where_the_angle_is_degenerate(function):
    width = 3 if function is rotation.from_rotation_vector else 4
    points = [jnp.zeros(width), jnp.eye(width)[0], jnp.eye(width)[1]]
    for point in points:
        assert jnp.all(jnp.isfinite(function(point)))


def test_leading_dimensions_are_free_and_types_are_kept(turns):
    quat = wxyz(turns[0]).reshape(4, 50, 4)
    assert rotation.multiply(quat, quat).shape == (4, 50, 4)
    assert rotation.rotate(quat, jnp.ones(3)).shape == (4, 50, 3)
    assert rotation.to_matrix_columns(quat).shape == (4, 50, 6)
    assert jax.eval_shape(rotation.difference, quat, quat).dtype == jnp.float32
