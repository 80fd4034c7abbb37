"""Structure: 3D points triangulated at given poses, filtered, and coloured like the input's.

Tracks come from one of two sources:

    a correspondence graph   matches of a database; COLMAP's incremental triangulator grows, completes and
                             merges tracks at the given poses. All in memory: no database is opened.
    another reconstruction   the input's own points: each track is triangulated afresh (LO-RANSAC over its
                             observations) and keeps its point id.

Whatever survives fits its observations to `max_reprojection_error_px`, lies in front of the cameras that
see it, and is seen under at least `min_triangulation_angle_deg` by two of them.

Everything is single-threaded and no sample is random: the same input gives the same bits.

Source: Schoenberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016, section 4.3; the triangulation
primitives are pycolmap's.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pycolmap

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.colmap.matches import MatchBatch
from sfm_shapefit.colmap.model import points2d_xy
from sfm_shapefit.colmap.seed import without_points
from sfm_shapefit.errors import InputError

TrackSource = pycolmap.CorrespondenceGraph | pycolmap.Reconstruction
"""Where tracks come from: matches, or the points of another model with the same points2D."""

_RANDOM_SEED = 0  # without effect today: pycolmap 4.2 tries pairs of observations in a fixed order
_CALIBRATED = 2  # TwoViewGeometry configuration; the triangulator only asks that there is one


@dataclass(frozen=True, slots=True, kw_only=True)
class StructureOptions:
    """What a 3D point must satisfy to stand in the output."""

    max_reprojection_error_px: float = 4.0
    """Observations with a larger reprojection error are removed, and points that lose all but one."""
    min_triangulation_angle_deg: float = 1.5
    """Points that no two cameras see under at least this angle are removed; their depth means little."""
    min_track_length: int = 2
    """Points seen in fewer images than this are removed; 2 or more."""
    ignore_two_view_tracks: bool = True
    """Leave out matches that only two images share: a wrong one is not noticed, since one epipolar
    constraint is all that checks it. Concerns matches of a database, not a model's own tracks."""

    def __post_init__(self) -> None:
        if not 0.0 < self.max_reprojection_error_px < math.inf:
            raise ValueError(
                "StructureOptions.max_reprojection_error_px must be positive and finite, "
                f"got {self.max_reprojection_error_px}"
            )
        if not 0.0 <= self.min_triangulation_angle_deg < 90.0:
            raise ValueError(
                "StructureOptions.min_triangulation_angle_deg must lie in [0, 90), "
                f"got {self.min_triangulation_angle_deg}"
            )
        if self.min_track_length < 2:
            raise ValueError(f"StructureOptions.min_track_length must be > 1, got {self.min_track_length}")


def correspondence_graph(
    seed: pycolmap.Reconstruction, image_ids: IntArray, batches: Iterable[MatchBatch]
) -> pycolmap.CorrespondenceGraph:
    """Return the graph of all matches between registered images; batches are consumed one at a time.

    Args:
        seed: the placed images, with the points2D that the matches refer to.
        image_ids: (n,) ids of the images that the batches' pairs index (`PosedModel.image_ids`).
        batches: matches; pairs with an image that is not registered in `seed` are skipped.

    Raises:
        InputError: if a match refers to a keypoint that its image does not have.
    """
    num_keypoints = {i: seed.image(i).num_points2D() for i in sorted(seed.reg_image_ids())}
    graph = pycolmap.CorrespondenceGraph()
    for image_id, count in num_keypoints.items():
        graph.add_image(image_id, count)
    for batch in batches:
        for pair, (i, j) in enumerate(image_ids[batch.pairs].tolist()):
            if i not in num_keypoints or j not in num_keypoints:
                continue
            matches = batch.keypoints[batch.offsets[pair] : batch.offsets[pair + 1]]
            if len(matches) and (matches >= (num_keypoints[i], num_keypoints[j])).any():
                names = f"{seed.image(i).name} and {seed.image(j).name}"
                raise InputError(
                    f"the pair {names} has matches of keypoints that do not exist; match the images again"
                )
            graph.add_two_view_geometry(i, j, _two_view_geometry(matches))
    graph.finalize()
    return graph


def triangulate(
    seed: pycolmap.Reconstruction, tracks: TrackSource, options: StructureOptions | None = None
) -> pycolmap.Reconstruction:
    """Return a copy of `seed` whose 3D points are triangulated at its poses; old points are dropped.

    Args:
        seed: the placed images. For tracks of another model, its points2D must be that model's.
        tracks: a graph from `correspondence_graph`, or the reconstruction whose own tracks serve.
        options: filters; the defaults if None.

    Returns:
        A new reconstruction with errors of points updated and colours black (see `colored`).

    Raises:
        ValueError: if a track of the other model observes a point2D that `seed` does not have.
    """
    options = options or StructureOptions()
    structure = without_points(seed)
    if isinstance(tracks, pycolmap.CorrespondenceGraph):
        _triangulate_matches(structure, tracks, options)
    else:
        _triangulate_tracks(structure, tracks, options)
    return filtered(structure, options)


def filtered(
    reconstruction: pycolmap.Reconstruction, options: StructureOptions | None = None
) -> pycolmap.Reconstruction:
    """Return a copy without the observations and points that violate `options`, its point errors updated.

    In this order: observations behind their camera or with a large reprojection error; points left with one
    observation; points without triangulation angle (the angle of a point that is not finite is NaN, which
    is none); short tracks.
    """
    options = options or StructureOptions()
    result = pycolmap.Reconstruction(reconstruction)
    manager = pycolmap.ObservationManager(result)
    manager.filter_all_points3D(options.max_reprojection_error_px, options.min_triangulation_angle_deg)
    manager.filter_points3D_with_short_tracks(options.min_track_length)
    result.update_point_3d_errors()
    return result


def colored(
    reconstruction: pycolmap.Reconstruction, source: pycolmap.Reconstruction
) -> pycolmap.Reconstruction:
    """Return a copy whose points take the mean colour of the source's points seen at the same points2D.

    Images take part if their points2D are the same in both, in number and coordinates. Points without
    any common observation keep their colour.
    """
    result = pycolmap.Reconstruction(reconstruction)
    ours, theirs = _Observations.of(result), _Observations.of(source)
    same = [i for i in np.unique(ours.image_ids).tolist() if _has_same_keypoints(result, source, i)]
    left, right = _common_observations(ours, theirs, same)
    source_colors = np.array([point.color for point in source.points3D.values()], dtype=np.float64)
    num_points = result.num_points3D()
    counts = np.bincount(ours.points[left], minlength=num_points)
    sums = np.zeros((num_points, 3))
    np.add.at(sums, ours.points[left], source_colors.reshape(-1, 3)[theirs.points[right]])
    means = np.rint(sums / np.maximum(counts, 1)[:, None]).astype(np.uint8)
    for row, point in enumerate(result.points3D.values()):
        if counts[row]:
            point.color = means[row]
    return result


# --- triangulation ---------------------------------------------------------------------------------


def _two_view_geometry(matches: IntArray) -> pycolmap.TwoViewGeometry:
    """Return a geometry that carries nothing but inlier matches (k, 2)."""
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = _CALIBRATED
    geometry.inlier_matches = matches.astype(np.uint32)
    return geometry


def _triangulate_matches(
    structure: pycolmap.Reconstruction, graph: pycolmap.CorrespondenceGraph, options: StructureOptions
) -> None:
    """Add to our own `structure` the points of all matches, tracks completed and merged."""
    error_px = options.max_reprojection_error_px
    settings = pycolmap.IncrementalTriangulatorOptions()
    settings.random_seed = _RANDOM_SEED
    settings.ignore_two_view_tracks = options.ignore_two_view_tracks
    settings.min_angle = options.min_triangulation_angle_deg
    settings.complete_max_reproj_error = error_px
    settings.merge_max_reproj_error = error_px
    manager = pycolmap.ObservationManager(structure, graph)
    triangulator = pycolmap.IncrementalTriangulator(graph, structure, manager)
    for image_id in sorted(structure.reg_image_ids()):
        triangulator.triangulate_image(settings, image_id)
    triangulator.complete_all_tracks(settings)
    triangulator.merge_all_tracks(settings)
    triangulator.retriangulate(settings)


def _triangulate_tracks(
    structure: pycolmap.Reconstruction, source: pycolmap.Reconstruction, options: StructureOptions
) -> None:
    """Add to our own `structure` the points of another model, each triangulated from its own track."""
    settings = pycolmap.EstimateTriangulationOptions()
    settings.min_tri_angle = math.radians(options.min_triangulation_angle_deg)
    settings.residual_type = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
    settings.ransac.max_error = options.max_reprojection_error_px
    settings.ransac.random_seed = _RANDOM_SEED
    registered = sorted(structure.reg_image_ids())
    images = {i: structure.image(i) for i in registered}
    poses = {i: image.cam_from_world() for i, image in images.items()}
    cameras = {i: structure.camera(image.camera_id) for i, image in images.items()}
    for image_id in registered:
        if structure.image(image_id).num_points2D() != source.image(image_id).num_points2D():
            raise ValueError(f"image {image_id} has other points2D than the model whose tracks are used")

    for point_id, point in sorted(source.points3D.items()):
        seen = [(e.image_id, e.point2D_idx) for e in point.track.elements if e.image_id in images]
        if len(seen) < options.min_track_length:
            continue
        xy = np.array([images[i].point2D(k).xy for i, k in seen])
        found = pycolmap.estimate_triangulation(
            xy, [poses[i] for i, _ in seen], [cameras[i] for i, _ in seen], settings
        )
        if found is not None:
            track = [e for e, inlier in zip(seen, found["inliers"], strict=True) if inlier]
            structure.add_point3D_with_id(point_id, _point(found["xyz"], track))


def _point(xyz: FloatArray, track: list[tuple[int, int]]) -> pycolmap.Point3D:
    """Return a point (3,) with the track [(image_id, point2D index), ...]."""
    elements = [pycolmap.TrackElement(image_id, index) for image_id, index in track]
    return pycolmap.Point3D(xyz=xyz, track=pycolmap.Track(elements))


# --- colours ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class _Observations:
    """All track elements of a reconstruction, in the order of its points."""

    points: IntArray
    """(O,) row of the point in the reconstruction's points3D."""
    image_ids: IntArray
    """(O,)"""
    keypoints: IntArray
    """(O,) index into the image's points2D."""

    @classmethod
    def of(cls, reconstruction: pycolmap.Reconstruction) -> "_Observations":
        """Collect the track elements."""
        rows = [
            (row, element.image_id, element.point2D_idx)
            for row, point in enumerate(reconstruction.points3D.values())
            for element in point.track.elements
        ]
        table = np.array(rows, dtype=np.int64).reshape(-1, 3)
        return cls(points=table[:, 0], image_ids=table[:, 1], keypoints=table[:, 2])

    def keys(self) -> IntArray:
        """Return one integer per observation, unique within a reconstruction."""
        return (self.image_ids << 32) | self.keypoints


def _common_observations(
    ours: _Observations, theirs: _Observations, image_ids: list[int]
) -> tuple[IntArray, IntArray]:
    """Return the positions of the observations that both have, restricted to the given images."""
    _, left, right = np.intersect1d(ours.keys(), theirs.keys(), return_indices=True)
    keep = np.isin(ours.image_ids[left], image_ids)
    return left[keep], right[keep]


def _has_same_keypoints(a: pycolmap.Reconstruction, b: pycolmap.Reconstruction, image_id: int) -> bool:
    """Tell whether an image has the same points2D in both reconstructions."""
    if not b.exists_image(image_id) or a.image(image_id).num_points2D() != b.image(image_id).num_points2D():
        return False
    return np.array_equal(points2d_xy(a.image(image_id)), points2d_xy(b.image(image_id)))
