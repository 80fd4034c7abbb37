"""How well the images of a model are held by its 3D points: their number, errors, tracks, and coverage.

Errors are those of COLMAP's own projection, through any of its camera models.
"""

from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.scene.images import Images, Pictures
from sfm_shapefit.scene.points import Points
from sfm_shapefit.tracks.filter import keypoint_errors_px

_CELLS = 8  # cells per side of the picture; its coverage is the share of cells with a point


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageQuality:
    """Posed images and their points; NaN for an image that sees none."""

    num_points: IntArray
    """(i,) 3D points that it observes."""
    errors_px: FloatArray
    """(i,) mean reprojection error."""
    track_lengths: FloatArray
    """(i,) median number of images that observe its points."""
    coverage: FloatArray
    """(i,) share of the cells of an 8 x 8 grid over the picture that hold an observation of a point."""
    point_errors_px: FloatArray
    """(x,) mean reprojection error of each point."""
    point_track_lengths: IntArray
    """(x,) number of images that observe each point."""


def image_quality(points: Points, images: Images, pictures: Pictures) -> ImageQuality:
    """Return how well each of posed images is held by the points that they observe."""
    misses_px = keypoint_errors_px(points, images, pictures, ahead=False)
    n, lengths, seen = images.num_images, points.lengths(), points.points_seen()
    counts, errors = points.count_seen(n), np.full(n, np.nan)
    tracks, coverage = np.full(n, np.nan), np.zeros(n)
    for k, rows in enumerate(points.rows_of_images(n)):
        if len(rows):
            lens = images.lenses[images.lens_of[k]]
            errors[k], tracks[k] = misses_px[rows].mean(), np.median(lengths[seen[rows]])
            places = pictures.pixels(k, points.keypoints[rows]) / [lens.width, lens.height]
            cells = np.clip(_CELLS * places, 0, _CELLS - 1).astype(np.int64)
            coverage[k] = len(np.unique(cells, axis=0)) / _CELLS**2
    return ImageQuality(
        num_points=counts,
        errors_px=errors,
        track_lengths=tracks,
        coverage=coverage,
        point_errors_px=np.bincount(seen, misses_px, points.num_points) / lengths,
        point_track_lengths=lengths,
    )
