"""Observations and points that do not fit are filtered, by COLMAP's rules.

In this order: observations that their camera does not see or that miss by too much; points left with fewer
than two; points without triangulation angle (a point that is not finite has none); short tracks.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.scene.images import Images, KeypointRays
from sfm_shapefit.scene.matches import batch_ranges
from sfm_shapefit.scene.points import Points
from sfm_shapefit.scene.structure import Structure
from sfm_shapefit.tracks.structure_options import StructureOptions


def filter_points(
    points: Points, images: Images, pictures: KeypointRays, options: StructureOptions
) -> Points:
    """Return the points that satisfy the options, their observations that do, and their errors.

    Args:
        points: of the images.
        images: where they stand.
        pictures: of these.
        options: what points must satisfy.
    """
    errors_px = keypoint_errors_px(Structure(points, images, pictures))
    fitting = points.paired(errors_px <= options.max_reprojection_error_px)  # false for NaN
    kept = points.taken(fitting)
    sums = np.bincount(kept.points_seen(), errors_px[fitting], kept.num_points)
    kept = replace(kept, errors_px=sums / kept.lengths())
    is_kept = _are_wide(kept, images.centers, options.min_triangulation_angle_deg)
    is_kept &= kept.lengths() >= options.min_track_length
    return kept.taken(is_kept[kept.points_seen()])


def keypoint_errors_px(structure: Structure, *, ahead: bool = True) -> FloatArray:
    """Return the distance of each observation from its point's projection, (o,); NaN where that is not seen.

    Not `ahead`: points behind a camera are projected too, as the formula of its lens has it.
    """
    errors, observed = np.empty(len(structure.points.images)), list(enumerate(structure.rows_of_images))
    of_images = keypoint_offsets_px(structure, observed, ahead=ahead)
    for (_, rows), offsets_px in zip(observed, of_images, strict=True):
        errors[rows] = np.linalg.norm(offsets_px, axis=1)
    return errors


def keypoint_offsets_px(
    structure: Structure, observed: Iterable[tuple[int, IntArray]], *, ahead: bool = True
) -> Iterator[FloatArray]:
    """Yield the offsets (k, 2) of some observations (k,) of each image.

    An offset leads from the keypoint to where its point is projected, as in `keypoint_errors_px`.
    """
    points, images, pictures = structure.points, structure.images, structure.pictures
    seen, rotations, centers = points.points_seen(), images.rotations, images.centers
    for image, rows in observed:
        with np.errstate(invalid="ignore"):  # a point that is not finite
            in_camera = (points.xyz[seen[rows]] - centers[image]) @ rotations[image].T
        found = pictures.project(image, in_camera, ahead=ahead)
        yield images.lenses[images.lens_of[image]].offsets_px(found, structure.pixels[rows])


def _are_wide(points: Points, centers: FloatArray, least_deg: float) -> BoolArray:
    """Return which points two of their observations see under an angle, or its supplement, of so much."""
    wide, cosine = np.zeros(points.num_points, dtype=np.bool_), np.cos(np.radians(least_deg))
    for begin, end in batch_ranges(points.lengths(), 100_000):  # so that few rays are held
        offsets = points.offsets[begin : end + 1]
        lengths, images = np.diff(offsets), points.images[offsets[0] : offsets[-1]]
        rays = centers[images] - np.repeat(points.xyz[begin:end], lengths, axis=0)
        with np.errstate(invalid="ignore"):
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        for first in range(int(lengths.max(initial=1)) - 1):
            left = np.flatnonzero(~wide[begin:end] & (lengths > first + 1))  # a few, after the first round
            own, counts = offsets[left] - offsets[0] + first, lengths[left] - first - 1
            others = np.repeat(own + 1 - offsets_of(counts)[:-1], counts)
            ahead = rays[others + np.arange(len(others))]
            cosines = np.abs(np.einsum("pa,pa->p", np.repeat(rays[own], counts, axis=0), ahead))
            wide[begin + np.repeat(left, counts)[cosines <= cosine]] = True
    return wide
