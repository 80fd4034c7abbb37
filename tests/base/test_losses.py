"""Robust losses: a weight is the slope of its loss, in Python and in kernels; sums are those of logs."""

import numpy as np
import pytest

from sfm_shapefit.base.jit import kernel
from sfm_shapefit.base.losses import (
    ARCTANGENT,
    CAUCHY,
    GEMAN_MCCLURE,
    add_cauchy,
    loss,
    weigh_residual,
    weighed,
)

X = np.geomspace(1e-4, 1e4, 33)


@pytest.mark.parametrize("kind", [CAUCHY, GEMAN_MCCLURE, ARCTANGENT])
def test_a_weight_is_the_slope_of_its_loss(kind):
    step = 1e-4 * X
    slopes = (loss(kind, X + step) - loss(kind, X - step)) / (2.0 * step)
    # Central differences err by a few hundred-millionths, and by the rounding of a loss near its bound: 2^-53
    # over a step of 1e-4 x and a slope of 1 / x^2 at least, which is 1e-12 x.
    assert np.all(np.abs(weighed(kind, 1.0, X) - slopes) <= (4e-8 + 4e-12 * X) * slopes)
    np.testing.assert_array_equal(weighed(kind, 2.0, X), 2.0 * weighed(kind, 1.0, X))


@pytest.mark.parametrize("kind", [CAUCHY, GEMAN_MCCLURE, ARCTANGENT])
def test_a_kernel_gives_what_python_gives(kind):
    out = np.empty((len(X), 2))
    kernel(fill)(kind, X, out)
    np.testing.assert_array_equal(out[:, 1], weighed(kind, 3.0, X))
    np.testing.assert_allclose(out[:, 0], loss(kind, X), rtol=4e-16)  # log1p and atan are the C library's


def fill(kind, x, out):
    for k in range(len(x)):
        out[k, 0], out[k, 1] = loss(kind, x[k]), weighed(kind, 3.0, x[k])


def test_a_sum_of_cauchy_losses_is_that_of_the_logarithms():
    total, product = 0.0, 1.0
    for x in np.tile(X, 50):
        total, product = add_cauchy(x, total, product)
    assert total > 0.0  # the product was large, and its logarithm was taken
    assert total + np.log(product) == pytest.approx(50.0 * np.sum(loss(CAUCHY, X)), rel=1e-13)


def test_the_curvature_of_a_residual_is_that_of_the_loss_and_never_below_its_least_share():
    square = 4.0  # of the residual and of the scale: x = 1, where the loss is flat along the residual
    across = weighed(CAUCHY, 1.0, 1.0)
    assert weigh_residual(2.0, 0.0, square, 1.0) == (across, across, 0.0, across)
    pull, along, mixed, other = weigh_residual(2.0, 0.0, square, 0.25)
    assert (pull, mixed, other) == (across, 0.0, across)
    assert along == pytest.approx(0.25 * across, rel=1e-15)
    assert weigh_residual(2.0, 0.0, np.inf, 0.25) == (1.0, 1.0, 0.0, 1.0)
