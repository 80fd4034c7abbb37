"""Matches of image pairs as rays, and stored relative poses.

A match of images i and j is a pair of keypoints that see the same point. With known rotations, all that
matters of a keypoint is the unit ray of its pixel in world axes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RayMatches:
    """The matches of k image pairs, M in all, one pair after the other, as rays in world axes."""

    pairs: IntArray
    """(k, 2) images (i, j)."""
    offsets: IntArray
    """(k + 1,) the matches of pair p are rows offsets[p] to offsets[p + 1]."""
    rays_i: FloatArray
    """(M, 3) unit rays of image i."""
    rays_j: FloatArray
    """(M, 3) unit rays of image j."""
    pixel_angles: FloatArray
    """(k,) angle of one pixel in radians, 1 / the smaller focal length in px."""

    def rays_of(self, chosen: IntArray) -> "RayMatches":
        """Return the rays of some of the pairs, in that order."""
        counts = np.diff(self.offsets)[chosen]
        offsets = np.append(0, np.cumsum(counts))
        rows = np.repeat(self.offsets[chosen] - offsets[:-1], counts) + np.arange(offsets[-1])
        return RayMatches(
            pairs=self.pairs[chosen],
            offsets=offsets,
            rays_i=self.rays_i[rows],
            rays_j=self.rays_j[rows],
            pixel_angles=self.pixel_angles[chosen],
        )


def join_rays(parts: Sequence[RayMatches]) -> RayMatches:
    """Return the pairs of all parts, in order; there may be no parts."""
    counts = np.concatenate([np.zeros(0, dtype=np.int64), *(np.diff(part.offsets) for part in parts)])
    return RayMatches(
        pairs=np.concatenate([np.zeros((0, 2), dtype=np.int64), *(part.pairs for part in parts)]),
        offsets=np.append(0, np.cumsum(counts)),
        rays_i=np.concatenate([np.zeros((0, 3)), *(part.rays_i for part in parts)]),
        rays_j=np.concatenate([np.zeros((0, 3)), *(part.rays_j for part in parts)]),
        pixel_angles=np.concatenate([np.zeros(0), *(part.pixel_angles for part in parts)]),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeypointMatches:
    """The matches of k image pairs, M in all, one pair after the other, as keypoints; no rays."""

    pairs: IntArray
    """(k, 2) images (i, j), i < j, as indices into `PosedModel.image_ids`."""
    offsets: IntArray
    """(k + 1,) the matches of pair p are rows offsets[p] to offsets[p + 1]."""
    keypoints: IntArray
    """(M, 2) index of the keypoint in image i and in image j."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatchBatch(RayMatches):
    """Matches that know their keypoints; images i < j are indices into `PosedModel.image_ids`."""

    keypoints: IntArray
    """(M, 2) index of the keypoint in image i and in image j."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RelativePoses:
    """The relative poses of k image pairs: x_j = rotation x_i + translation in camera axes."""

    pairs: IntArray
    """(k, 2) images (i, j), i < j, as indices into `PosedModel.image_ids`."""
    rotations: FloatArray
    """(k, 3, 3) camera j from camera i."""
    translations: FloatArray
    """(k, 3) unit vectors, in the axes of camera j."""
    configs: IntArray
    """(k,) COLMAP's TwoViewGeometryConfiguration."""
    num_inliers: IntArray
    """(k,) number of inlier matches."""
