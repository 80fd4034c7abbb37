"""The 3D points of a model, and the keypoints of images that observe them, as arrays."""

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
