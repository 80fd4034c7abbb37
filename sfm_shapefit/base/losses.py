"""Robust losses rho(x) of a residual r, x = (r / s)^2, and the weights rho'(x) of its reweighted squares.

    loss                rho(x)         rho'(x)           far residuals
    CAUCHY              log(1 + x)     1 / (1 + x)       pull as 1 / r
    GEMAN_MCCLURE       x / (1 + x)    1 / (1 + x)^2     are forgotten: they pull as 1 / r^3
    ARCTANGENT          atan x         1 / (1 + x^2)     are forgotten, and near ones count whole for longer

All functions take numbers inside kernels and arrays in Python.

Source: Zhang, "Parameter estimation techniques: a tutorial with application to conic fitting", IVC 1997; for
the arctangent, the Ceres solver's `ArctanLoss`.
"""

from typing import Any

import numpy as np

from sfm_shapefit.base.jit import inner_kernel

CAUCHY, GEMAN_MCCLURE, ARCTANGENT = range(3)

# Below, log(1 + x) is a series of six terms; above, part of a product, whose logarithm is taken when it is
# large. The error of either is rounding.
_SMALL, _LARGE = 1e-3, 1e150


@inner_kernel
def loss(kind: int, x: Any) -> Any:
    """Return rho(x)."""
    if kind == CAUCHY:
        return np.log1p(x)
    if kind == GEMAN_MCCLURE:
        return x / (1.0 + x)
    return np.arctan(x)


@inner_kernel
def weighed(kind: int, weight: Any, x: Any) -> Any:
    """Return a weight times rho'(x)."""
    if kind == CAUCHY:
        return weight / (1.0 + x)
    if kind == GEMAN_MCCLURE:
        return weight / (1.0 + x) ** 2
    return weight / (1.0 + x * x)


@inner_kernel
def weigh_residual(x: float, y: float, scale: float, least: float) -> tuple[float, float, float, float]:
    """Return a residual's weight under CAUCHY in the gradient, and its 2 x 2 weight in the curvature.

    `scale` is s^2, infinite for squares. The curvature along the residual is at least the share `least` of
    that across it.
    """
    if scale == np.inf:
        return 1.0, 1.0, 0.0, 1.0
    square, inverse_scale = x * x + y * y, 1.0 / scale
    w = weighed(CAUCHY, 1.0, square * inverse_scale)
    if least == 1.0:
        return w, w, 0.0, w
    bend = 2.0 * w * inverse_scale
    if bend * square > 1.0 - least:
        bend = (1.0 - least) / square
    return w, w * (1.0 - bend * x * x), -w * bend * x * y, w * (1.0 - bend * y * y)


@inner_kernel
def add_cauchy(x: Any, total: Any, product: Any) -> Any:
    """Return the total and the product after x, for a sum of log(1 + x): it is total + log(product)."""
    if x < _SMALL:
        return total + x * (1.0 - x * (1 / 2 - x * (1 / 3 - x * (1 / 4 - x * (1 / 5 - x / 6))))), product
    product *= 1.0 + x
    if product > _LARGE:
        return total + np.log(product), 1.0
    return total, product
