"""The loss of all observations, and points moved by themselves to less of it, while all cameras stay.

A joint step has one damping and one share of the predicted decrease for all points. What single ones have to
go by their own loss, from a triangulation that weighed otherwise or after a joint step, costs each of them a
system of three unknowns here, and would cost whole iterations there: castle-P30 ends in 12 instead of 35.
"""

from functools import partial
from typing import Any

import numpy as np

from sfm_shapefit.adjustment.layout import Layout
from sfm_shapefit.adjustment.projection import (
    LENS,
    SHIFT,
    look,
    observe,
    turn_to_world,
)
from sfm_shapefit.adjustment.residuals import Values, chunks_of, kernel_inputs
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.base.losses import CAUCHY, add_cauchy, weighed
from sfm_shapefit.laplacian.operators import Workers

# Share of a point's loss; a step that lowers it by less is its last. 1e-5 takes as long in all, 1e-2 a
# half longer (castle-P30, lego100).
_ENOUGH = 1e-4
_SINGULAR = 1e-9  # least pivot relative to its diagonal; a point of less stays where it is
# Damping of a point's block at first, and at least after a refused step; each of these raises it a
# hundredfold, so that one or two of the eight steps are lost where a point is curved.
_FIRST_DAMPING, _LEAST_REFUSED, _GROWTH = 1e-8, 1e-4, 100.0


def settle_points(
    layout: Layout, values: Values, loss_scale_px: float | None, workers: Workers, steps: int
) -> tuple[FloatArray, float]:
    """Return the points (k, 3) after so many steps each at most, and the cost 1/2 sum rho(|r|^2) in px^2.

    No step raises the loss of its point. An observation behind its camera misses by the focal length.
    """
    given = kernel_inputs(layout, values, loss_scale_px)
    points = values.points.copy() if steps else values.points

    def job(begin: int, end: int) -> tuple[FloatArray, ...]:
        cost = np.zeros(1)
        _settle(begin, end, given, points, steps, cost)
        return (cost,)

    (cost,) = workers.total([partial(job, *chunk) for chunk in chunks_of(layout)])
    return points, float(cost[0])


@kernel
def _settle(begin: int, end: int, given: Any, points: Any, steps: int, total: Any) -> None:
    """Step the points begin..end-1 by reweighted squares, and add up their losses."""
    now, then, step = np.empty(9), np.empty(9), np.empty(3)
    for p in range(begin, end):
        loss, damping = _equations_of(p, given, points, now), _FIRST_DAMPING
        for _ in range(steps):
            if _predict(now, damping, step) <= _ENOUGH * loss:
                break
            for a in range(3):
                points[p, a] += step[a]
            after = _equations_of(p, given, points, then)
            if after < loss:
                now, then = then, now
                loss = after
            else:
                for a in range(3):
                    points[p, a] -= step[a]
                damping = _GROWTH * max(damping, _LEAST_REFUSED)
        total[0] += loss


@inner_kernel
def _predict(equations: Any, damping: float, step: Any) -> float:
    """Write the step of a point by its normal equations, and return how much of the loss it should take."""
    v00, v01, v02, v11, v12, v22, g0, g1, g2 = equations
    more = 1.0 + damping
    d0 = v00 * more
    if d0 <= 0.0:
        return 0.0
    l10, l20 = v01 / d0, v02 / d0
    d1, rest = v11 * more - l10 * v01, v12 - l20 * v01
    if d1 <= _SINGULAR * v11:
        return 0.0
    l21 = rest / d1
    d2 = v22 * more - l20 * v02 - l21 * rest
    if d2 <= _SINGULAR * v22:
        return 0.0
    y1 = g1 - l10 * g0
    step[2] = (l20 * g0 + l21 * y1 - g2) / d2
    step[1] = -y1 / d1 - l21 * step[2]
    step[0] = -g0 / d0 - l10 * step[1] - l20 * step[2]
    return float(-0.5 * (g0 * step[0] + g1 * step[1] + g2 * step[2]))


@inner_kernel
def _equations_of(p: int, given: Any, points: Any, out: Any) -> float:
    """Write a point's block and gradient (9,) by reweighted squares, and return its loss in px^2."""
    first, cameras, pixels, views, _, scale = given
    inverse_scale = 0.0 if scale == np.inf else 1.0 / scale
    v00, v01, v02, v11, v12, v22, g0, g1, g2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    total, product = 0.0, 1.0
    for k in range(first[p], first[p + 1]):
        camera = cameras[k]
        x, y, z = look(views, camera, points, p)
        x, y, z = x + views[camera, SHIFT], y + views[camera, SHIFT + 1], z + views[camera, SHIFT + 2]
        square, w = views[camera, LENS] * views[camera, LENS], 0.0
        inverse = 1.0 / z
        ray = (x * inverse, y * inverse, inverse)
        ahead, rx, ry, a0, a1, a2, b0, b1, b2 = observe(views, camera, (x, y, z), ray, pixels, k)
        if ahead:
            square = rx * rx + ry * ry
            w = weighed(CAUCHY, 1.0, square * inverse_scale)
            p0, p1, p2 = turn_to_world(views, camera, a0, a1, a2)
            q0, q1, q2 = turn_to_world(views, camera, b0, b1, b2)
            v00 += w * (p0 * p0 + q0 * q0)
            v01 += w * (p0 * p1 + q0 * q1)
            v02 += w * (p0 * p2 + q0 * q2)
            v11 += w * (p1 * p1 + q1 * q1)
            v12 += w * (p1 * p2 + q1 * q2)
            v22 += w * (p2 * p2 + q2 * q2)
            g0 += w * (p0 * rx + q0 * ry)
            g1 += w * (p1 * rx + q1 * ry)
            g2 += w * (p2 * rx + q2 * ry)
        if scale == np.inf:
            total += square
        else:
            total, product = add_cauchy(square * inverse_scale, total, product)
    out[0], out[1], out[2], out[3], out[4], out[5] = v00, v01, v02, v11, v12, v22
    out[6], out[7], out[8] = g0, g1, g2
    return 0.5 * total if scale == np.inf else 0.5 * scale * (total + np.log(product))
