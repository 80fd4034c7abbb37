"""The points of a model's own tracks, each triangulated afresh at other poses by pycolmap.

LO-RANSAC over the observations of each track, which keeps its point's id and color. No sample is random: the
same input gives the same bits. Tracks know nothing of one another, so an executor's workers may share them,
with the same bits again.
"""

import math
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pycolmap

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.executors import Advance, answers
from sfm_shapefit.files.colmap.model import points2d_xy
from sfm_shapefit.files.colmap.points import points_of
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.points import Points

# Of another model, so many tracks are about half a second of work.
_TRACKS_A_TASK = 1000
# It is without effect in pycolmap 4.2, which tries pairs of observations in a fixed order.
_RANDOM_SEED = 0


class TrackRules(NamedTuple):
    """What a point must satisfy."""

    max_error_px: float
    """Largest reprojection error of an observation."""
    min_angle_deg: float
    """Least angle between two of its rays."""
    min_length: int
    """Fewest observations of its track."""


def triangulate_own_tracks(
    source: pycolmap.Reconstruction,
    images: Images,
    rules: TrackRules,
    advance: Advance,
    executor: Executor | None = None,
) -> Points:
    """Return the points of a model, each triangulated from its own track at other poses.

    Args:
        source: the model whose tracks serve; points keep its ids.
        images: those of it that are placed.
        rules: what points must satisfy.
        advance: called with the tracks that are done and their number.
        executor: shares out the tracks among its workers, with the same answer to the bit.

    Raises:
        WorkerError: if a worker died and the executor does not replace it.
    """
    seen, own = points_of(source, images), [source.image(i) for i in images.ids.tolist()]
    pixels = np.empty((len(seen.images), 2))
    for k, image in enumerate(own):
        rows = np.flatnonzero(seen.images == k)
        pixels[rows] = points2d_xy(image)[seen.keypoints[rows]]
    chosen = np.flatnonzero(seen.lengths() >= rules.min_length)
    slices = [slice(*seen.offsets[[k, k + 1]].tolist()) for k in chosen.tolist()]
    cameras = [source.camera(image.camera_id) for image in own]
    shifts = -np.einsum("iab,ib->ia", images.rotations, images.centers)
    turns = map(pycolmap.Rotation3d, images.rotations)
    poses = [pycolmap.Rigid3d(turn, shift) for turn, shift in zip(turns, shifts, strict=True)]
    tasks = (
        TrackTask(
            poses=poses,
            cameras=cameras,
            tracks=[(seen.images[track], pixels[track]) for track in part],
            rules=rules,
        )
        for part in (slices[k : k + _TRACKS_A_TASK] for k in range(0, len(slices), _TRACKS_A_TASK))
    )
    xyz, point_of, done = np.full((seen.num_points, 3), np.nan), np.full(len(pixels), -1), 0
    for _, found in answers(executor, triangulate_task, tasks):
        for k, answer in zip(chosen[done : done + len(found)].tolist(), found, strict=True):
            if answer is not None:
                xyz[k], inliers = answer
                point_of[seen.offsets[k] : seen.offsets[k + 1]][inliers] = k
        done += len(found)
        advance(done, len(slices))
    kept, rows = np.flatnonzero(np.isfinite(xyz[:, 0])), np.flatnonzero(point_of >= 0)
    return Points(
        xyz=xyz[kept],
        offsets=np.append(0, np.cumsum(np.bincount(point_of[rows], minlength=len(xyz))[kept])),
        images=seen.images[rows],
        keypoints=seen.keypoints[rows],
        ids=seen.ids[kept],
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrackTask:
    """Some tracks, and all that is needed to triangulate them elsewhere."""

    poses: list[pycolmap.Rigid3d]
    cameras: list[pycolmap.Camera]
    tracks: list[tuple[IntArray, FloatArray]]
    """Images (k,), as positions in the two lists, and pixels (k, 2) of each."""
    rules: TrackRules


def triangulate_task(task: TrackTask) -> list[tuple[FloatArray, BoolArray] | None]:
    """Return position (3,) and inliers (k,) of each track, None where it has no point; for a worker."""
    settings = pycolmap.EstimateTriangulationOptions()
    settings.min_tri_angle = math.radians(task.rules.min_angle_deg)
    settings.residual_type = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
    settings.ransac.max_error = task.rules.max_error_px
    settings.ransac.random_seed = _RANDOM_SEED
    found = []
    for images, xy in task.tracks:
        poses, cameras = ([every[i] for i in images.tolist()] for every in (task.poses, task.cameras))
        answer = pycolmap.estimate_triangulation(xy, poses, cameras, settings)
        found.append(None if answer is None else (answer["xyz"], answer["inliers"]))
    return found
