"""How far matches are from the epipolar lines of their cameras."""

from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.jit import inner_kernel, kernel


@inner_kernel
def write_ray(on_plane: Any, rotation: Any, ray: Any) -> None:
    """Write the unit ray, in axes of the world, of a keypoint at x/z and y/z in axes of its camera."""
    u, v = on_plane[0], on_plane[1]
    size = np.sqrt(1.0 + u * u + v * v)
    for a in range(3):
        ray[a] = (u * rotation[0, a] + v * rotation[1, a] + rotation[2, a]) / size


@inner_kernel
def sampson_px(a: Any, b: Any, d: Any, pixel_angle: float) -> float:
    """Return the Sampson error in pixels of two unit rays against the unit direction of their baseline.

    To first order it is the least movement of both image points together that makes the rays meet:
    |(a x b) . d| / sqrt(|a x d|^2 + |b x d|^2), over the angle of a pixel. It is NaN with a ray of NaN.
    """
    along_a = a[0] * d[0] + a[1] * d[1] + a[2] * d[2]
    along_b = b[0] * d[0] + b[1] * d[1] + b[2] * d[2]
    volume = (
        (a[1] * b[2] - a[2] * b[1]) * d[0]
        + (a[2] * b[0] - a[0] * b[2]) * d[1]
        + (a[0] * b[1] - a[1] * b[0]) * d[2]
    )
    gradient = np.sqrt(max(2.0 - along_a * along_a - along_b * along_b, 1e-12))
    return float(abs(volume) / (gradient * pixel_angle))


def sampson_errors_px(
    rays_a: FloatArray, rays_b: FloatArray, directions: FloatArray, pixel_angles: FloatArray
) -> FloatArray:
    """Return the Sampson errors (m,) in pixels of unit rays (m, 3) against unit directions (m, 3)."""
    errors = np.empty(len(pixel_angles))
    _write_errors(rays_a, rays_b, directions, pixel_angles, errors)
    return errors


@kernel
def _write_errors(rays_a: Any, rays_b: Any, directions: Any, pixel_angles: Any, errors: Any) -> None:
    for m in range(len(errors)):
        errors[m] = sampson_px(rays_a[m], rays_b[m], directions[m], pixel_angles[m])
