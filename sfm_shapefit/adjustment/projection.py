"""How an observation looks at its point: the pixel that a camera sees it at, and derivatives of that.

The parts of which kernels of an adjustment are made. Each camera is a row of numbers, `views`, see
`residuals.kernel_inputs`. Cases of OPENCV are written out here; u and v are coordinates of a ray (u, v, 1) in
axes of the camera. Other lenses are those of `scene.wide_lenses`, behind one branch.
"""

from typing import Any

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
def observe(
    views: Any, camera: int, point: Any, ray: Any, observed: Any, k: int
) -> tuple[bool, float, float, float, float, float, float, float, float]:
    """Return how a camera sees a point.

    Args:
        views, camera: see the module.
        point: (x, y, z) in axes of the camera.
        ray: (x/z, y/z, 1/z), of which a lens that sees all round makes no use.
        observed, k: pixels, and which it was seen at.

    Returns:
        Whether it is ahead, or where its lens sees all round; its pixel less the one observed; and
        derivatives of the pixel by the point: x by it, then y.
    """
    x, y, z = point
    if views[camera, LENS + KIND] != PLANE:
        lens = views[camera, LENS:]
        if not is_seen(lens, x, y, z):
            return False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        a, b, a0, a1, a2, b0, b1, b2 = see(lens, x, y, z)
        return True, a - observed[k, 0], b - observed[k, 1], a0, a1, a2, b0, b1, b2
    if not (z > 0.0 and z * z > _LEAST_DEPTH * _LEAST_DEPTH * (x * x + y * y + z * z)):
        return False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    u, v, inverse = ray
    f, g = views[camera, LENS], views[camera, LENS + 1]
    k1, k2 = views[camera, LENS + 4], views[camera, LENS + 5]
    p1, p2 = views[camera, LENS + 6], views[camera, LENS + 7]
    s, product = u * u + v * v, 2.0 * u * v
    radial = 1.0 + s * (k1 + s * k2)
    x = f * (u * radial + p1 * product + p2 * (s + 2.0 * u * u)) + views[camera, LENS + 2]
    y = g * (v * radial + p2 * product + p1 * (s + 2.0 * v * v)) + views[camera, LENS + 3]
    # Twice the slope of the radial factor by s.
    slope = 2.0 * (k1 + 2.0 * s * k2)
    mixed = slope * u * v + 2.0 * (p1 * u + p2 * v)
    x_by_u, x_by_v = f * (radial + slope * u * u + 2.0 * p1 * v + 6.0 * p2 * u), f * mixed
    y_by_u, y_by_v = g * mixed, g * (radial + slope * v * v + 2.0 * p2 * u + 6.0 * p1 * v)
    return (
        True,
        x - observed[k, 0],
        y - observed[k, 1],
        x_by_u * inverse,
        x_by_v * inverse,
        -(x_by_u * u + x_by_v * v) * inverse,
        y_by_u * inverse,
        y_by_v * inverse,
        -(y_by_u * u + y_by_v * v) * inverse,
    )


@inner_kernel
def differentiate_by_lens(
    views: Any, camera: int, point: Any, ray: Any, slots: Any, lens: int, by_values: Any, by_lens: Any
) -> None:
    """Write the derivatives of the pixel of a point that is seen by the unknowns of a lens (2, 6).

    Each of these is the sum over the values that it stands for, see `by_values` (2, 8).
    """
    if views[camera, LENS + KIND] != PLANE:
        differentiate_by_values(views[camera, LENS:], point[0], point[1], point[2], by_values)
    else:
        _differentiate_by_values(views, camera, ray[0], ray[1], by_values)
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
