"""The exponential of a similarity's generator, against scipy's."""

import numpy as np
import pytest
from scipy.linalg import expm

from sfm_shapefit.adjustment.gauge import exponential


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-3, 0.2, 1.0, 10.0])
def test_theexponential_is_that_of_scipy(size):
    generator = size * np.random.default_rng(0).uniform(-1.0, 1.0, (4, 4))
    np.testing.assert_allclose(exponential(generator), expm(generator), rtol=1e-11, atol=1e-300)
