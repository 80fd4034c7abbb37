"""Rotations, their vectors and quaternions, against scipy's `Rotation`."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.base.quaternions import matrices_of, quaternions_of, rotation_vectors, rotations_of


def test_both_ways_are_those_of_scipy_to_the_bit():
    rng = np.random.default_rng(0)
    quaternions = rng.standard_normal((5000, 4)) * rng.choice([1e-3, 1.0], (5000, 4))  # each entry is largest
    matrices = matrices_of(quaternions)
    np.testing.assert_array_equal(matrices, Rotation.from_quat(quaternions).as_matrix())
    np.testing.assert_array_equal(quaternions_of(matrices), Rotation.from_matrix(matrices).as_quat())
    assert quaternions_of(np.zeros((0, 3, 3))).shape == (0, 4)


def test_what_is_no_rotation_counts_as_the_nearest():
    rough = Rotation.random(200, random_state=0).as_matrix() + 1e-4 * np.random.default_rng(1).random(
        (200, 3, 3)
    )
    np.testing.assert_allclose(quaternions_of(rough), Rotation.from_matrix(rough).as_quat(), atol=1e-14)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 0.1, 1.0, np.pi])
def test_vectors_are_those_of_scipy_at_every_size(size):
    vectors = np.random.default_rng(0).standard_normal((1000, 3))
    vectors *= size / np.linalg.norm(vectors, axis=1, keepdims=True)
    rotations = rotations_of(vectors)
    np.testing.assert_allclose(rotations, Rotation.from_rotvec(vectors).as_matrix(), rtol=0.0, atol=1e-15)
    expected = Rotation.from_matrix(rotations).as_rotvec()
    np.testing.assert_allclose(rotation_vectors(rotations), expected, rtol=1e-13, atol=1e-300)
