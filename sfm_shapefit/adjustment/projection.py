"""How an observation looks at its point: the pixel that a camera sees it at, and derivatives of that.

The parts of which kernels of an adjustment are made. Each camera is a row of numbers, `views`, see
`residuals.kernel_inputs`. A ray (u, v, w) is a point in axes of the camera over its `depth_of`, so that w is
1 for cases of OPENCV, which are written out here; other lenses are those of `scene.wide_lenses`.
"""

from typing import Any

import numpy as np

from sfm_shapefit.adjustment.layout import SLOTS
from sfm_shapefit.base.jit import inner_kernel
from sfm_shapefit.scene.lens import NUM_VALUES
from sfm_shapefit.scene.wide_lenses import KIND, PLANE, differentiate_by_values, is_seen, see

_LEAST_DEPTH = 1e-8  # depth over the distance from the camera; a point of less is behind it

# Columns of a camera's row at which its frame's center, shift and rotation of its sensor, and its lens begin;
# its rotation comes first.
CENTER, SHIFT, SENSOR, LENS = 9, 12, 15, 24


@inner_kernel
def look(views: Any, camera: int, points: Any, p: int) -> tuple[float, float, float]:
    """Return a point less the frame's center, in axes of the camera."""
    x = points[p, 0] - views[camera, CENTER]
    y = points[p, 1] - views[camera, CENTER + 1]
    z = points[p, 2] - views[camera, CENTER + 2]
    return (
        views[camera, 0] * x + views[camera, 1] * y + views[camera, 2] * z,
        views[camera, 3] * x + views[camera, 4] * y + views[camera, 5] * z,
        views[camera, 6] * x + views[camera, 7] * y + views[camera, 8] * z,
    )


@inner_kernel
def is_ahead(views: Any, camera: int, x: float, y: float, z: float) -> bool:
    """Return whether a point, in axes of the camera, is in front of it, or where its lens sees all round."""
    if views[camera, LENS + KIND] != PLANE:
        return bool(is_seen(views[camera, LENS:], x, y, z))
    return bool(z > 0.0 and z * z > _LEAST_DEPTH * _LEAST_DEPTH * (x * x + y * y + z * z))


@inner_kernel
def depth_of(views: Any, camera: int, x: float, y: float, z: float) -> float:
    """Return the depth of a point, or its distance where a lens sees all round."""
    return float(z if views[camera, LENS + KIND] == PLANE else np.sqrt(x * x + y * y + z * z))


@inner_kernel
def miss(views: Any, camera: int, u: float, v: float, w: float, observed: Any, k: int) -> tuple[float, float]:
    """Return the pixel of the ray (u, v, w), less the k-th that was observed."""
    if views[camera, LENS + KIND] != PLANE:
        x, y, _, _, _, _, _, _ = see(views[camera, LENS:], u, v, w)
        return x - observed[k, 0], y - observed[k, 1]
    f, g = views[camera, LENS], views[camera, LENS + 1]
    k1, k2 = views[camera, LENS + 4], views[camera, LENS + 5]
    p1, p2 = views[camera, LENS + 6], views[camera, LENS + 7]
    s, product = u * u + v * v, 2.0 * u * v
    radial = 1.0 + s * (k1 + s * k2)
    x = f * (u * radial + p1 * product + p2 * (s + 2.0 * u * u)) + views[camera, LENS + 2]
    y = g * (v * radial + p2 * product + p1 * (s + 2.0 * v * v)) + views[camera, LENS + 3]
    return x - observed[k, 0], y - observed[k, 1]


@inner_kernel
def differentiate_by_point(
    views: Any, camera: int, u: float, v: float, w: float, inverse: float
) -> tuple[float, float, float, float, float, float]:
    """Return the derivatives of the pixel by the point in axes of the camera: x by it, then y.

    `inverse` is that of the point's depth.
    """
    if views[camera, LENS + KIND] != PLANE:
        _, _, a0, a1, a2, b0, b1, b2 = see(views[camera, LENS:], u, v, w)
        return a0 * inverse, a1 * inverse, a2 * inverse, b0 * inverse, b1 * inverse, b2 * inverse
    f, g = views[camera, LENS], views[camera, LENS + 1]
    k1, k2 = views[camera, LENS + 4], views[camera, LENS + 5]
    p1, p2 = views[camera, LENS + 6], views[camera, LENS + 7]
    s = u * u + v * v
    radial = 1.0 + s * (k1 + s * k2)
    # Twice the slope of the radial factor by s.
    slope = 2.0 * (k1 + 2.0 * s * k2)
    mixed = slope * u * v + 2.0 * (p1 * u + p2 * v)
    x_by_u, x_by_v = f * (radial + slope * u * u + 2.0 * p1 * v + 6.0 * p2 * u), f * mixed
    y_by_u, y_by_v = g * mixed, g * (radial + slope * v * v + 2.0 * p2 * u + 6.0 * p1 * v)
    return (
        x_by_u * inverse,
        x_by_v * inverse,
        -(x_by_u * u + x_by_v * v) * inverse,
        y_by_u * inverse,
        y_by_v * inverse,
        -(y_by_u * u + y_by_v * v) * inverse,
    )


@inner_kernel
def differentiate_by_lens(
    views: Any, camera: int, u: float, v: float, w: float, slots: Any, lens: int, by_values: Any, by_lens: Any
) -> None:
    """Write the derivatives of the pixel by the unknowns of a lens (2, 6).

    Each of these is the sum over the values that it stands for, see `by_values` (2, 8).
    """
    if views[camera, LENS + KIND] != PLANE:
        differentiate_by_values(views[camera, LENS:], u, v, w, by_values)
    else:
        _differentiate_by_values(views, camera, u, v, by_values)
    for q in range(SLOTS):
        by_lens[0, q] = by_lens[1, q] = 0.0
    for q in range(NUM_VALUES):
        if slots[lens, q] >= 0:
            by_lens[0, slots[lens, q]] += by_values[0, q]
            by_lens[1, slots[lens, q]] += by_values[1, q]


@inner_kernel
def _differentiate_by_values(views: Any, camera: int, u: float, v: float, by_values: Any) -> None:
    """Write the derivatives of the pixel by the values of a lens that is a case of OPENCV (2, 8)."""
    f, g = views[camera, LENS], views[camera, LENS + 1]
    p1, p2 = views[camera, LENS + 6], views[camera, LENS + 7]
    s = u * u + v * v
    radial = 1.0 + s * (views[camera, LENS + 4] + s * views[camera, LENS + 5])
    by_values[0, 0] = u * radial + 2.0 * p1 * u * v + p2 * (s + 2.0 * u * u)
    by_values[1, 1] = v * radial + 2.0 * p2 * u * v + p1 * (s + 2.0 * v * v)
    by_values[0, 4], by_values[1, 4] = f * u * s, g * v * s
    by_values[0, 5], by_values[1, 5] = f * u * s * s, g * v * s * s
    by_values[0, 6], by_values[1, 6] = f * 2.0 * u * v, g * (s + 2.0 * v * v)
    by_values[0, 7], by_values[1, 7] = f * (s + 2.0 * u * u), g * 2.0 * u * v


@inner_kernel
def turn_to_frame(views: Any, camera: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a vector in axes of the camera in those of its frame."""
    s = SENSOR
    return (
        x * views[camera, s] + y * views[camera, s + 3] + z * views[camera, s + 6],
        x * views[camera, s + 1] + y * views[camera, s + 4] + z * views[camera, s + 7],
        x * views[camera, s + 2] + y * views[camera, s + 5] + z * views[camera, s + 8],
    )


@inner_kernel
def turn_to_world(views: Any, camera: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a vector in axes of the camera in those of the world."""
    return (
        x * views[camera, 0] + y * views[camera, 3] + z * views[camera, 6],
        x * views[camera, 1] + y * views[camera, 4] + z * views[camera, 7],
        x * views[camera, 2] + y * views[camera, 5] + z * views[camera, 8],
    )
