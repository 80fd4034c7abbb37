"""Rotations and their vectors, against scipy's `Rotation`."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_shapefit.base.rotation_vectors import rotation_vectors, rotations_of


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 0.1, 1.0, np.pi])
def test_both_ways_are_those_of_scipy_at_every_size(size):
    vectors = np.random.default_rng(0).standard_normal((1000, 3))
    vectors *= size / np.linalg.norm(vectors, axis=1, keepdims=True)
    rotations = rotations_of(vectors)
    np.testing.assert_allclose(rotations, Rotation.from_rotvec(vectors).as_matrix(), rtol=0.0, atol=1e-15)
    expected = Rotation.from_matrix(rotations).as_rotvec()
    np.testing.assert_allclose(rotation_vectors(rotations), expected, rtol=1e-13, atol=1e-300)
