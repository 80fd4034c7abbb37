"""Observations joined to tracks by the matches that agree with an epipolar geometry, compiled.

Who is joined with whom is a forest over compact arrays (union by the smaller number, paths halved as they are
walked: Tarjan and van Leeuwen 1984): eight bytes an observation, whatever the number of matches, which pass
by once and are not held. Every root is the smallest number of its tree, so that the answer does not depend
on the order of matches.
"""

from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import AnyArray
from sfm_shapefit.base.forests import root_of
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


@kernel
def write_sampson_px(rays_a: Any, rays_b: Any, directions: Any, pixel_angles: Any, errors: Any) -> None:
    """Write the Sampson errors (m,) in pixels of unit rays (m, 3) against unit directions (m, 3)."""
    for m in range(len(errors)):
        errors[m] = sampson_px(rays_a[m], rays_b[m], directions[m], pixel_angles[m])


@kernel
def _number_trees(parents: Any, order: Any, numbers: Any) -> int:
    """Write the number of the tree of each node by the first node of it in `order`; return how many."""
    count = 0
    for k in range(len(numbers)):
        numbers[k] = -1
    for position in range(len(order)):
        root = root_of(parents, order[position])
        if numbers[root] < 0:
            numbers[root] = count
            count += 1
        numbers[order[position]] = numbers[root]
    return count


def number_trees(parents: AnyArray, order: AnyArray) -> AnyArray:
    """Return the number of the tree of each node (k,), trees numbered by their first node in `order`.

    Args:
        parents: (k,) the forest; paths in it become shorter.
        order: (m,) nodes; those of other trees get -1.
    """
    numbers: AnyArray = np.empty_like(parents)
    _number_trees(parents, order, numbers)
    return numbers
