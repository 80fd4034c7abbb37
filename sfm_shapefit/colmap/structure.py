"""Structure: 3D points triangulated at given poses, filtered, and colored like the input's.

Tracks come from one of two sources:

    matches                  of a database; COLMAP's incremental triangulator grows, completes and merges
                             tracks at the given poses. All in memory: no database is opened.
    another reconstruction   the input's own points: each track is triangulated afresh (LO-RANSAC over its
                             observations) and keeps its point id.

Whatever survives fits its observations to `max_reprojection_error_px`, lies in front of the cameras that
see it, and is seen under at least `min_triangulation_angle_deg` by two of them.

Everything is single-threaded and no sample is random: the same input gives the same bits. The tracks of
another reconstruction know nothing of one another, so an executor's workers may share them, with the same
bits again. COLMAP's triangulator goes from image to image through one graph of all matches, and tries pairs
again by the share of their matches that has become points, so its work cannot be cut without another answer.

Source: Schoenberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016, section 4.3; the triangulation
primitives are pycolmap's.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pycolmap

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.colmap.model import UInt64Array, observed_points, points2d_xy, sort_observations
from sfm_shapefit.colmap.seed import copy_without_points
from sfm_shapefit.colmap.structure_options import StructureOptions
from sfm_shapefit.directions.matches import KeypointMatches
from sfm_shapefit.errors import InputError
from sfm_shapefit.executors import answers


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageMatches:
    """The matches between images by their ids, M in all, eight bytes each."""

    image_pairs: IntArray
    """(k, 2) ids of the images of each pair."""
    offsets: IntArray
    """(k + 1,) the matches of pair p are rows offsets[p] to offsets[p + 1]."""
    keypoints: npt.NDArray[np.uint32]
    """(M, 2) index of the keypoint in the first image and in the second."""


TrackSource = ImageMatches | pycolmap.Reconstruction
"""Where tracks come from: matches, or the points of another model with the same points2D."""

Advance = Callable[[int, int], None]
"""Called with the work done so far and the work in all."""

# Pairs of images whose matches are looked at together.
_PAIRS_A_SLICE = 1000
# Errors at the limit are left to the triangulator, whose sums are other ones.
_ROUNDING = 1e-9
# So many tracks are about half a second of work.
_TRACKS_A_TASK = 1000
# It is without effect in pycolmap 4.2, which tries pairs of observations in a fixed order.
_RANDOM_SEED = 0
# The triangulator only asks that there is a configuration of the two-view geometry.
_CALIBRATED = 2


def collect_matches(
    seed: pycolmap.Reconstruction, image_ids: IntArray, batches: Iterable[KeypointMatches]
) -> ImageMatches:
    """Return all matches between registered images; batches are consumed one at a time.

    Args:
        seed: the placed images, with the points2D that the matches refer to.
        image_ids: (n,) ids of the images that the batches' pairs index (`PosedModel.image_ids`).
        batches: matches; pairs with an image that is not registered in `seed` are skipped.

    Raises:
        InputError: if a match refers to a keypoint that its image does not have.
    """
    registered = np.isin(image_ids, sorted(seed.reg_image_ids()))
    images = [
        seed.image(i) if is_in else None for i, is_in in zip(image_ids.tolist(), registered, strict=True)
    ]
    num_keypoints = np.array([0 if image is None else image.num_points2D() for image in images])
    pairs, counts, keypoints = [], [], list[npt.NDArray[np.uint32]]()
    for batch in batches:
        kept = registered[batch.pairs].all(axis=1)
        lengths = np.diff(batch.offsets)
        ends, own = batch.pairs[kept], batch.keypoints
        if not kept.all():
            own = own[np.repeat(kept, lengths)]
        counts.append(lengths[kept])
        missing = (own >= np.repeat(num_keypoints[ends], counts[-1], axis=0)).any(axis=1)
        if missing.any():
            pair = np.repeat(np.arange(len(ends)), counts[-1])[np.argmax(missing)]
            names = " and ".join(seed.image(i).name for i in image_ids[ends[pair]].tolist())
            raise InputError(
                f"the pair {names} has matches of keypoints that do not exist; match the images again"
            )
        pairs.append(image_ids[ends])
        keypoints.append(own.astype(np.uint32))
    return ImageMatches(
        image_pairs=np.concatenate([np.zeros((0, 2), dtype=np.int64), *pairs]),
        offsets=np.append(0, np.cumsum(np.concatenate([np.zeros(0, dtype=np.int64), *counts]))),
        keypoints=_concatenate(keypoints),
    )


def _concatenate(parts: list[npt.NDArray[np.uint32]]) -> npt.NDArray[np.uint32]:
    """Return all rows (M, 2). Each part is given up once it is copied, for matches take much memory twice."""
    rows = np.empty((sum(map(len, parts)), 2), dtype=np.uint32)
    end = len(rows)
    while parts:
        part = parts.pop()
        rows[end - len(part) : end] = part
        end -= len(part)
    return rows


def correspondence_graph(
    seed: pycolmap.Reconstruction, matches: ImageMatches
) -> pycolmap.CorrespondenceGraph:
    """Return the matches between the registered images as pycolmap wants them, about 40 bytes each."""
    graph, registered = pycolmap.CorrespondenceGraph(), sorted(seed.reg_image_ids())
    for image_id in registered:
        graph.add_image(image_id, seed.image(image_id).num_points2D())
    known = np.isin(matches.image_pairs, registered).all(axis=1)
    for pair in np.flatnonzero(known).tolist():
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = _CALIBRATED
        geometry.inlier_matches = matches.keypoints[matches.offsets[pair] : matches.offsets[pair + 1]]
        first, second = matches.image_pairs[pair].tolist()
        graph.add_two_view_geometry(first, second, geometry)
    graph.finalize()
    return graph


def triangulate(
    seed: pycolmap.Reconstruction,
    tracks: TrackSource,
    options: StructureOptions | None = None,
    advance: Advance | None = None,
    executor: Executor | None = None,
    *,
    in_place: bool = False,
) -> pycolmap.Reconstruction:
    """Return a copy of `seed` whose 3D points are triangulated at its poses; old points are dropped.

    Args:
        seed: the placed images. For tracks of another model, its points2D must be that model's.
        tracks: matches from `collect_matches`, or the reconstruction whose own tracks serve.
        options: filters; the defaults if None.
        advance: called with the images, or tracks, that are done and their number.
        executor: shares out the tracks of another model among its workers; no use for matches.
        in_place: return `seed` itself, which must be without points: a copy of a large model takes gigabytes.

    Returns:
        A new reconstruction with errors of points updated. Points from another model's tracks have that
        model's ids and colors; points from matches are black (see `color_points`).

    Raises:
        ValueError: if a track of the other model observes a point2D that `seed` does not have.
        WorkerError: if a worker died and the executor does not replace it.
    """
    options, advance = options or StructureOptions(), advance or (lambda _done, _total: None)
    structure = seed if in_place else copy_without_points(seed)
    if isinstance(tracks, ImageMatches):
        _triangulate_matches(structure, tracks, options, advance)
    else:
        _triangulate_tracks(structure, tracks, options, advance, executor)
    filter_in_place(structure, options)
    return structure


def filter_points(
    reconstruction: pycolmap.Reconstruction, options: StructureOptions | None = None
) -> pycolmap.Reconstruction:
    """Return a copy without the observations and points that violate `options`, its point errors updated.

    In this order: observations behind their camera or with a large reprojection error; points left with one
    observation; points without triangulation angle (the angle of a point that is not finite is NaN, which
    is none); short tracks.
    """
    result = pycolmap.Reconstruction(reconstruction)
    filter_in_place(result, options or StructureOptions())
    return result


def color_points(
    reconstruction: pycolmap.Reconstruction, source: pycolmap.Reconstruction, *, in_place: bool = False
) -> pycolmap.Reconstruction:
    """Return a copy whose points take the mean color of the source's points seen at the same points2D.

    Images take part if their points2D are the same in both, in number and coordinates. Points without
    any common observation keep their color. A source without any color costs no copy: the
    `reconstruction` itself is returned. So it is `in_place`, colored: a copy of a large one is large.
    """
    if not any(point.color.any() for point in source.points3D.values()):
        return reconstruction
    result = reconstruction if in_place else pycolmap.Reconstruction(reconstruction)
    ids, source_ids = (np.array(sorted(model.point3D_ids()), dtype=np.uint64) for model in (result, source))
    colors = np.array([source.point3D(i).color for i in source_ids.tolist()], dtype=np.float64).reshape(-1, 3)
    sums, counts = np.zeros((len(ids), 3)), np.zeros(len(ids), dtype=np.int64)
    for our, their in _common_observations(result, source):
        rows = np.searchsorted(ids, our)
        np.add.at(sums, rows, colors[np.searchsorted(source_ids, their)])
        np.add.at(counts, rows, 1)
    seen = counts > 0
    our_ids, means = ids[seen], np.rint(sums[seen] / counts[seen, None]).astype(np.uint8)
    for point_id, mean in zip(our_ids.tolist(), means, strict=True):
        result.point3D(point_id).color = mean
    return result


# --- triangulation ---------------------------------------------------------------------------------


def filter_in_place(structure: pycolmap.Reconstruction, options: StructureOptions) -> None:
    """Do to our own `structure` what `filter_points` does to a copy; update the errors of points."""
    manager = pycolmap.ObservationManager(structure)
    manager.filter_all_points3D(options.max_reprojection_error_px, options.min_triangulation_angle_deg)
    manager.filter_points3D_with_short_tracks(options.min_track_length)


def _triangulate_matches(
    structure: pycolmap.Reconstruction, matches: ImageMatches, options: StructureOptions, advance: Advance
) -> None:
    """Add to our own `structure` the points of all matches, tracks completed and merged."""
    error_px = options.max_reprojection_error_px
    graph = correspondence_graph(structure, matches)
    settings = pycolmap.IncrementalTriangulatorOptions()
    settings.random_seed = _RANDOM_SEED
    settings.ignore_two_view_tracks = options.fewest_views(structure.num_reg_images()) > 2
    settings.min_angle = options.min_triangulation_angle_deg
    settings.complete_max_reproj_error = error_px
    settings.merge_max_reproj_error = error_px
    manager = pycolmap.ObservationManager(structure, graph)
    triangulator = pycolmap.IncrementalTriangulator(graph, structure, manager)
    registered = sorted(structure.reg_image_ids())
    for done, image_id in enumerate(registered, start=1):
        triangulator.triangulate_image(settings, image_id)
        # A track that is not completed at once is found again, in pieces, from each of its other images.
        triangulator.complete_tracks(settings, triangulator.get_modified_points3D())
        triangulator.clear_modified_points3D()
        advance(done, len(registered))
    triangulator.complete_all_tracks(settings)
    triangulator.merge_tracks(settings, _find_mergeable(structure, matches, error_px))
    triangulator.retriangulate(settings)


def _find_mergeable(
    structure: pycolmap.Reconstruction, matches: ImageMatches, max_error_px: float
) -> set[int]:
    """Return the ids of the points that a match joins to another one that may be the same.

    Two points are merged if all observations of both fit the mean of them, weighted by the lengths of their
    tracks. So the two observations of the match have to. pycolmap's `merge_all_tracks` instead walks from
    every observation of every point to all that it is matched with, which takes longer than all the rest.
    """
    image_ids = sorted(structure.reg_image_ids())
    images = [structure.image(i) for i in image_ids]
    begins = np.append(0, np.cumsum([image.num_points2D() for image in images]))
    joined, seen = _joined_points(images, np.array(image_ids), begins, matches)
    pairs, rows = np.unique(np.sort(joined, axis=1), axis=0, return_index=True)
    ids, places = np.unique(pairs, return_inverse=True)
    points = [structure.point3D(i) for i in ids.tolist()]
    xyz = np.array([point.xyz for point in points]).reshape(-1, 3)
    lengths = np.array([point.track.length() for point in points], dtype=np.float64)
    places = places.reshape(-1, 2)
    weights = lengths[places] / lengths[places].sum(axis=1, keepdims=True)
    means = np.einsum("pk,pka->pa", weights, xyz[places])
    fits = np.ones(len(pairs), dtype=np.bool_)
    for keypoints in seen[rows].T:
        of_image = np.searchsorted(begins, keypoints, side="right") - 1
        order = np.argsort(of_image, kind="stable")
        ends = np.searchsorted(of_image[order], np.arange(len(images) + 1)).tolist()
        for k, image in enumerate(images):
            own = order[ends[k] : ends[k + 1]]
            if len(own):
                fits[own] &= _fits(structure, image, keypoints[own] - begins[k], means[own], max_error_px)
    return set(pairs[fits].ravel().tolist())


def _joined_points(
    images: Sequence[pycolmap.Image], image_ids: IntArray, begins: IntArray, matches: ImageMatches
) -> tuple[IntArray, IntArray]:
    """Return the ids of the points that matches join to other ones, (j, 2), and the keypoints of the matches.

    Keypoints are numbered through all images, those of an image from its entry in `begins` on.
    """
    point_of = np.full(int(begins[-1]), -1, dtype=np.int64)
    for begin, image in zip(begins[:-1].tolist(), images, strict=True):
        keypoints, ids = observed_points(image)
        point_of[begin + keypoints] = ids.astype(np.int64)
    joined, seen = [np.zeros((0, 2), dtype=np.int64)], [np.zeros((0, 2), dtype=np.int64)]
    known: BoolArray = np.asarray(np.isin(matches.image_pairs, image_ids).all(axis=1))
    firsts = begins[np.searchsorted(image_ids, np.where(known[:, None], matches.image_pairs, image_ids[0]))]
    for first in range(0, len(known), _PAIRS_A_SLICE):
        pairs = slice(first, first + _PAIRS_A_SLICE)
        bounds = matches.offsets[first : first + _PAIRS_A_SLICE + 1]
        counts = np.diff(bounds)
        ends = matches.keypoints[bounds[0] : bounds[-1]] + np.repeat(firsts[pairs], counts, axis=0)
        ends = ends[np.repeat(known[pairs], counts)]
        points = point_of[ends]
        differ = (points >= 0).all(axis=1) & (points[:, 0] != points[:, 1])
        joined.append(points[differ])
        seen.append(ends[differ])
    return np.concatenate(joined), np.concatenate(seen)


def _fits(
    structure: pycolmap.Reconstruction,
    image: pycolmap.Image,
    keypoints: IntArray,
    points: FloatArray,
    max_error_px: float,
) -> BoolArray:
    """Return which of the points (k, 3) an image has at its keypoints (k,)."""
    pose = image.cam_from_world()
    local = points @ pose.rotation.matrix().T + pose.translation
    found = np.asarray(structure.camera(image.camera_id).img_from_cam(local), dtype=np.float64).reshape(-1, 2)
    errors = np.linalg.norm(found - points2d_xy(image)[keypoints], axis=1)
    return np.asarray(errors <= max_error_px * (1.0 + _ROUNDING))


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
    answered = (
        map(triangulate_task, tasks) if executor is None else answers(executor, triangulate_task, tasks)
    )
    done = 0
    for part in answered:
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


# --- colors ---------------------------------------------------------------------------------------


def _common_observations(
    result: pycolmap.Reconstruction, source: pycolmap.Reconstruction
) -> Iterator[tuple[UInt64Array, UInt64Array]]:
    """Yield the ids of the two points that each points2D of an image observes, if it does in both models."""
    for image_id in sorted(result.reg_image_ids()):
        if not source.exists_image(image_id):
            continue
        our, their = result.image(image_id), source.image(image_id)
        if not np.array_equal(points2d_xy(our), points2d_xy(their)):
            continue
        our_keypoints, our_ids = observed_points(our)
        their_keypoints, their_ids = observed_points(their)
        _, left, right = np.intersect1d(
            our_keypoints, their_keypoints, assume_unique=True, return_indices=True
        )
        yield our_ids[left], their_ids[right]
