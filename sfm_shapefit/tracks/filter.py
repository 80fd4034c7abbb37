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
from sfm_shapefit.scene.matches import batch_ranges
from sfm_shapefit.scene.points import Points
from sfm_shapefit.scene.structure import Structure
from sfm_shapefit.tracks.structure_options import StructureOptions

_AT_ONCE = 50_000  # observations, seen through one lens, that are projected together; their arrays take 4 MB


def filter_points(structure: Structure, options: StructureOptions, threads: int = 1) -> Points:
    """Return the points that satisfy the options, their observations that do, and their errors."""
    points = structure.points
    errors_px = keypoint_errors_px(structure, threads=threads)
    fitting = points.paired(errors_px <= options.max_reprojection_error_px)  # false for NaN
    errors_px[~fitting] = 0.0
    sums = np.bincount(points.points_seen(), errors_px, points.num_points)
    del errors_px
    lengths, centers = points.count(fitting), structure.images.centers
    is_kept = _are_wide(points, fitting, lengths, centers, options.min_triangulation_angle_deg)
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
        in_camera = points.xyz[seen[observed.rows]]
        for image, own in zip(some.tolist(), observed.slices(), strict=True):
            with np.errstate(invalid="ignore"):  # a point that is not finite
                in_camera[own] = (in_camera[own] - centers[image]) @ rotations[image].T
        found = structure.pictures.project(int(some[0]), in_camera, ahead=ahead)
        return observed.rows, lens.offsets_px(found, pixels[observed.rows])

    part = np.cumsum(rows_of.lengths()[chosen]) // _AT_ONCE
    cuts = np.flatnonzero((np.diff(part) != 0) | (np.diff(images.lens_of[chosen]) != 0)) + 1
    return in_threads(threads, project, np.split(chosen, cuts) if len(chosen) else ())


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
