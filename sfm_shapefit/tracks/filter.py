"""Observations and points that do not fit are filtered, by COLMAP's rules.

In this order: observations that their camera does not see or that miss by too much; points left with fewer
than two; points without triangulation angle (a point that is not finite has none); short tracks.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.executors import in_threads
from sfm_shapefit.base.lists import RowLists, offsets_of
from sfm_shapefit.scene.images import Images, KeypointRays
from sfm_shapefit.scene.matches import batch_ranges, lens_runs
from sfm_shapefit.scene.points import Points
from sfm_shapefit.tracks.structure_options import StructureOptions


def filter_points(
    points: Points,
    images: Images,
    pictures: KeypointRays,
    options: StructureOptions,
    threads: int = 1,
) -> Points:
    """Return the points that satisfy the options, their observations that do, and their errors.

    Args:
        points: of the images.
        images: where they stand.
        pictures: of these.
        options: what points must satisfy.
        threads: number of threads to share the observations among; the answer does not depend on it.
    """
    errors_px = keypoint_errors_px(points, images, pictures, threads)
    fitting = points.paired(errors_px <= options.max_reprojection_error_px)  # false for NaN
    kept = points.taken(fitting)
    sums = np.bincount(kept.points_seen(), errors_px[fitting], kept.num_points)
    kept = replace(kept, errors_px=sums / kept.lengths())
    is_kept = _are_wide(kept, images.centers, options.min_triangulation_angle_deg, threads)
    is_kept &= kept.lengths() >= options.min_track_length
    return kept.taken(is_kept[kept.points_seen()])


def keypoint_errors_px(
    points: Points, images: Images, pictures: KeypointRays, threads: int = 1, *, ahead: bool = True
) -> FloatArray:
    """Return the distance of each observation from its point's projection, (o,); NaN where that is not seen.

    Not `ahead`: points behind a camera are projected too, as the formula of its lens has it. Threads share
    the images.
    """
    errors, of_images = np.empty(len(points.images)), RowLists.by_label(points.images, images.num_images)
    find_offsets = keypoint_offsets_px(points, images, pictures, ahead=ahead)
    slices = of_images.slices()

    def measure(run: tuple[int, int]) -> None:
        observed = {k: of_images.rows[slices[k]] for k in range(*run)}
        rows = of_images.rows[slices[run[0]].start : slices[run[1] - 1].stop]
        errors[rows] = np.linalg.norm(find_offsets(observed)[1], axis=1)

    for _ in in_threads(threads, measure, lens_runs(images.lens_of, of_images.lengths())):
        pass
    return errors


def keypoint_offsets_px(
    points: Points, images: Images, pictures: KeypointRays, *, ahead: bool = True
) -> Callable[[Mapping[int, IntArray]], tuple[FloatArray, FloatArray]]:
    """Return what gives the pixels (k, 2) of observations through one lens, and the offsets of these (k, 2).

    The observations are rows, by image. An offset leads from the keypoint to where its point is projected,
    as in `keypoint_errors_px`.
    """
    seen, rotations, centers = points.points_seen(), images.rotations, images.centers

    def find_offsets(observed: Mapping[int, IntArray]) -> tuple[FloatArray, FloatArray]:
        in_cameras, seen_px, first = [], [], next(iter(observed))
        for image, rows in observed.items():
            with np.errstate(invalid="ignore"):  # a point that is not finite
                own = points.xyz.take(seen.take(rows), axis=0) - centers[image]
                in_cameras.append(own @ rotations[image].T)
            seen_px.append(pictures.pixels(image, points.keypoints[rows]))
        found = pictures.project(first, np.concatenate(in_cameras), ahead=ahead)
        pixels, lens = np.concatenate(seen_px), images.lenses[images.lens_of[first]]
        return pixels, lens.offsets_px(found, pixels)

    return find_offsets


def _are_wide(points: Points, centers: FloatArray, least_deg: float, threads: int) -> BoolArray:
    """Return which points two of their observations see under an angle, or its supplement, of so much."""
    wide, cosine = np.zeros(points.num_points, dtype=np.bool_), np.cos(np.radians(least_deg))

    def look(ends: tuple[int, int]) -> None:
        begin, end = ends
        offsets = points.offsets[begin : end + 1]
        lengths, images = np.diff(offsets), points.images[offsets[0] : offsets[-1]]
        rays = centers.take(images, axis=0) - np.repeat(points.xyz[begin:end], lengths, axis=0)
        with np.errstate(invalid="ignore"):
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        for first in range(int(lengths.max(initial=1)) - 1):
            left = np.flatnonzero(~wide[begin:end] & (lengths > first + 1))  # a few, after the first round
            own, counts = offsets[left] - offsets[0] + first, lengths[left] - first - 1
            others = np.repeat(own + 1 - offsets_of(counts)[:-1], counts)
            ahead = rays.take(others + np.arange(len(others)), axis=0)
            cosines = np.abs(np.einsum("pa,pa->p", np.repeat(rays[own], counts, axis=0), ahead))
            wide[begin + np.repeat(left, counts)[cosines <= cosine]] = True

    for _ in in_threads(threads, look, batch_ranges(points.lengths(), 100_000)):  # so that few rays are held
        pass
    return wide
