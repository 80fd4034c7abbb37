"""The values that reading matches gives: batches of matches as rays, and stored relative poses.

A match of images i and j is a pair of keypoints that see the same point. Seen with known rotations,
all that matters of a keypoint is the unit ray of its pixel in world axes.
"""

from dataclasses import dataclass

from sfm_shapefit.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MatchBatch:
    """The matches of k image pairs, M matches in all, one pair after the other."""

    pairs: IntArray
    """(k, 2) images (i, j), i < j, as indices into `PosedModel.image_ids`."""
    offsets: IntArray
    """(k + 1,) the matches of pair p are rows offsets[p] to offsets[p + 1]."""
    keypoints: IntArray
    """(M, 2) index of the keypoint in image i and in image j."""
    rays_i: FloatArray
    """(M, 3) unit ray of the keypoint of image i, world axes."""
    rays_j: FloatArray
    """(M, 3) unit ray of the keypoint of image j, world axes."""


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
