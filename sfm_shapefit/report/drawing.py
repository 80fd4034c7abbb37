"""The drawing of a result: cameras, pairs and points as plain arrays. Page and mesh share it.

Rows of `Cameras` and `Pairs` are those of cameras.csv and pairs.csv, in their order, so that a drawing can be
made of a result in memory or of its files. Positions are in the output's units and axes; what has no
position holds NaN. Bare graphs of two dimensions lie in the plane z = 0, of more than three dimensions the
first three are drawn.
"""

import enum
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, quantile
from sfm_shapefit.base.geometry import angle_between_deg, fit_similarity_l1, normalized
from sfm_shapefit.facts.rows import covariances_of
from sfm_shapefit.facts.tables import CameraRow, PairRow, Table, contradicting, rejected
from sfm_shapefit.files.colmap.seed import PickedPoints
from sfm_shapefit.judgement.evidence import LensField
from sfm_shapefit.judgement.verdicts import Verdict
from sfm_shapefit.scene.images import Images

MAX_PAIRS = 20_000
"""Pairs that a page lists and draws; with more it opens slowly."""
MAX_POINTS = 20_000
"""Points that are drawn; more are thinned evenly."""
# Distance of a point from the median, in distances within which 90 % of points and cameras lie; points beyond
# would shrink the rest, and are left out.
_FAR_POINT = 4.0
_FRUSTUM_SHARE = 0.4  # depth of a frustum over the median distance between neighbors; frusta stay apart
_MEASURED = 200  # positions, at most twice as many; the median distance to their neighbors stands for all
_FRUSTUM_OF_EXTENT = (0.008, 0.05)  # limits of the depth, as shares of the extent; frusta stay visible
_HALF_SIZES = (0.15, 1.2)  # limits of half a picture's side over its focal length; a fisheye has no pyramid
_FEWEST_FITTED = 3  # common centers; fewer fix no similarity
_UPRIGHT = 0.1  # weight of "y axes point down" beside "x axes are level"; the second is the surer sign


class PairClass(enum.IntEnum):
    """What became of a pair, as the page counts and colors it."""

    AGREES = 0
    CONTRADICTS = 1
    UNDETERMINED = 2
    NO_DIRECTION = 3
    REJECTED = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Poses:
    """Poses and pictures of images, by row; NaN where they are not known."""

    rotations: FloatArray
    """(n, 3, 3) cam_from_world."""
    centers: FloatArray
    """(n, 3)"""
    half_sizes: FloatArray
    """(n, 2) half the width and height of the picture at distance 1, limited to what can be drawn."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cameras:
    """The n rows of cameras.csv."""

    names: tuple[str, ...]
    placed: BoolArray
    reasons: tuple[str, ...]
    pieces: IntArray
    """(n,) -1 where there is none."""
    degrees: IntArray
    trust: FloatArray
    centers: FloatArray
    """(n, 3)"""
    covariances: FloatArray
    """(n, 3, 3) covariances of the centers, in squared units of the output; NaN where they are not known."""
    poses: Poses
    """Rotations in the output's axes, pictures; `poses.centers` are the input's, in its own."""

    @property
    def sigmas(self) -> FloatArray:
        """(n,) largest standard deviation over the axes; NaN where it is not known."""
        return np.asarray(np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2).max(axis=1)))

    @property
    def ellipsoids(self) -> FloatArray:
        """(n, 3, 3) rows: half axes of the ellipsoids of one standard deviation, the longest last; or NaN."""
        axes = np.full(self.covariances.shape, np.nan)
        known = np.isfinite(self.covariances).all(axis=(1, 2))
        variances, vectors = np.linalg.eigh(self.covariances[known])
        lengths = np.sqrt(np.maximum(variances, 0.0))
        axes[known] = lengths[:, :, None] * vectors.transpose(0, 2, 1)
        return axes


class CameraColumn(NamedTuple):
    """A further column of the table of cameras, which can also color the scene."""

    title: str
    hint: str
    values: FloatArray
    """(n,) NaN where it is not known."""


class LensRow(NamedTuple):
    """A lens as the page lists it; lengths in pixels."""

    id: str
    model: str
    num_images: str
    size: str
    focal_length: str
    principal_point: str
    distortion: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pairs:
    """The m rows of pairs.csv."""

    cameras: IntArray
    """(m, 2) rows of `Cameras`."""
    classes: IntArray
    """(m,) values of `PairClass`."""
    support: IntArray
    weights: FloatArray
    leverages: FloatArray
    dual_norms: FloatArray
    residuals_deg: FloatArray
    """(m,) at the output's centers."""
    certified_deg: FloatArray
    """(m,) at the convex optimum, before any refinement; NaN where it is not known."""
    input_deg: FloatArray
    """(m,) at the input's centers; NaN where those mean nothing."""
    reasons: tuple[str, ...]

    def per_camera(self, num_cameras: int) -> tuple[IntArray, FloatArray]:
        """Return how many pairs of each camera agree, and the median residual of its pairs, NaN of none."""
        ends = self.cameras.ravel()
        agrees = np.repeat(self.classes == PairClass.AGREES, 2)
        residuals = np.repeat(self.residuals_deg, 2)
        known = np.isfinite(residuals)
        order = np.lexsort((residuals[known], ends[known]))
        ordered = residuals[known][order]
        first = np.searchsorted(ends[known][order], np.arange(num_cameras + 1))
        counts = np.diff(first)
        medians = np.full(num_cameras, np.nan)
        some = counts > 0
        low, high = first[:-1] + (counts - 1) // 2, first[:-1] + counts // 2
        medians[some] = (ordered[low[some]] + ordered[high[some]]) / 2
        return np.bincount(ends[agrees], minlength=num_cameras), medians

    def worst_first(self) -> IntArray:
        """Return the rows: those that contradict the solution first, then rejected ones."""
        rank = np.array([3, 0, 2, 4, 1])[self.classes]
        return np.asarray(np.lexsort((-self.support, -np.nan_to_num(self.residuals_deg), rank)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drawing:
    """Everything that is drawn."""

    cameras: Cameras
    pairs: Pairs
    points: PickedPoints
    """The points that are drawn; lengths and errors, NaN where not known, are of those far outside too."""
    axes: FloatArray
    """(3, 3) rows: to the right, forward and up as seen by the cameras, in the output's axes."""
    frustum_depth: float
    """In the output's units."""
    dimension: int = 3
    """Number of coordinates of a location; others than 3 are bare graphs."""
    input_is_aligned: bool = False
    """Whether the input's centers are in the output's units, so that both can be drawn together."""
    history: tuple[tuple[int, float, float | None], ...] = ()
    """Iteration, objective and bound of the convex solve, as far as they were recorded."""
    further: tuple[CameraColumn, ...] = ()
    """Further figures of the cameras."""
    lenses: tuple[LensRow, ...] = ()
    """All lenses of the model."""
    fields: tuple[LensField, ...] = ()
    """Mean residuals over the pictures of those with most images."""

    def shifts(self) -> FloatArray:
        """(n,) how far cameras stand from where the input has them; NaN where the two cannot be compared."""
        if not self.input_is_aligned:
            return np.full(len(self.cameras.names), np.nan)
        return np.asarray(np.linalg.norm(self.cameras.centers - self.cameras.poses.centers, axis=1))

    @property
    def noun(self) -> str:
        """What a camera is called: a bare graph has nodes."""
        return "camera" if np.isfinite(self.cameras.poses.rotations).any() else "node"

    @property
    def extent(self) -> float:
        """Diagonal of the box around the placed cameras, in the output's units."""
        placed = self.cameras.centers[self.cameras.placed]
        return float(np.linalg.norm(np.ptp(placed, axis=0))) if len(placed) else 0.0


def build_drawing(
    cameras: Table[CameraRow],
    pairs: Table[PairRow],
    *,
    poses: Poses | None = None,
    points: PickedPoints | None = None,
    certified: FloatArray | None = None,
) -> Drawing:
    """Return the drawing of a result's rows; what does not follow from these has its default.

    Args:
        cameras, pairs: rows of the tables.
        poses: rotations in the output's axes, and the input's centers; unknown if None.
        points: of the model, which are drawn; none if None.
        certified: (n, d) locations at the convex optimum, NaN where there are none; unknown if None.
    """
    poses = _unknown_poses(len(cameras)) if poses is None else poses
    camera_columns = _cameras(cameras, poses)
    positions = camera_columns.centers[camera_columns.placed]
    return Drawing(
        cameras=camera_columns,
        pairs=_pairs(pairs, camera_columns, certified),
        points=_points(points, positions),
        axes=view_axes(poses.rotations[camera_columns.placed]),
        frustum_depth=_frustum_depth(positions),
    )


def poses_of(images: Images | None, names: Sequence[str]) -> Poses:
    """Return rotations, centers and pictures of images, by name; NaN for names that none has."""
    poses = _unknown_poses(len(names))
    if images is None:
        return poses
    row_of = {name: row for row, name in enumerate(names)}
    rows = [k for k, name in enumerate(images.names) if name in row_of]
    members = [row_of[images.names[k]] for k in rows]
    halves = images.sizes_px[rows] / (2.0 * images.focal_lengths_px[rows, None])
    poses.rotations[members], poses.centers[members] = images.rotations[rows], images.centers[rows]
    poses.half_sizes[members] = np.clip(halves, *_HALF_SIZES)
    return poses


def frustum_corners(drawing: Drawing, rows: IntArray, centers: FloatArray) -> FloatArray:
    """Return the picture corners of cameras in the world's axes, shape (k, 4, 3), around each picture.

    The cameras are those of some rows (k,) with a rotation, and stand at the centers (k, 3).
    """
    signs = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    halves = drawing.cameras.poses.half_sizes[rows]
    in_camera = np.concatenate([signs * halves[:, None, :], np.ones((len(rows), 4, 1))], axis=2)
    rotations = drawing.cameras.poses.rotations[rows]
    return np.asarray(centers[:, None, :] + drawing.frustum_depth * in_camera @ rotations)


def input_centers(drawing: Drawing) -> FloatArray | None:
    """Return the input's centers (n, 3) in the output's units and axes, brought there by a fit if need be.

    None where the input has no centers, or they all coincide.
    """
    given, after = drawing.cameras.poses.centers, drawing.cameras.centers
    common = np.isfinite(given).all(axis=1) & np.isfinite(after).all(axis=1)
    if common.sum() < _FEWEST_FITTED or not np.ptp(given[common], axis=0).max() > 0.0:
        return None
    if drawing.input_is_aligned:
        return given
    return fit_similarity_l1(given[common], after[common]).apply(given)


def view_axes(rotations: FloatArray) -> FloatArray:
    """Return right, forward and up, as rows, as most cameras see them; the world's axes if there are none.

    People hold cameras level: up is the direction most orthogonal to the pictures' x axes and, as far as that
    leaves it open, opposite to their y axes. Rotations (n, 3, 3) are cam_from_world.
    """
    rotations = rotations[np.isfinite(rotations).all(axis=(1, 2))]
    if len(rotations) == 0:
        return np.eye(3)
    x, y, z = (rotations[:, axis] for axis in range(3))
    _, vectors = np.linalg.eigh((x.T @ x - _UPRIGHT * y.T @ y) / len(rotations))
    up = vectors[:, 0]
    leaning = (y.mean(axis=0) @ up, z.mean(axis=0) @ up)
    up = -up if max(leaning, key=abs) > 0.0 else up
    forward = z.mean(axis=0) - (z.mean(axis=0) @ up) * up
    if np.linalg.norm(forward) < _UPRIGHT:  # they look all around
        forward = np.eye(3)[np.argmin(np.abs(up))]
        forward = forward - (forward @ up) * up
    forward = forward / np.linalg.norm(forward)
    return np.stack([np.cross(forward, up), forward, up])


def _unknown_poses(n: int) -> Poses:
    return Poses(
        rotations=np.full((n, 3, 3), np.nan),
        centers=np.full((n, 3), np.nan),
        half_sizes=np.full((n, 2), np.nan),
    )


def _cameras(rows: Table[CameraRow], poses: Poses) -> Cameras:
    columns, centers = rows.columns, np.zeros((len(rows), max(rows.dimension, 3)))
    centers[:, : rows.dimension] = columns["center"]
    centers[np.isnan(columns["center"]).any(axis=1)] = np.nan
    return Cameras(
        names=tuple(columns["name"]),
        placed=columns["placed"],
        reasons=tuple(columns["reason"]),
        pieces=np.array([-1 if piece is None else piece for piece in columns["piece"]], dtype=np.int64),
        degrees=columns["degree"],
        trust=columns["trust"],
        centers=centers[:, :3],
        covariances=covariances_of(rows),
        poses=poses,
    )


def _pairs(rows: Table[PairRow], cameras: Cameras, certified: FloatArray | None) -> Pairs:
    row_of, columns = {name: k for k, name in enumerate(cameras.names)}, rows.columns
    ends = np.array([[row_of[name] for name in columns[end]] for end in ("name1", "name2")], dtype=np.int64).T
    directions, undetermined = columns["direction"], columns["verdict"] == Verdict.UNDETERMINED.value
    is_known = np.isfinite(directions).all(axis=1)
    kinds = PairClass.REJECTED, PairClass.NO_DIRECTION, PairClass.UNDETERMINED, PairClass.CONTRADICTS
    of_kind = [~is_known & rejected(rows), ~is_known, undetermined, contradicting(rows)]
    classes = np.select(of_kind, kinds, PairClass.AGREES)
    return Pairs(
        cameras=ends,
        classes=classes.astype(np.int64),
        support=columns["support"],
        weights=columns["weight"],
        leverages=columns["leverage"],
        dual_norms=columns["dual_norm"],
        residuals_deg=columns["residual_deg"],
        certified_deg=_angles_at(certified, ends, directions),
        input_deg=_angles_at(cameras.poses.centers if rows.dimension == 3 else None, ends, directions),
        reasons=tuple(columns["reason"]),
    )


def _angles_at(locations: FloatArray | None, ends: IntArray, directions: FloatArray) -> FloatArray:
    """Return the angles between directions and the baselines at some locations; NaN where those mean nothing.

    Locations that all coincide, as those of a model that states rotations only, mean nothing.
    """
    known_rows = np.zeros((0, 3)) if locations is None else locations[np.isfinite(locations).all(axis=1)]
    if locations is None or len(known_rows) == 0 or not np.ptp(known_rows, axis=0).max() > 0.0:
        return np.full(len(ends), np.nan)
    baselines = locations[ends[:, 0]] - locations[ends[:, 1]]
    known = np.isfinite(baselines).all(axis=1) & np.isfinite(directions).all(axis=1)
    known &= np.linalg.norm(baselines, axis=1) > 0.0
    angles = np.full(len(ends), np.nan)
    angles[known] = angle_between_deg(directions[known], normalized(baselines[known]))
    return angles


def _points(picked: PickedPoints | None, cameras: FloatArray) -> PickedPoints:
    """Return points without those far out that would shrink the rest."""
    if picked is None or not len(picked.xyz):
        nothing = np.zeros((0, 3))
        return PickedPoints(nothing, nothing.astype(np.uint8), np.zeros(0, np.int64), np.zeros(0), 0)
    both = np.concatenate([picked.xyz, cameras])
    middle = np.median(both, axis=0)
    limit = _FAR_POINT * quantile(np.linalg.norm(both - middle, axis=1), 0.9)
    near = np.linalg.norm(picked.xyz - middle, axis=1) <= limit
    errors_px = np.where(picked.errors_px >= 0.0, picked.errors_px, np.nan)
    return picked._replace(xyz=picked.xyz[near], colors=picked.colors[near], errors_px=errors_px)


def _frustum_depth(positions: FloatArray) -> float:
    """Return how deep frusta are drawn: well below the distance between neighbors."""
    if len(positions) < 2:
        return 1.0
    low, high = quantile(positions, 0.05), quantile(positions, 0.95)
    extent = float(np.linalg.norm(high - low)) or float(np.linalg.norm(np.ptp(positions, axis=0))) or 1.0
    some = positions[:: max(len(positions) // _MEASURED, 1)]
    apart = [np.partition(np.linalg.norm(positions - own, axis=1), 1)[1] for own in some]
    smallest, largest = _FRUSTUM_OF_EXTENT
    wanted = _FRUSTUM_SHARE * float(np.median(apart))
    return float(np.clip(wanted, smallest * extent, largest * extent))
