"""Triangulation: the 3D points of a model at given poses.

Tracks come from one of two sources:

    matches                  of a database; they are joined to tracks by whether they fit the given poses,
                             and each track becomes the points that explain it (`adjustment.triangulation`).
                             All in memory: no database is opened.
    another reconstruction   the input's own points: each track is triangulated afresh (LO-RANSAC over its
                             observations) and keeps its point id.

Whatever survives fits its observations to `max_reprojection_error_px`, lies in front of the cameras that
see it, and is seen under at least `min_triangulation_angle_deg` by two of them.

COLMAP's incremental triangulator makes points of matches too. It goes from image to image through one graph
of all of them, takes about twice as long, and 40 bytes of memory a match instead of 8. Beside it, points
from matches fit better here: on fountain-P11, Herz-Jesus-P25, castle-P30 and lego100 there are 0.5, 0.7, 0.8
and 4.3 % more observations, with mean errors of 0.44 instead of 0.53, 0.58 (0.71), 0.41 (0.51) and 0.47 px
(0.65). The mean length of tracks is 4.60 (4.54), 5.64 (5.54), 4.91 (4.95) and 4.59 (4.66). A bundle
adjustment by Ceres, with and without a robust loss, then ends at mean errors between 6 % more
(Herz-Jesus-P25) and 21 % less (liberty-calibrated) than from the points of that triangulator.

No sample is random: the same input gives the same bits. Tracks know nothing of one another, so an executor's
workers may share them, with the same bits again.

Source: Schoenberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016, section 4.3.
"""

import math
from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.adjustment.filter import filter_in_place
from sfm_shapefit.adjustment.sources import TrackSource
from sfm_shapefit.adjustment.views import add_points, read_frames
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.executors import Advance, answers, nobody
from sfm_shapefit.base.heap import hand_back_memory
from sfm_shapefit.files.colmap.model import UInt64Array, observed_points, points2d_xy, sort_observations
from sfm_shapefit.files.colmap.seed import copy_without_points
from sfm_shapefit.tracks.links import CameraPoses, JoinedRows, MatchedKeypoints, ObservedTracks
from sfm_shapefit.tracks.options import StructureOptions
from sfm_shapefit.tracks.triangulation import (
    PointLimits,
    TriangulatedPoints,
    joining_limits_px,
    triangulate_tracks,
)

# Tracks that are triangulated and become Python objects at a time; the answer does not depend on it.
_TRACKS_A_BLOCK = 20_000
# Of another model, so many tracks are about half a second of work.
_TRACKS_A_TASK = 1000
# It is without effect in pycolmap 4.2, which tries pairs of observations in a fixed order.
_RANDOM_SEED = 0


def triangulate(
    seed: pycolmap.Reconstruction,
    tracks: TrackSource,
    options: StructureOptions | None = None,
    advance: Advance = nobody,
    executor: Executor | None = None,
) -> pycolmap.Reconstruction:
    """Return a copy of `seed` whose 3D points are triangulated at its poses; old points are dropped.

    Args:
        seed: the placed images. For tracks of another model, its points2D must be that model's.
        tracks: matches from `collect_matches`, or the reconstruction whose own tracks serve.
        options: filters; the defaults if None.
        advance: called with the images, or tracks, that are done and their number.
        executor: shares out the tracks among its workers, with the same answer to the bit.

    Returns:
        A new reconstruction with errors of points updated. Points from another model's tracks have that
        model's ids and colors; points from matches are black (see `color_points`).

    Raises:
        ValueError: if a track of the other model observes a point2D that `seed` does not have.
        WorkerError: if a worker died and the executor does not replace it.
    """
    structure, options = copy_without_points(seed), options or StructureOptions()
    triangulate_in_place(structure, tracks, options, advance, executor)
    filter_in_place(structure, options)
    return structure


def triangulate_in_place(
    structure: pycolmap.Reconstruction,
    tracks: TrackSource,
    options: StructureOptions,
    advance: Advance,
    executor: Executor | None = None,
) -> None:
    """Add points to a model of our own that has none, as `triangulate` does, and filter none of them.

    A copy of a large model takes gigabytes, and so do the tracks, which the filter does not need any more.
    """
    if isinstance(tracks, MatchedKeypoints):
        _triangulate_matches(structure, tracks, options, advance, executor)
    else:
        _triangulate_tracks(structure, tracks, options, advance, executor)


def _triangulate_matches(
    structure: pycolmap.Reconstruction,
    matched: MatchedKeypoints,
    options: StructureOptions,
    advance: Advance,
    executor: Executor | None,
) -> None:
    """Add to `structure` the points of all matches, a block of tracks at a time.

    By COLMAP's rule a track of two keypoints that are matched with no other one is left out. `advance` hears
    of the tracks of the first joining.
    """
    frames = read_frames(structure)
    limits = PointLimits(
        max_error_px=options.max_reprojection_error_px,
        min_angle_deg=options.min_triangulation_angle_deg,
        min_length=options.min_track_length,
    )
    joining_limits = tuple(joining_limits_px(limits.max_error_px, limits.max_error_px))
    poses, partners = frames.poses(), matched.count_partners()
    fewest = options.fewest_views(len(frames.image_ids))
    is_left = np.ones(len(partners), dtype=np.bool_)
    for limit_px in joining_limits:
        matched, partners = matched.among(is_left), partners[is_left]
        hand_back_memory()  # before the rays of all keypoints take some
        joined = matched.join(poses, limit_px)
        if limit_px < joining_limits[-1]:  # two keypoints may find a third one in the next joining
            sizes = np.diff(joined.offsets)
        else:  # of two keypoints 2 if they have no other partner, 3 or more if one has
            sizes = np.diff(np.append(0, np.cumsum(partners[joined.rows]))[joined.offsets])
        chosen, is_left = np.flatnonzero(sizes >= fewest), np.ones_like(partners, dtype=np.bool_)
        tasks, done = _cut_tracks(matched, joined, chosen, poses, limits), 0
        for task, found in answers(executor, triangulate_block, tasks):
            add_points(structure, frames, task.tracks, found)
            is_left[task.rows[found.points_seen >= 0]] = False
            done += task.tracks.num_tracks
            if limit_px == joining_limits[0]:  # nearly all tracks
                advance(done, len(chosen))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BlockTask:
    """Some tracks of matches, and all that is needed to triangulate them elsewhere."""

    rows: IntArray
    """(m,) which of all matched keypoints each observation is."""
    tracks: ObservedTracks
    poses: CameraPoses
    limits: PointLimits


def _cut_tracks(
    matched: MatchedKeypoints, joined: JoinedRows, chosen: IntArray, poses: CameraPoses, limits: PointLimits
) -> Iterator[BlockTask]:
    """Yield the chosen ones of the joined tracks, a block at a time."""
    for first in range(0, len(chosen), _TRACKS_A_BLOCK):
        block = joined.subset(chosen[first : first + _TRACKS_A_BLOCK])
        yield BlockTask(rows=block.rows, tracks=matched.observed(block), poses=poses, limits=limits)


def triangulate_block(task: BlockTask) -> TriangulatedPoints:
    """Return the points of a task's tracks; what a worker runs."""
    return triangulate_tracks(task.tracks, task.poses, task.limits)


def _triangulate_tracks(
    structure: pycolmap.Reconstruction,
    source: pycolmap.Reconstruction,
    options: StructureOptions,
    advance: Advance,
    executor: Executor | None,
) -> None:
    """Add to our own `structure` the points of another model, each triangulated from its own track."""
    registered = sorted(structure.reg_image_ids())
    parts = []
    for image_id in registered:
        image = structure.image(image_id)
        if image.num_points2D() != source.image(image_id).num_points2D():
            raise ValueError(f"image {image_id} has other points2D than the model whose tracks are used")
        keypoints, ids = observed_points(source.image(image_id))
        parts.append((ids, keypoints, points2d_xy(image)[keypoints]))
    observations = _Observations(*sort_observations(parts))
    _, firsts, lengths = np.unique(observations.points, return_index=True, return_counts=True)
    is_long = lengths >= options.min_track_length
    tracks = [slice(first, first + k) for first, k in zip(firsts[is_long], lengths[is_long], strict=True)]
    poses = [structure.image(i).cam_from_world() for i in registered]
    cameras = [structure.camera(structure.image(i).camera_id) for i in registered]
    tasks = (
        TrackTask(
            poses=poses,
            cameras=cameras,
            tracks=[(observations.images[track], observations.xy[track]) for track in chosen],
            options=options,
        )
        for chosen in (tracks[k : k + _TRACKS_A_TASK] for k in range(0, len(tracks), _TRACKS_A_TASK))
    )
    done = 0
    for _, part in answers(executor, triangulate_task, tasks):
        for track, found in zip(tracks[done : done + len(part)], part, strict=True):
            if found is None:
                continue
            xyz, inliers = found
            seen = np.flatnonzero(inliers) + track.start
            at = zip(observations.images[seen].tolist(), observations.keypoints[seen].tolist(), strict=True)
            elements = pycolmap.Track([pycolmap.TrackElement(registered[i], k) for i, k in at])
            point_id = int(observations.points[track.start])
            color = source.point3D(point_id).color
            structure.add_point3D_with_id(point_id, pycolmap.Point3D(xyz=xyz, color=color, track=elements))
        done += len(part)
        advance(done, len(tracks))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackTask:
    """Some tracks, and all that is needed to triangulate them elsewhere."""

    poses: list[pycolmap.Rigid3d]
    cameras: list[pycolmap.Camera]
    tracks: list[tuple[IntArray, FloatArray]]
    """Images (k,), as positions in the two lists, and pixels (k, 2) of each."""
    options: StructureOptions


def triangulate_task(task: TrackTask) -> list[tuple[FloatArray, BoolArray] | None]:
    """Return position (3,) and inliers (k,) of each track, None where it has no point; for a worker."""
    settings = pycolmap.EstimateTriangulationOptions()
    settings.min_tri_angle = math.radians(task.options.min_triangulation_angle_deg)
    settings.residual_type = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
    settings.ransac.max_error = task.options.max_reprojection_error_px
    settings.ransac.random_seed = _RANDOM_SEED
    found = []
    for images, xy in task.tracks:
        poses, cameras = ([every[i] for i in images.tolist()] for every in (task.poses, task.cameras))
        answer = pycolmap.estimate_triangulation(xy, poses, cameras, settings)
        found.append(None if answer is None else (answer["xyz"], answer["inliers"]))
    return found


class _Observations(NamedTuple):
    """What the registered images of one model see of another's 3D points, sorted by point, then by image."""

    points: UInt64Array
    """(O,) id of the 3D point."""
    images: IntArray
    """(O,) position of the image in the list of registered ones."""
    keypoints: IntArray
    """(O,) index into the image's points2D."""
    xy: FloatArray
    """(O, 2) pixels of that point."""
