"""Points of two pieces that coincide where one is placed beside the other."""

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import Similarity, invert

_NEIGHBOR = 3  # its distance is the spacing of points around one; the first may be a twin
_NEAR = 0.1  # spacings; at a wrong place a point in a thousand is as near to another, at the right one in 30


def count_coinciding(first: FloatArray, second: FloatArray, first_from_second: Similarity) -> int:
    """Return how many points (k, 3) of a piece are where the other has one, whose spacing is the unit.

    Counted for either piece, and the fewer of the two: one that shrinks to a point is near to something.
    """
    ways = (first, second, first_from_second), (second, first, invert(first_from_second))
    return min(_count_near(*way) for way in ways)


def _count_near(points: FloatArray, others: FloatArray, from_others: Similarity) -> int:
    """Return how many of the other points come to lie near one of the points."""
    from scipy.spatial import KDTree  # here, since it takes long to import

    if len(points) <= _NEIGHBOR or not len(others):
        return 0
    tree = KDTree(points)
    apart, nearest = tree.query(from_others.apply(others))
    spacing = np.asarray(tree.query(points[nearest], k=_NEIGHBOR + 1)[0])[:, -1]
    return int(np.sum(apart <= _NEAR * spacing))
