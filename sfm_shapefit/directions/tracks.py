"""Matches to tracks, and a covering set of them as extra nodes of the view graph.

With the rotations known, an observation of a 3D point X by camera i is a measured direction of C_i - X: the
ray, turned round. A point seen by three cameras or more ties their distances together where the directions
between the cameras cannot: on a straight road all baselines are parallel, rays to the roadside are not.

A track is a connected component of observations under matches that agree with their pair's direction; one
that meets an image twice is wrong and dropped. Where there are too many matches to hold, only those of a
random share of the keypoints are kept, and with them whole stars of matches around these. Of the tracks, a
covering set is chosen: so many that every camera, if it can, sees a given number of them.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.directions.matches import MatchBatch
from sfm_shapefit.directions.pair_directions import PairDirections
from sfm_shapefit.jit import kernel
from sfm_shapefit.measured import MeasuredGraph
from sfm_shapefit.viewgraph import ViewGraph, connected_components

# These are about 3 tracks started per camera, of 6 views each: what determines a straight road.
_PER_CAMERA = 20
# A small scene can afford so many observations, in all and per camera.
_IN_ALL, _PER_CAMERA_OF_FEW = 800, 60
_MIN_VIEWS = 3
# So many matches are held at a time, in 0.6 GB.
_MAX_MATCHES = 10_000_000
# Rays farther apart gain nothing more, and are often wrong.
_WIDEST_RAD = 0.5
# No image has so many keypoints.
_KEYPOINTS = 1 << 32
_MIX = np.uint64(0x9E3779B97F4A7C15)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracks:
    """Points seen by several cameras, as rays. Point p has the observations offsets[p]:offsets[p + 1]."""

    offsets: IntArray
    """(p + 1,)"""
    cameras: IntArray
    """(k,) the camera of each observation; a track meets each at most once."""
    rays: FloatArray
    """(k, 3) unit rays from the camera, world axes."""

    @property
    def num_tracks(self) -> int:
        """Number of points, p."""
        return len(self.offsets) - 1

    def lengths(self) -> IntArray:
        """Return the number of observations of each point, (p,)."""
        return np.diff(self.offsets)

    def subset(self, chosen: IntArray) -> "Tracks":
        """Return the given tracks, in that order."""
        lengths = self.lengths()[chosen]
        offsets = np.concatenate([[0], np.cumsum(lengths)])
        rows = np.repeat(self.offsets[chosen] - offsets[:-1], lengths) + np.arange(offsets[-1])
        return Tracks(offsets=offsets, cameras=self.cameras[rows], rays=self.rays[rows])


def build_tracks(
    batches: Iterable[MatchBatch],
    directions: PairDirections,
    threshold_px: float,
    max_matches: int = _MAX_MATCHES,
) -> Tracks:
    """Return the tracks of at least three views that the matches of usable pairs form.

    The tracks and their order do not depend on the order of pairs.

    Args:
        batches: the matches of all pairs.
        directions: what was measured of the same pairs.
        threshold_px: largest Sampson error of a match that is kept.
        max_matches: held in memory; beyond, a share of the keypoints is drawn.
    """
    usable = directions.usable()
    share = min(1.0, max_matches / max(float(directions.num_inliers[usable].sum()), 1.0))
    pairs = map(tuple, directions.pairs[usable].tolist())
    rows = dict(zip(pairs, usable.tolist(), strict=True))
    keys, rays = [], []
    for batch in batches:
        row = np.array([rows.get(tuple(pair), -1) for pair in batch.pairs.tolist()], dtype=np.int64)
        counts = np.diff(batch.offsets)
        kept = np.repeat(row >= 0, counts) & _draw_matches(batch, counts, share)
        pair = np.repeat(np.arange(len(row)), counts)[kept]
        d = directions.directions[row[pair]]
        angle = batch.pixel_angles[pair]
        agrees = sampson_px(batch.rays_i[kept], batch.rays_j[kept], d, angle) <= threshold_px
        chosen = np.flatnonzero(kept)[agrees]
        keys.append(batch.pairs[pair[agrees]] * _KEYPOINTS + batch.keypoints[chosen])
        rays.append(np.stack([batch.rays_i[chosen], batch.rays_j[chosen]], axis=1).reshape(-1, 3))
    if not keys:
        zero = np.zeros(1, dtype=np.int64)
        return Tracks(offsets=zero, cameras=zero[:0], rays=np.zeros((0, 3)))
    return _components(np.concatenate(keys), rays)


def _draw_matches(batch: MatchBatch, counts: IntArray, share: float) -> BoolArray:
    """Return the matches one of whose keypoints belongs to a random share of all, always the same one."""
    if share >= 1.0:
        return np.ones(len(batch.keypoints), dtype=np.bool_)
    image = np.repeat(batch.pairs, counts, axis=0).astype(np.uint64)
    mixed = (image << np.uint64(32)) + batch.keypoints.astype(np.uint64)
    for shift in (30, 27, 31):  # the finalizer of splitmix64
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * _MIX
    drawn = (mixed >> np.uint64(11)).astype(np.float64) < share / 2.0 * 2.0**53
    return np.asarray(drawn.any(axis=1))


def sampson_px(a: FloatArray, b: FloatArray, d: FloatArray, pixel_angle: FloatArray) -> FloatArray:
    """Return the Sampson error of matches (k, 3) against directions (k, 3) in pixels, see `directions`."""
    along_a, along_b = np.sum(a * d, axis=1), np.sum(b * d, axis=1)
    gradient = np.sqrt(np.maximum(2.0 - along_a**2 - along_b**2, 1e-12))
    return np.asarray(np.abs(np.sum(np.cross(a, b) * d, axis=1)) / (gradient * pixel_angle))


def _components(ends: IntArray, rays: list[FloatArray]) -> Tracks:
    """Return the tracks of matches from keys image * 2^32 + keypoint of both observations, (k, 2).

    `rays` are those of the observations, (2 k, 3) in all, in parts.
    """
    keys, first, index = np.unique(ends.ravel(), return_index=True, return_inverse=True)
    track = connected_components(len(keys), index.reshape(-1, 2))  # by first observation: keys are sorted
    camera = keys // _KEYPOINTS
    order = np.lexsort((camera, track))
    track, camera, seen = track[order], camera[order], first[order]
    repeated = np.zeros(int(track.max()) + 1, dtype=np.bool_)
    again = (track[1:] == track[:-1]) & (camera[1:] == camera[:-1])
    repeated[track[1:][again]] = True
    good = ~repeated & (np.bincount(track) >= _MIN_VIEWS)
    kept = good[track]
    lengths = np.bincount(track)[good]
    return Tracks(
        offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        cameras=camera[kept].astype(np.int64),
        rays=_gather_rows(rays, seen[kept]),
    )


def _gather_rows(parts: list[FloatArray], rows: IntArray) -> FloatArray:
    """Return the given rows of arrays (., 3) that follow one another, without joining these."""
    found = np.empty((len(rows), 3))
    start = 0
    for part in parts:
        inside = np.flatnonzero((rows >= start) & (rows < start + len(part)))
        found[inside] = part[rows[inside] - start]
        start += len(part)
    return found


def covering_set(tracks: Tracks, num_cameras: int, per_camera: int | None = None) -> IntArray:
    """Return tracks such that every camera sees at least `per_camera` of them, if it can; ascending.

    Greedy: the best tracks first, each if some camera of it still needs one. Best are those that many cameras
    see from far apart. None: 20 per camera, and up to 60 where the cameras are few.
    """
    if per_camera is None:
        per_camera = max(_PER_CAMERA, min(_PER_CAMERA_OF_FEW, _IN_ALL // num_cameras))
    order = np.argsort(-_worth(tracks), kind="stable")
    taken = np.zeros(len(order), dtype=np.bool_)
    _cover(order, tracks.offsets, tracks.cameras, per_camera, np.zeros(num_cameras, dtype=np.int64), taken)
    return np.sort(order[taken])


def _worth(tracks: Tracks) -> FloatArray:
    """Return how much a track says: the root of its length times the widest angle of its rays, limited."""
    first = tracks.rays[np.repeat(tracks.offsets[:-1], tracks.lengths())]
    apart = np.linalg.norm(tracks.rays - first, axis=1)
    widest = np.maximum.reduceat(apart, tracks.offsets[:-1])
    return np.asarray(np.sqrt(tracks.lengths()) * np.minimum(widest, _WIDEST_RAD))


@kernel
def _cover(
    order: IntArray, offsets: IntArray, cameras: IntArray, per_camera: int, seen: IntArray, taken: BoolArray
) -> None:
    """Write, in the given order, which tracks are taken; both outputs come as zeros.

    `seen` counts how many of these each camera sees.
    """
    for k in range(len(order)):
        first, last = offsets[order[k]], offsets[order[k] + 1]
        for row in range(first, last):
            if seen[cameras[row]] < per_camera:
                taken[k] = True
        if taken[k]:
            for row in range(first, last):
                seen[cameras[row]] += 1


def join_points(
    graph: ViewGraph, covariance: FloatArray, tracks: Tracks, pixel_angles: FloatArray, noise_px: float = 1.0
) -> MeasuredGraph:
    """Return the view graph with the tracks as further nodes.

    Args:
        graph: n cameras and their directions.
        covariance: (m, 2, 2) of these.
        tracks: what to add.
        pixel_angles: (n,) angle of one pixel of each camera in radians.
        noise_px: standard deviation of an observation, per axis.
    """
    n = graph.num_nodes
    points = n + np.repeat(np.arange(tracks.num_tracks), tracks.lengths())
    own = (noise_px * pixel_angles[tracks.cameras]) ** 2
    names = None if graph.names is None else [*graph.names, *(f"point {k}" for k in range(tracks.num_tracks))]
    joint = ViewGraph(
        n + tracks.num_tracks,
        np.concatenate([graph.edges, np.stack([tracks.cameras, points], axis=1)]),
        np.concatenate([graph.directions, -tracks.rays]),
        np.concatenate([graph.weights, np.ones(len(points))]),
        names,
    )
    known = np.concatenate([covariance, own[:, None, None] * np.eye(2)])
    return MeasuredGraph(joint, covariance=known, num_points=tracks.num_tracks)
