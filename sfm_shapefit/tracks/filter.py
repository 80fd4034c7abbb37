"""Observations and points that do not fit are filtered, by COLMAP's rules.

In this order: observations that their camera does not see or that miss by too much; points left with fewer
than two; points without triangulation angle (a point that is not finite has none); short tracks.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.executors import in_threads
from sfm_shapefit.base.lists import offsets_of
from sfm_shapefit.scene.matches import batch_ranges, lens_runs
from sfm_shapefit.scene.points import Points
from sfm_shapefit.scene.structure import Structure
from sfm_shapefit.tracks.structure_options import StructureOptions


def filter_points(structure: Structure, options: StructureOptions, threads: int = 1) -> Points:
    """Return the points that satisfy the options, their observations that do, and their errors."""
    points = structure.points
    errors_px = keypoint_errors_px(structure, threads=threads)
    fitting = points.paired(errors_px <= options.max_reprojection_error_px)  # false for NaN
    errors_px[~fitting] = 0.0
    sums = np.bincount(points.points_seen(), errors_px, points.num_points)
    del errors_px
    lengths = points.count(fitting)
    rays = fitting, lengths, structure.images.centers
    is_kept = _are_wide(points, rays, options.min_triangulation_angle_deg, threads)
    is_kept &= lengths >= max(options.min_track_length, 1)
    points = replace(points, errors_px=sums / np.maximum(lengths, 1))
    return points.taken(fitting & is_kept[points.points_seen()])


def keypoint_errors_px(structure: Structure, *, ahead: bool = True, threads: int = 1) -> FloatArray:
    """Return the distance of each observation from its point's projection, (o,); NaN where that is not seen.

    Not `ahead`: points behind a camera are projected too, as the formula of its lens has it.
    """
    errors, every = np.empty(len(structure.points.images)), np.arange(structure.images.num_images)
    for rows, offsets_px in keypoint_offsets_px(structure, every, ahead=ahead, threads=threads):
        errors[rows] = np.linalg.norm(offsets_px, axis=1)
    return errors


def keypoint_offsets_px(
    structure: Structure, chosen: IntArray, *, ahead: bool = True, threads: int = 1
) -> Iterator[tuple[IntArray, FloatArray]]:
    """Yield the observations (k,) of chosen images, one after the other, some at a time, and their offsets.

    An offset (k, 2) leads from the keypoint to where its point is projected, as in `keypoint_errors_px`.
    """
    points, images, rows_of = structure.points, structure.images, structure.rows_of_images
    seen, rotations, centers, pixels = (
        points.points_seen(),
        images.rotations,
        images.centers,
        structure.pixels,
    )

    def project(some: IntArray) -> tuple[IntArray, FloatArray]:
        observed, lens = rows_of.subset(some), images.lenses[images.lens_of[some[0]]]
        in_camera = points.xyz.take(seen.take(observed.rows), axis=0)
        for image, own in zip(some.tolist(), observed.slices(), strict=True):
            with np.errstate(invalid="ignore"):  # a point that is not finite
                in_camera[own] = (in_camera[own] - centers[image]) @ rotations[image].T
        found = structure.pictures.project(int(some[0]), in_camera, ahead=ahead)
        return observed.rows, lens.offsets_px(found, pixels[observed.rows])

    runs = lens_runs(images.lens_of[chosen], rows_of.lengths()[chosen])
    return in_threads(threads, project, (chosen[begin:end] for begin, end in runs))


def _are_wide(
    points: Points, seen: tuple[BoolArray, IntArray, FloatArray], least_deg: float, threads: int
) -> BoolArray:
    """Return which points two observations see under an angle, or its supplement, of so much.

    Seen are chosen observations (o,), so many of each point (x,), from the centers (i, 3) of the images.
    """
    wide, cosine = np.zeros(points.num_points, dtype=np.bool_), np.cos(np.radians(least_deg))
    chosen, counts, centers = seen

    def look(ends: tuple[int, int]) -> None:
        begin, end = ends
        own_rows = slice(points.offsets[begin], points.offsets[end])
        lengths, images = counts[begin:end], points.images[own_rows][chosen[own_rows]]
        offsets = offsets_of(lengths)
        rays = centers.take(images, axis=0) - np.repeat(points.xyz[begin:end], lengths, axis=0)
        with np.errstate(invalid="ignore"):
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        for first in range(int(lengths.max(initial=1)) - 1):
            left = np.flatnonzero(~wide[begin:end] & (lengths > first + 1))  # a few, after the first round
            own, others_of = offsets[left] + first, lengths[left] - first - 1
            others = np.repeat(own + 1 - offsets_of(others_of)[:-1], others_of)
            ahead = rays.take(others + np.arange(len(others)), axis=0)
            cosines = np.abs(np.einsum("pa,pa->p", np.repeat(rays[own], others_of, axis=0), ahead))
            wide[begin + np.repeat(left, others_of)[cosines <= cosine]] = True

    for _ in in_threads(threads, look, batch_ranges(counts, 100_000)):  # so that few rays are held
        pass
    return wide
