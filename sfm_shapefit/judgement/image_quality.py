"""How well the images of a model are held by its 3D points: their number, errors, tracks, and coverage.

Errors are those of COLMAP's own projection, through any of its camera models. How much of the picture the
points cover decides nothing: on an object before a plain wall they cover little. The limits of weak images
are set by the bundled scenes and twelve sound models of COLMAP, see "What `check` calls weak" in
scripts/results/notes.md.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, distinct_pairs
from sfm_shapefit.base.wording import in_pixels
from sfm_shapefit.judgement.reasons import Kind, Reason, of_each
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.structure import Structure
from sfm_shapefit.tracks.filter import keypoint_errors_px

_FEWEST_POINTS = 30  # points; an image that sees fewer is weak
_LARGE_PX, _LARGE_OF_USUAL = 0.75, 2.0  # pixels and usual errors; an image whose error is above both is weak
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


def image_quality(structure: Structure) -> ImageQuality:
    """Return how well each of posed images is held by the points that they observe."""
    points, images = structure.points, structure.images
    misses_px = keypoint_errors_px(structure, ahead=False)
    n, lengths, seen = images.num_images, points.lengths(), points.points_seen()
    counts, errors = points.count_seen(n), np.full(n, np.nan)
    tracks, coverage = np.full(n, np.nan), np.zeros(n)
    for k, rows in enumerate(structure.rows_of_images):
        if len(rows):
            lens = images.lenses[images.lens_of[k]]
            errors[k], tracks[k] = misses_px[rows].mean(), np.median(lengths[seen[rows]])
            places = structure.pixels[rows] / np.maximum([lens.width, lens.height], 1)
            cells = np.clip(_CELLS * places, 0, _CELLS - 1).astype(np.int64)
            coverage[k] = len(distinct_pairs(cells)) / _CELLS**2
    return ImageQuality(
        num_points=counts,
        errors_px=errors,
        track_lengths=tracks,
        coverage=coverage,
        point_errors_px=np.bincount(seen, misses_px, points.num_points) / lengths,
        point_track_lengths=lengths,
    )


def find_weak_images(images: Images, quality: ImageQuality) -> Iterator[Reason]:
    """Yield what is weak about how points hold each image: they are few, or miss it by much.

    A frame is held by one of its images.
    """
    finite = quality.errors_px[np.isfinite(quality.errors_px)]
    usual_px = float(np.median(finite)) if len(finite) else np.nan
    num_points = np.zeros(len(images.frames.ids))
    np.maximum.at(num_points, images.frame_of, quality.num_points)
    has_points = len(quality.point_errors_px) > 0  # a lack of all is said of the whole model
    for k, frame in enumerate(images.frame_of.tolist()):
        if has_points and num_points[frame] < _FEWEST_POINTS:
            seen = f"only {quality.num_points[k]}" if quality.num_points[k] else "no"
            yield from of_each(Kind.POINTS, images.names[k : k + 1], f"it sees {seen} 3D points")
        if quality.errors_px[k] > max(_LARGE_PX, _LARGE_OF_USUAL * usual_px):
            error_px = quality.errors_px[k]
            clause = (
                f"its reprojection error is {in_pixels(error_px, 1)}, where {in_pixels(usual_px, 1)} is usual"
            )
            yield from of_each(Kind.POINTS, images.names[k : k + 1], clause)
