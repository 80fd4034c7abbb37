"""Matches to tracks, and a covering set of them as extra nodes of the view graph.

With the rotations known, an observation of a 3D point X by camera i is a measured direction of C_i - X: the
ray, turned round. A point seen by three cameras or more ties their distances together where the directions
between the cameras cannot: on a straight road all baselines are parallel, rays to the roadside are not.

A track is a connected component of observations under matches that agree with their pair's direction; one
that meets an image twice is wrong and dropped. A checked track holds together without any single one of its
matches. A false pair agrees with itself: each of its matches joins an observation to a point, or two points,
and twenty such rays outvote all other pairs of their camera, but no second match says the same. So checked
tracks are cut at such matches (the bridges of the graph of matches); where pairs are few, as along a chain,
they are too few to serve alone. Bridges are found as the matches pass by: one that closes a circle draws a
random number, which both of its ends take up by exclusive or, and a match of the spanning forest is a bridge
if the numbers of all nodes beyond it cancel out.

Where there are too many matches to hold, only those of a random share of the keypoints are kept, and with
them whole stars of matches around these; nothing checks these. A covering set of the tracks is chosen: so
many that every camera, if it can, sees a given number of them.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, Int32Array, IntArray, stable_order
from sfm_shapefit.base.forests import merge_sets, root_of
from sfm_shapefit.base.jit import kernel, mix_bits
from sfm_shapefit.base.lists import Lists, offsets_of
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.pairs.pair_directions import PairDirections, is_usable
from sfm_shapefit.scene.epipolar import sampson_px
from sfm_shapefit.scene.matches import MatchBatch
from sfm_shapefit.tracks.joining import number_trees

# Observations per camera; about 3 tracks started per camera, of 6 views each, determine a straight road.
_PER_CAMERA = 20
# Observations that a small scene is given, in all and per camera at most; it can afford them.
_IN_ALL, _PER_CAMERA_OF_FEW = 800, 60
_MIN_VIEWS = 3  # views of a track; two of them are no more than the pair's own direction
_MAX_MATCHES = 10_000_000  # matches whose keypoints are held at a time; they take 0.4 GB
_WIDEST_RAD = 0.5  # angle between rays; wider ones gain nothing more, and are often wrong
# Odd multiplier of the hash; 2^64 over the golden ratio, the increment of splitmix64.
_MIX = np.uint64(0x9E3779B97F4A7C15)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tracks(Lists):
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

    def subset(self, chosen: IntArray) -> "Tracks":
        """Return the given tracks, in that order."""
        own = self.rows_of(chosen)
        return Tracks(offsets=own.offsets, cameras=self.cameras[own.rows], rays=self.rays[own.rows])


class TrackJoiner:
    """Joins the matches of pairs, batch after batch, to tracks of at least three views.

    The tracks and their order do not depend on the order of pairs.
    """

    def __init__(
        self,
        threshold_px: float,
        num_keypoints: IntArray,
        num_matches: int = 0,
        max_matches: int = _MAX_MATCHES,
    ) -> None:
        """Begin with no match.

        Args:
            threshold_px: largest Sampson error of a match that is joined.
            num_keypoints: (n,) of each image.
            num_matches: of all pairs, at most; 0 if not known.
            max_matches: whose keypoints are held in memory; of more, a share of the keypoints is drawn.
        """
        self._threshold_px, self._share = threshold_px, min(1.0, max_matches / max(num_matches, 1))
        self._begins = offsets_of(num_keypoints)
        self._places = np.full(int(self._begins[-1]), -1, dtype=np.int32)
        self._parents, self._rays, self._count = np.empty(0, dtype=np.int64), [np.zeros((0, 3))], 0
        # By observation: number and exclusive or of its neighbors in the forest; that of its random numbers.
        self._ties, self._drawn = np.empty((0, 2), dtype=np.int32), np.empty(0, dtype=np.int64)

    def add(self, batch: MatchBatch, directions: PairDirections) -> None:
        """Join the matches that agree with the directions of their pairs, which are those of the batch."""
        row = np.where(is_usable(directions.status), np.arange(len(batch.pairs)), -1)
        counts = batch.lengths()
        drawn = _draw_matches(batch, counts, self._share)
        keypoints = batch.spread(self._begins[batch.pairs]) + batch.keypoints
        new_rays = np.empty((min(2 * len(keypoints), len(self._places) - self._count), 3))
        largest = self._count + len(new_rays)
        if largest > len(self._parents):
            more = np.arange(len(self._parents), 2 * largest)
            self._parents = np.concatenate([self._parents, more])
            self._ties = np.concatenate([self._ties, np.zeros((len(more), 2), dtype=np.int32)])
            self._drawn = np.concatenate([self._drawn, np.zeros_like(more)])
        number = _join_batch(
            row, batch.offsets, keypoints, drawn, np.ascontiguousarray(batch.rays_i),
            np.ascontiguousarray(batch.rays_j), directions.directions, batch.pixel_angles,
            self._threshold_px, self._places, self._parents, (self._ties, self._drawn),
            self._count, new_rays,
        )  # fmt: skip
        self._rays.append(new_rays[: number - self._count].copy())
        self._count = number

    def tracks(self) -> Tracks:
        """Return the tracks of all matches that were added."""
        rays = np.concatenate(self._rays)
        return _collect(self._places, self._begins, self._parents[: self._count], rays)

    @property
    def holds_all(self) -> bool:
        """Whether all matches are held, so that it is known which tracks are checked."""
        return self._share >= 1.0

    def checked_tracks(self) -> Tracks:
        """Return those that no single match holds together; once, as this uses up what is held for it."""
        rays, checked = np.concatenate(self._rays), np.arange(self._count)
        _cut_bridges(self._ties, self._drawn, checked)
        return _collect(self._places, self._begins, checked, rays)


@kernel
def _join_batch(
    row: Any, offsets: Any, keypoints: Any, drawn: Any, rays_i: Any, rays_j: Any, directions: Any,
    pixel_angles: Any, threshold_px: float, places: Any, parents: Any, circles: Any, count: int, rays: Any,
) -> int:  # fmt: skip
    """Join the observations of matches that agree with their pair's direction; return how many there are.

    `places` has the number of the observation of each keypoint of all images, -1 for none; new ones are
    numbered from `count` on, and their rays written to `rays`. `circles` has what `_cut_bridges` is given.
    """
    first, (ties, numbers) = count, circles
    for p in range(len(row)):
        if row[p] < 0:
            continue
        for m in range(offsets[p], offsets[p + 1]):
            if not drawn[m]:
                continue
            if not sampson_px(rays_i[m], rays_j[m], directions[row[p]], pixel_angles[p]) <= threshold_px:
                continue
            for side in range(2):
                if places[keypoints[m, side]] < 0:
                    places[keypoints[m, side]] = count
                    for c in range(3):
                        rays[count - first, c] = rays_i[m, c] if side == 0 else rays_j[m, c]
                    count += 1
            a, b = int(places[keypoints[m, 0]]), int(places[keypoints[m, 1]])
            if root_of(parents, a) != root_of(parents, b):
                merge_sets(parents, a, b)
                for own, other in ((a, b), (b, a)):
                    ties[own, 0] += 1
                    ties[own, 1] ^= other
            else:
                number = np.int64(mix_bits(mix_bits(np.uint64(a)) + np.uint64(b)))
                numbers[a] ^= number
                numbers[b] ^= number
    return count


@kernel
def _cut_bridges(ties: Any, numbers: Any, parents: Any) -> None:
    """Join observations that no single match holds together, each its own parent at first, leaf after leaf.

    `ties` and `numbers` are used up: the only match of a leaf is a bridge if the numbers in it cancel out.
    """
    for first in range(len(parents)):
        leaf = first
        while ties[leaf, 0] == 1:
            other = int(ties[leaf, 1])
            if numbers[leaf] != 0:
                merge_sets(parents, leaf, other)
            ties[leaf, 0] = 0
            ties[other, 0] -= 1
            ties[other, 1] ^= leaf
            numbers[other] ^= numbers[leaf]
            leaf = other


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


def _collect(places: Int32Array, begins: IntArray, parents: IntArray, rays: FloatArray) -> Tracks:
    """Return the tracks of joined observations, see `_join_batch`; (k,) `parents`, (k, 3) `rays`."""
    keypoints = np.flatnonzero(places >= 0)
    seen = places[keypoints].astype(np.int64)
    camera = np.searchsorted(begins, keypoints, side="right") - 1
    track = number_trees(parents, seen)[seen]
    order = stable_order(track)  # each track by ascending camera, as keypoints are
    track, camera, seen = track[order], camera[order], seen[order]
    lengths = np.bincount(track)
    repeated = np.zeros(len(lengths), dtype=np.bool_)
    again = (track[1:] == track[:-1]) & (camera[1:] == camera[:-1])
    repeated[track[1:][again]] = True
    good = ~repeated & (lengths >= _MIN_VIEWS)
    kept = good[track]
    return Tracks(
        offsets=offsets_of(lengths[good]),
        cameras=camera[kept].astype(np.int64),
        rays=rays[seen[kept]],
    )


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
    first = tracks.spread(tracks.rays[tracks.offsets[:-1]])
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
        covariance: (m, 2, 2) of the directions.
        tracks: what to add.
        pixel_angles: (n,) angle of one pixel of each camera in radians.
        noise_px: standard deviation of an observation, per axis.
    """
    n = graph.num_nodes
    points = n + tracks.list_of_rows()
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
