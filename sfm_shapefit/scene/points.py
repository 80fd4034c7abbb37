"""The 3D points of a model, and the keypoints of images that observe them, as arrays."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Points:
    """Points with their tracks: point x has the observations offsets[x]:offsets[x + 1]."""

    xyz: FloatArray
    """(x, 3)"""
    offsets: IntArray
    """(x + 1,)"""
    images: IntArray
    """(o,) image of each observation."""
    keypoints: IntArray
    """(o,) which of the image's keypoints it is."""
    ids: IntArray
    """(x,)"""

    @property
    def num_points(self) -> int:
        """Number of points, x."""
        return len(self.xyz)

    def lengths(self) -> IntArray:
        """Return the number of observations of each point, (x,)."""
        return np.diff(self.offsets)

    def points_seen(self) -> IntArray:
        """Return the point of each observation, (o,)."""
        return np.repeat(np.arange(self.num_points), self.lengths())


def number_points(parts: Sequence[Points]) -> Points:
    """Return the points of all parts one after the other, with ids from 1 on."""
    lengths = np.concatenate([np.zeros(0, dtype=np.int64), *(part.lengths() for part in parts)])
    return Points(
        xyz=np.concatenate([np.zeros((0, 3)), *(part.xyz for part in parts)]),
        offsets=np.append(0, np.cumsum(lengths)),
        images=np.concatenate([np.zeros(0, dtype=np.int64), *(part.images for part in parts)]),
        keypoints=np.concatenate([np.zeros(0, dtype=np.int64), *(part.keypoints for part in parts)]),
        ids=np.arange(1, len(lengths) + 1),
    )
