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
    errors_px = keypoint_errors_px(points, images, pictures)
    fitting = points.paired(errors_px <= options.max_reprojection_error_px)  # false for NaN
    errors_px[~fitting] = 0.0
    sums = np.bincount(points.points_seen(), errors_px, points.num_points)
    del errors_px
    lengths = points.count(fitting)
    is_kept = _are_wide(points, fitting, lengths, images.centers, options.min_triangulation_angle_deg)
    is_kept &= lengths >= max(options.min_track_length, 1)
    points = replace(points, errors_px=sums / np.maximum(lengths, 1))
    return points.taken(fitting & is_kept[points.points_seen()])


def keypoint_errors_px(
    points: Points, images: Images, pictures: KeypointRays, *, ahead: bool = True
) -> FloatArray:
    """Return the distance of each observation from its point's projection, (o,); NaN where that is not seen.

    Not `ahead`: points behind a camera are projected too, as the formula of its lens has it.
    """
    errors, rows_of = np.empty(len(points.images)), points.rows_of_images(images.num_images)
    of_images = keypoint_offsets_px(points, images, pictures, enumerate(rows_of), ahead=ahead)
    for rows, (_, offsets_px) in zip(rows_of, of_images, strict=True):
        errors[rows] = np.linalg.norm(offsets_px, axis=1)
    return errors


def keypoint_offsets_px(
    points: Points,
    images: Images,
    pictures: KeypointRays,
    observed: Iterable[tuple[int, IntArray]],
    *,
    ahead: bool = True,
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield the pixels (k, 2) of some observations (k,) of each image, and the offsets of these (k, 2).

    An offset leads from the keypoint to where its point is projected, as in `keypoint_errors_px`.
    """
    seen, rotations, centers = points.points_seen(), images.rotations, images.centers
    for image, rows in observed:
        with np.errstate(invalid="ignore"):  # a point that is not finite
            in_camera = (points.xyz[seen[rows]] - centers[image]) @ rotations[image].T
        found = pictures.project(image, in_camera, ahead=ahead)
        pixels = pictures.pixels(image, points.keypoints[rows])
        yield pixels, images.lenses[images.lens_of[image]].offsets_px(found, pixels)


def _are_wide(
    points: Points, chosen: BoolArray, counts: IntArray, centers: FloatArray, least_deg: float
) -> BoolArray:
    """Return which points two chosen observations (o,) see under an angle, or its supplement, of so much.

    `counts` (x,) says how many of each point are chosen.
    """
    wide, cosine = np.zeros(points.num_points, dtype=np.bool_), np.cos(np.radians(least_deg))
    for begin, end in batch_ranges(counts, 100_000):  # so that few rays are held
        own_rows = slice(points.offsets[begin], points.offsets[end])
        lengths, images = counts[begin:end], points.images[own_rows][chosen[own_rows]]
        offsets = offsets_of(lengths)
        rays = centers[images] - np.repeat(points.xyz[begin:end], lengths, axis=0)
        with np.errstate(invalid="ignore"):
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        for first in range(int(lengths.max(initial=1)) - 1):
            left = np.flatnonzero(~wide[begin:end] & (lengths > first + 1))  # a few, after the first round
            own, others_of = offsets[left] + first, lengths[left] - first - 1
            others = np.repeat(own + 1 - offsets_of(others_of)[:-1], others_of)
            ahead = rays[others + np.arange(len(others))]
            cosines = np.abs(np.einsum("pa,pa->p", np.repeat(rays[own], others_of, axis=0), ahead))
            wide[begin + np.repeat(left, others_of)[cosines <= cosine]] = True
    return wide
