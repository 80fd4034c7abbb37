"""Points of tracks at known poses, robust against wrong observations in them.

For each track: two observations at a time give a point (the middle of the shortest line between their rays),
of which the one with the least truncated squares over all observations wins; up to 15 pairs are tried, all of
six observations. Gauss-Newton on the squared errors of those within the limit then finds the point. What
stays within the limit, in front of its camera and the best of its image, is the point's; the point counts if
these are enough and two of them see it under the least angle. Where a track may be of several points, what is
left over is tried again.

An error is that of an ideal camera of the same focal length, f |(x/z, y/z) - (u, v)|, in pixels.

Source: Schoenberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016, section 4.2 (robust
triangulation of tracks with wrong observations, and its recursion); Beardsley, Zisserman and Murray (1997)
for the middle point.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IndexArray, IntArray
from sfm_shapefit.base.executors import in_threads
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.base.lists import RowLists, offsets_of
from sfm_shapefit.scene.epipolar import write_ray
from sfm_shapefit.tracks.links import CameraPoses, JoinedKeypoints, MatchedKeypoints, ObservedTracks

# Observations between which Python can be interrupted: about 0.1 s.
_SLICE = 100_000
_SLICES_A_THREAD = 4  # slices of tracks at least; with one, long tracks would hold up the others
_JOINED_AT_ONCE = 2_000_000  # observations whose pixels are put together; they take 100 MB
_PAIRS = 15  # pairs of observations that are tried for each point; all of six observations
_STEPS = 5  # Gauss-Newton steps for a point; they begin within the limit of its observations
_STILL = 1e-9  # length of a step over the distance of the point; the steps end with a shorter one
_CHAIN = 1.5  # keypoints of a track for each of its images; with more it is a chain of several points
_WIDE_AMONG = 64  # rays; one of as many makes the widest angle with another, nearly always


@dataclass(frozen=True, slots=True, kw_only=True)
class PointLimits:
    """What a point must satisfy."""

    max_error_px: float
    """Largest error of an observation."""
    min_angle_deg: float
    """Least angle between the rays of two of its observations."""
    min_length: int
    """Fewest observations."""
    most_points: int = 50
    """Points that a track may be of: wrong matches join true tracks to long chains."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TriangulatedPoints:
    """Points and which observations are of them; by ascending track."""

    points: FloatArray
    """(k, 3)"""
    tracks: IntArray
    """(k,) the track of each."""
    points_seen: IndexArray
    """(m,) the point of each observation of the tracks, -1 for those that are of none."""

    @classmethod
    def of_tracks(cls, tracks: ObservedTracks, points: FloatArray) -> "TriangulatedPoints":
        """Return points (t, 3) that are known, one for each track; rays that do not point ahead see none."""
        has_ray = np.isfinite(tracks.on_plane).all(axis=1)
        seen = np.where(has_ray, tracks.list_of_rows(), -1)
        return cls(points=points, tracks=np.arange(tracks.num_tracks), points_seen=seen)

    def count_seen(self, least: int = 1) -> int:
        """Return how many observations are of points that have at least so many."""
        lengths = np.bincount(self.points_seen[self.points_seen >= 0])
        return int(lengths[lengths >= least].sum())

    def of_length(self, least: int) -> "TriangulatedPoints":
        """Return the points with at least that many observations; the observations of others are of none."""
        seen = self.points_seen
        kept = np.bincount(seen[seen >= 0], minlength=len(self.points)) >= least
        place = np.append(np.where(kept, np.cumsum(kept, dtype=np.int32) - 1, -1), np.int32(-1))
        return TriangulatedPoints(points=self.points[kept], tracks=self.tracks[kept], points_seen=place[seen])


def triangulate_tracks(
    tracks: ObservedTracks, poses: CameraPoses, limits: PointLimits, threads: int = 1
) -> TriangulatedPoints:
    """Return the points of tracks; the same bits whatever else is triangulated with them.

    Args:
        tracks: observations; those without a ray ahead are of no point.
        poses: of the cameras that the tracks' observations index.
        limits: what a point must satisfy.
        threads: number of threads to share the tracks among.
    """
    lengths = tracks.lengths()
    seen = np.full(len(tracks.cameras), -1, dtype=np.int32)
    room = offsets_of(lengths // max(limits.min_length, 2))  # for the points of each track
    points = np.empty((int(room[-1]), 3))
    track_of = np.empty(len(points), dtype=np.int64)
    figures = np.array(
        [limits.max_error_px**2, math.cos(math.radians(limits.min_angle_deg)), limits.min_length]
    )
    most = limits.most_points if tracks.may_split else 1
    given = (
        tracks.offsets, tracks.cameras.astype(np.int32, copy=False), tracks.on_plane, poses.rotations,
        poses.centers, poses.focal_lengths_px, poses.images, figures, most, int(lengths.max(initial=0)),
    )  # fmt: skip
    number = max(len(seen) // _SLICE, _SLICES_A_THREAD * threads if threads > 1 else 1)
    cuts = np.searchsorted(tracks.offsets, np.arange(1, number) * len(seen) // number).tolist()
    slices = list(pairwise([0, *cuts, tracks.num_tracks]))

    def fill(own: tuple[int, int]) -> IntArray:
        first = int(room[own[0]])
        return np.arange(first, _triangulate(*own, first, given, points, track_of, seen))

    kept = np.concatenate(list(in_threads(threads, fill, slices)))
    place = np.full(len(points) + 1, -1, dtype=np.int32)
    place[kept] = np.arange(len(kept))
    return TriangulatedPoints(points=points[kept], tracks=track_of[kept], points_seen=place[seen])


def joining_limits_px(threshold_px: float, widest_px: float) -> Iterator[float]:
    """Yield the errors that matches may have to join tracks: half the threshold, and twice as much each time.

    What agrees best is joined first, and what no point was found for is joined again.
    """
    limit_px = 0.5 * threshold_px
    while limit_px <= widest_px:
        yield limit_px
        limit_px *= 2.0


def triangulate_matches(
    matched: MatchedKeypoints,
    poses: CameraPoses,
    limits: PointLimits,
    threshold_px: float,
    threads: int = 1,
) -> tuple[JoinedKeypoints, TriangulatedPoints]:
    """Return the points of matches, and a track for each of what it is seen by.

    Where a twentieth of the matches is wrong, those within 4 px join half of all observations of a ring of
    300 images to chains of many points, and those within 16 px all but a twentieth. The keypoints of chains,
    and only these, are joined anew: what agrees best first.

    Args:
        matched: keypoints and their matches.
        poses: of their cameras.
        limits: what a point must satisfy.
        threshold_px: the pixel threshold; the widest error of a match is `limits.max_error_px`.
        threads: number of threads to share matches and tracks among.
    """
    place = poses, limits, threads
    joined = matched.join(poses, limits.max_error_px, threads)
    is_left: BoolArray = np.zeros(len(matched.cameras), dtype=np.bool_)
    parts = list[tuple[FloatArray, RowLists]]()
    for own in joined.blocks(_JOINED_AT_ONCE):
        is_chain = own.lengths() > _CHAIN * _count_images(own, poses.images[matched.cameras[own.rows]])
        is_left[own.subset(np.flatnonzero(is_chain)).rows] = True
        parts.append(_triangulate_joined(matched, own.subset(np.flatnonzero(~is_chain)), *place))
    del joined
    left, rows = matched, np.arange(len(is_left))
    for limit_px in joining_limits_px(threshold_px, limits.max_error_px) if is_left.any() else ():
        left, rows = left.among(is_left, threads), rows[is_left]
        is_left = np.ones(len(rows), dtype=np.bool_)
        for own in left.join(poses, limit_px, threads).blocks(_JOINED_AT_ONCE):
            points, seen = _triangulate_joined(left, own, *place)
            parts.append((points, RowLists(seen.offsets, rows[seen.rows])))
            is_left[seen.rows] = False
    lengths = np.concatenate([seen.lengths() for _, seen in parts])
    joined_rows = np.concatenate([seen.rows.astype(np.int32, copy=False) for _, seen in parts])
    return JoinedKeypoints(offsets_of(lengths), joined_rows, matched), TriangulatedPoints(
        points=np.concatenate([points for points, _ in parts]),
        tracks=np.arange(len(lengths)),
        points_seen=np.repeat(np.arange(len(lengths), dtype=np.int32), lengths),
    )


def _count_images(joined: RowLists, images: IntArray) -> IntArray:
    """Return how many images the rows (m,) of each track are of, by the image of each row, ascending."""
    is_new = np.ones(len(images), dtype=np.int64)
    is_new[1:] = images[1:] != images[:-1]
    is_new[joined.offsets[:-1]] = 1
    return np.asarray(np.add.reduceat(is_new, joined.offsets[:-1])) if len(images) else np.zeros(0, np.int64)


def _triangulate_joined(
    matched: MatchedKeypoints, joined: RowLists, poses: CameraPoses, limits: PointLimits, threads: int
) -> tuple[FloatArray, RowLists]:
    """Return the points (k, 3) of joined keypoints, and the rows that see each."""
    found = triangulate_tracks(matched.observed(joined, threads), poses, limits, threads)
    return found.points, joined.of(RowLists.by_label(found.points_seen, len(found.points)))


@inner_kernel
def _step(
    rows: Any, k: int, cameras: Any, plane: Any, rotations: Any, centers: Any, weights: Any, point: Any
) -> float:
    """Move a point by one Gauss-Newton step of weighted squares; return how far, of its distance, or -1."""
    h00 = h01 = h02 = h11 = h12 = h22 = b0 = b1 = b2 = 0.0
    far = 0.0
    for q in range(k):
        if weights[q] == 0.0:
            continue
        row = rows[q]
        rotation, center = rotations[cameras[row]], centers[cameras[row]]
        x, y, z = point[0] - center[0], point[1] - center[1], point[2] - center[2]
        depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z
        far = max(far, depth)
        for axis in range(2):
            value = (rotation[axis, 0] * x + rotation[axis, 1] * y + rotation[axis, 2] * z) / depth
            residual = value - plane[row, axis]
            g0 = (rotation[axis, 0] - value * rotation[2, 0]) / depth
            g1 = (rotation[axis, 1] - value * rotation[2, 1]) / depth
            g2 = (rotation[axis, 2] - value * rotation[2, 2]) / depth
            w = weights[q]
            h00 += w * g0 * g0
            h01 += w * g0 * g1
            h02 += w * g0 * g2
            h11 += w * g1 * g1
            h12 += w * g1 * g2
            h22 += w * g2 * g2
            b0 -= w * g0 * residual
            b1 -= w * g1 * residual
            b2 -= w * g2 * residual
    c00, c01, c02 = h11 * h22 - h12 * h12, h02 * h12 - h01 * h22, h01 * h12 - h02 * h11
    determinant = h00 * c00 + h01 * c01 + h02 * c02
    if not determinant > 0.0:
        return -1.0
    c11, c12, c22 = h00 * h22 - h02 * h02, h01 * h02 - h00 * h12, h00 * h11 - h01 * h01
    s0 = (c00 * b0 + c01 * b1 + c02 * b2) / determinant
    s1 = (c01 * b0 + c11 * b1 + c12 * b2) / determinant
    s2 = (c02 * b0 + c12 * b1 + c22 * b2) / determinant
    point[0] += s0
    point[1] += s1
    point[2] += s2
    return float(np.sqrt(s0 * s0 + s1 * s1 + s2 * s2)) / far


@inner_kernel
def _gather(
    first: int, last: int, cameras: Any, plane: Any, rotations: Any, seen: Any, rows: Any, rays: Any
) -> int:
    """Write the observations of no point yet and their rays in axes of the world; return how many."""
    k = 0
    for row in range(first, last):
        if seen[row] != -1 or np.isnan(plane[row, 0] + plane[row, 1]):
            continue
        write_ray(plane[row], rotations[cameras[row]], rays[k])
        rows[k] = row
        k += 1
    return k


@inner_kernel
def _pair(s: int, k: int) -> Any:
    """Return the s-th pair of k observations that is tried."""
    if k * (k - 1) > 2 * _PAIRS:
        i = s * k // _PAIRS
        return i, (i + 1 + (7 * s + 3) % 16 * (k - 1) // 16) % k
    i = 0
    while s >= k - 1 - i:
        s -= k - 1 - i
        i += 1
    return i, i + 1 + s


@inner_kernel
def _middle(p: Any, along_p: Any, q: Any, along_q: Any, cosine: float, point: Any) -> bool:
    """Write the middle of the shortest line between two rays; return whether their angle is enough."""
    d = along_p[0] * along_q[0] + along_p[1] * along_q[1] + along_p[2] * along_q[2]
    if d > cosine:
        return False
    by_p = by_q = 0.0
    for a in range(3):
        by_p += along_p[a] * (q[a] - p[a])
        by_q += along_q[a] * (q[a] - p[a])
    sine = max(1.0 - d * d, 1e-12)
    far_p, far_q = (by_p - d * by_q) / sine, (d * by_p - by_q) / sine
    for a in range(3):
        point[a] = 0.5 * (p[a] + far_p * along_p[a] + q[a] + far_q * along_q[a])
    return True


@inner_kernel
def _weigh(
    rows: Any, k: int, cameras: Any, plane: Any, rotations: Any, centers: Any, focals: Any, limit: float,
    point: Any, errors: Any, weights: Any,
) -> int:  # fmt: skip
    """Write squared errors in pixels, and weights: focal^2 within the limit, else 0; return how many are."""
    inside = 0
    for o in range(k):
        row = rows[o]
        at = cameras[row]
        scale = focals[at] ** 2
        x, y, z = point[0] - centers[at, 0], point[1] - centers[at, 1], point[2] - centers[at, 2]
        depth = rotations[at, 2, 0] * x + rotations[at, 2, 1] * y + rotations[at, 2, 2] * z
        errors[o] = np.inf
        if depth > 0.0:
            du = rotations[at, 0, 0] * x + rotations[at, 0, 1] * y + rotations[at, 0, 2] * z
            dv = rotations[at, 1, 0] * x + rotations[at, 1, 1] * y + rotations[at, 1, 2] * z
            du, dv = du / depth - plane[row, 0], dv / depth - plane[row, 1]
            errors[o] = scale * (du * du + dv * dv)
        weights[o] = 0.0
        if errors[o] <= limit:
            weights[o] = scale
            inside += 1
    return inside


@inner_kernel
def _look_back(
    rows: Any, k: int, cameras: Any, centers: Any, images: Any, errors: Any, weights: Any, point: Any,
    rays: Any,
) -> int:  # fmt: skip
    """Keep the best observation of each image, others get weight -1; write the rays back, return how many."""
    length = 0
    for o in range(k):
        if weights[o] == 0.0:
            continue
        image = images[cameras[rows[o]]]
        other = o + 1
        while other < k and images[cameras[rows[other]]] == image and weights[o] > 0.0:
            if weights[other] > 0.0:
                weights[o if errors[other] < errors[o] else other] = -1.0
            other += 1
        if weights[o] > 0.0:
            center = centers[cameras[rows[o]]]
            x, y, z = point[0] - center[0], point[1] - center[1], point[2] - center[2]
            size = np.sqrt(x * x + y * y + z * z)
            rays[length, 0], rays[length, 1], rays[length, 2] = x / size, y / size, z / size
            length += 1
    return length


@inner_kernel
def _is_wide(rays: Any, length: int, cosine: float) -> bool:
    """Return whether two of the rays make the least angle; of very many, one is among the first."""
    for o in range(length):
        for other in range(min(o, _WIDE_AMONG)):
            d = rays[o, 0] * rays[other, 0] + rays[o, 1] * rays[other, 1] + rays[o, 2] * rays[other, 2]
            if d <= cosine:
                return True
    return False


@inner_kernel
def _search(
    rows: Any, rays: Any, k: int, cameras: Any, plane: Any, rotations: Any, centers: Any, focals: Any,
    limit: float, cosine: float, point: Any, best: Any, errors: Any, weights: Any,
) -> bool:  # fmt: skip
    """Write the point of two observations with the least truncated squares; return whether there is one."""
    least = np.inf
    for s in range(min(k * (k - 1) // 2, _PAIRS)):
        i, j = _pair(s, k)
        p, q = centers[cameras[rows[i]]], centers[cameras[rows[j]]]
        if not _middle(p, rays[i], q, rays[j], cosine, point):
            continue
        _weigh(rows, k, cameras, plane, rotations, centers, focals, limit, point, errors, weights)
        cost = 0.0
        for o in range(k):
            cost += min(errors[o], limit)
        if cost < least:
            least = cost
            best[0], best[1], best[2] = point[0], point[1], point[2]
    return bool(least < np.inf)


@kernel
def _triangulate(begin: int, end: int, count: int, given: Any, points: Any, track_of: Any, seen: Any) -> int:
    """Write the points of the tracks begin..end-1 from number `count` on; return their number then."""
    offsets, cameras, plane, rotations, centers, focals, images, figures, most, longest = given
    limit, cosine, fewest = figures[0], figures[1], figures[2]
    rows, rays = np.empty(longest, np.int64), np.empty((longest, 3))
    weights, errors = np.empty(longest), np.empty(longest)
    best, point = np.empty(3), np.empty(3)
    for t in range(begin, end):
        for _ in range(most):
            k = _gather(offsets[t], offsets[t + 1], cameras, plane, rotations, seen, rows, rays)
            if k < fewest:
                break
            found = _search(
                rows, rays, k, cameras, plane, rotations, centers, focals, limit, cosine, point, best, errors,
                weights,
            )  # fmt: skip
            moved, inside = 1.0, 0
            for step in range(_STEPS + 1 if found else 0):
                inside = _weigh(
                    rows, k, cameras, plane, rotations, centers, focals, limit, best, errors, weights
                )  # fmt: skip
                if inside < fewest or step == _STEPS or moved < _STILL:
                    break
                moved = _step(rows, k, cameras, plane, rotations, centers, weights, best)
                if moved < 0.0:
                    inside = 0
                    break
            if inside < fewest:
                break
            length = _look_back(rows, k, cameras, centers, images, errors, weights, best, rays)
            if length < fewest or not _is_wide(rays, length, cosine):
                break
            for o in range(k):
                if weights[o] != 0.0:
                    seen[rows[o]] = count if weights[o] > 0.0 else -2
            points[count, 0], points[count, 1], points[count, 2] = best[0], best[1], best[2]
            track_of[count] = t
            count += 1
    # An observation that another of its image surpasses is of no point either.
    for row in range(offsets[begin], offsets[end]):
        if seen[row] == -2:
            seen[row] = -1
    return count
