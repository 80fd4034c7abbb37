"""Unit vectors, angles, tangent bases, similarity alignment, mean rotations: float64 arrays."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.record import Record

SIGMA_PER_MEDIAN = 1.4826
"""Standard deviation of a normal x over the median of |x|: 1 / Phi^-1(3 / 4)."""

MEDIAN_NORMAL_LENGTH = 1.538
"""Median length of a vector of three normal components of variance 1: root of the median of chi2(3)."""

METRIC_SIGMA = 0.1
"""Relative standard deviation up to which a scale counts as known; a rough one is told with a warning."""

INSIDE = 30.0
"""Median distances from the median; cameras and points within say how large the scene is."""

FLOAT32_REACH = 1e-6 * 2.0**24
"""Median spreads from the origin within which float32 moves no point by more than a millionth of a spread.

That is hundredths of a pixel in a picture of the scene.
"""

FLIP_YZ = np.diag([1.0, -1.0, -1.0])
"""Turn of camera axes about x, its own inverse: y up, looking along -z (OpenGL, NeRF), to COLMAP's."""

_NUM_SAMPLES = 256  # draws of 3 points; if half are good so is 1 draw of 8, none in 256 has odds 1e-15
_NUM_REFINED_SAMPLES = 4  # draws; only the best are refined, as each takes many reweightings
_MAX_REWEIGHTINGS = 200  # steps, a bound: reweighting stops once nothing changes

_ROUNDING = 1e-14  # share of the largest distance; a smaller distance is 0


def normalized(vectors: FloatArray) -> FloatArray:
    """Return the unit vectors along the last axis of `vectors`, shape (..., d); zero vectors give NaN."""
    squares = np.moveaxis(vectors * vectors, -1, 0)
    lengths = np.sqrt(sum(squares[1:], squares[0]))  # by columns: three times faster for few vectors
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(vectors / lengths[..., None])


def angle_between(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the angles in radians between unit vectors, shapes (..., d) and (..., d).

    Uses tan(angle / 2) = |a - b| / |a + b| (Kahan), exact to rounding at 0 and at 180 degrees, where
    arccos of the inner product loses half of the digits.
    """
    half: FloatArray = np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
    return 2.0 * half


def angle_between_deg(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the same angles in degrees."""
    return np.degrees(angle_between(a, b))


def tangent_bases(directions: FloatArray) -> FloatArray:
    """Return orthonormal bases (m, d, d - 1), in columns, of the complements of unit vectors (m, d).

    They are the last columns of the Householder reflection that maps the first axis to -+ `directions[e]`.
    """
    m, d = directions.shape
    sign = np.where(directions[:, 0] < 0.0, -1.0, 1.0)
    mirror = directions.copy()
    mirror[:, 0] += sign  # no cancellation: both terms have the same sign
    mirror /= np.linalg.norm(mirror, axis=1, keepdims=True)
    reflection = np.eye(d) - 2.0 * mirror[:, :, None] * mirror[:, None, :]
    return np.ascontiguousarray(reflection[:, :, 1:]).reshape(m, d, d - 1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Similarity:
    """The map x -> scale * rotation @ x + translation."""

    scale: float
    rotation: FloatArray
    """(d, d), orthogonal with determinant +1."""
    translation: FloatArray
    """(d,)"""

    def apply(self, points: FloatArray) -> FloatArray:
        """Map points of shape (n, d)."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)

    @property
    def facts(self) -> "Alignment":
        """The map in plain values."""
        rotation, translation = self.rotation.tolist(), self.translation.tolist()
        return Alignment(scale=self.scale, rotation=rotation, translation=translation)


UNMOVED = Similarity(scale=1.0, rotation=np.eye(3), translation=np.zeros(3))
"""The map in space that leaves all where it is."""


class Alignment(Record):
    """A similarity of the world: scale * rotation @ center + translation."""

    scale: Annotated[float, "Units of the one world in one of the other."]
    rotation: Annotated[list[list[float]], "3 rows."]
    translation: Annotated[list[float], "In units of the world that is mapped to."]


def invert(similarity: Similarity) -> Similarity:
    """Return the inverse map."""
    turn, scale = similarity.rotation.T, 1.0 / similarity.scale
    return Similarity(scale=scale, rotation=turn, translation=-scale * turn @ similarity.translation)


def compose(outer: Similarity, inner: Similarity) -> Similarity:
    """Return x -> outer(inner(x))."""
    return Similarity(
        scale=outer.scale * inner.scale,
        rotation=outer.rotation @ inner.rotation,
        translation=outer.apply(inner.translation[None])[0],
    )


def fit_similarity(
    source: FloatArray,
    target: FloatArray,
    weights: FloatArray | None = None,
    *,
    rotate: bool = True,
    resize: bool = True,
) -> Similarity:
    """Return the similarity that maps `source` onto `target` with least weighted squares.

    The scale is never negative: a mirrored source, which would fit best turned inside out, gets scale 0. A
    source whose points coincide leaves the scale open and gets 1.

    Args:
        source, target: (n, d) corresponding points.
        weights: (n,) non-negative weights, not all 0; equal if None.
        rotate: False keeps the axes and fits scale and translation only.
        resize: False keeps the scale.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI
    1991.
    """
    w = np.full(len(source), 1.0 / len(source)) if weights is None else weights / weights.sum()
    source_mean, target_mean = w @ source, w @ target
    x, y = source - source_mean, target - target_mean
    spread = float(w @ np.sum(x * x, axis=1))
    cross = (w[:, None] * y).T @ x
    rotation = nearest_rotations(cross) if rotate else np.eye(source.shape[1])
    scale = max(0.0, float(np.sum(rotation * cross)) / spread) if spread > 0.0 and resize else 1.0
    return Similarity(
        scale=scale, rotation=rotation, translation=target_mean - scale * rotation @ source_mean
    )


def median_spread(points: FloatArray) -> float:
    """Return the median distance of points (n, d) from their coordinate-wise median.

    Where more than half of the points coincide to rounding it is the largest distance instead; 0 only if all
    coincide. Points that lie 1e13 times as far away do not matter, as long as they are fewer than half.
    """
    distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    median, largest = float(np.median(distances)), float(distances.max())
    return median if median > _ROUNDING * largest else largest


def distances_in_spreads(points: FloatArray, reference: FloatArray) -> FloatArray:
    """Return the distances of points (n, d) from the median of others, (n,), in median spreads of these."""
    distances = np.linalg.norm(points - np.median(reference, axis=0), axis=1)
    return np.asarray(distances / max(median_spread(reference), np.finfo(np.float64).tiny))


def extent_of(points: FloatArray) -> float:
    """Return the diagonal of the box around points (n, d), without those that fly far outside."""
    inside = points[distances_in_spreads(points, points) <= INSIDE]
    return float(np.linalg.norm(np.ptp(inside, axis=0)))


def fit_similarity_l1(
    source: FloatArray, target: FloatArray, *, rotate: bool = True, resize: bool = True, cap: float = np.inf
) -> Similarity:
    """Return the similarity that minimizes the sum of unsquared distances min(distance, cap).

    Without a cap, a few bad targets hardly matter, but one source point that is far enough away shrinks the
    scale towards 0: it costs its distance at the true scale, and nearly nothing at scale 0. With a finite
    cap, half of the points may be anywhere.

    Iteratively reweighted least squares (weight 1 / distance, 0 beyond the cap) from the equal-weight
    solution and from the best fits of a few points drawn with a fixed seed; the lowest sum is kept. Distances
    in the weights are at least 1e-9 of the target's spread, so that exact fits do not stop the iteration.

    Args:
        source, target: (n, d) corresponding points, n >= 1.
        rotate: False keeps the axes and fits scale and translation only.
        resize: False keeps the scale.
        cap: positive distance, in the target's units, beyond which a point counts as lost.
    """
    floor = 1e-9 * (median_spread(target) or 1.0)

    def distances(similarity: Similarity) -> FloatArray:
        return np.asarray(np.linalg.norm(similarity.apply(source) - target, axis=1))

    def total(apart: FloatArray) -> float:
        return float(np.minimum(apart, cap).sum())

    def cost(similarity: Similarity) -> float:
        return total(distances(similarity))

    def reweigh(best: Similarity) -> Similarity:
        apart = distances(best)
        for _ in range(_MAX_REWEIGHTINGS):
            weights = np.where(apart < cap, floor / np.maximum(apart, floor), 0.0)
            if not weights.any():
                break
            candidate = fit_similarity(source, target, weights, rotate=rotate, resize=resize)
            apart_then = distances(candidate)
            if total(apart_then) >= total(apart) * (1.0 - 1e-12):
                break
            best, apart = candidate, apart_then
        return best

    plain = fit_similarity(source, target, rotate=rotate, resize=resize)
    sampled = sorted(fits_of_few_points(source, target, rotate=rotate, resize=resize), key=cost)
    return min((reweigh(start) for start in [plain, *sampled[:_NUM_REFINED_SAMPLES]]), key=cost)


def fits_of_few_points(
    source: FloatArray, target: FloatArray, *, rotate: bool, resize: bool = True
) -> list[Similarity]:
    """Return similarities that each fit as few points as determine one, drawn with a fixed seed."""
    size = min(len(source), source.shape[1] if rotate else 2)
    rng = np.random.default_rng(0)
    few = np.array([rng.choice(len(source), size, replace=False) for _ in range(_NUM_SAMPLES)])
    w = np.full(size, 1.0 / size)
    source_means, target_means = w @ source[few], w @ target[few]
    x, y = source[few] - source_means[:, None], target[few] - target_means[:, None]
    spreads = np.vecdot(np.sum(x * x, axis=2), w)
    crosses = np.swapaxes(w[:, None] * y, 1, 2) @ x
    eyes = np.broadcast_to(np.eye(source.shape[1]), crosses.shape)
    rotations = nearest_rotations(crosses) if rotate else eyes
    alike = np.maximum((rotations * crosses).sum(axis=(1, 2)), 0.0)
    scales = np.divide(alike, spreads, out=np.ones_like(spreads), where=spreads > 0.0)
    scales = scales if resize else np.ones_like(scales)
    moved = ((scales[:, None, None] * rotations) @ source_means[:, :, None])[:, :, 0]
    fits = zip(scales.tolist(), rotations, target_means - moved, strict=True)
    return [Similarity(scale=scale, rotation=turn, translation=shift) for scale, turn, shift in fits]


def rotation_angles_deg(rotations: FloatArray) -> FloatArray:
    """Return the angles of rotations (..., 3, 3) in degrees, [0, 180], by atan2: exact at both ends."""
    skew = rotations - np.swapaxes(rotations, -1, -2)
    sine = np.linalg.norm(skew, axis=(-2, -1)) / np.sqrt(8.0)
    cosine = (np.trace(rotations, axis1=-2, axis2=-1) - 1.0) / 2.0
    angles: FloatArray = np.arctan2(sine, cosine)
    return np.degrees(angles)


def mean_rotation_l1(rotations: FloatArray) -> FloatArray:
    """Return the rotation with the least sum of chordal distances |R_i - R|_F to rotations (n, d, d), n >= 1.

    A robust mean: chordal distances are bounded, so that any majority that agrees wins. Weiszfeld's iteration
    starts from the chordal mean of the half of the rotations closest to the best single one (out of at most
    100, drawn with a fixed seed).

    Source: Hartley, Aftab, Trumpf, "L1 rotation averaging using the Weiszfeld algorithm", CVPR 2011; the
    chordal instead of the geodesic distance.
    """
    floor = 1e-9  # in the weights; chordal distances are at most 2 sqrt(2) for d = 3

    def distances(rotation: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(rotations - rotation, axis=(1, 2)))

    count = len(rotations)
    candidates = np.random.default_rng(0).permutation(count)[:100]
    center = rotations[min(candidates, key=lambda k: float(distances(rotations[k]).sum()))]
    nearest = np.argsort(distances(center), kind="stable")[: count // 2 + 1]
    best = nearest_rotations(rotations[nearest].sum(axis=0))
    for _ in range(_MAX_REWEIGHTINGS):
        weights = floor / np.maximum(distances(best), floor)
        candidate = nearest_rotations(np.einsum("k,kij->ij", weights, rotations))
        if distances(candidate).sum() >= distances(best).sum() * (1.0 - 1e-12):
            break
        best = candidate
    return best


def nearest_rotations(matrices: FloatArray) -> FloatArray:
    """Return the rotations R that maximize trace(R^T M) for matrices M, (..., d, d)."""
    u, _, vt = np.linalg.svd(matrices)
    flip = np.ones(matrices.shape[:-1])
    flip[..., -1] = np.where(np.linalg.det(u) * np.linalg.det(vt) < 0.0, -1.0, 1.0)
    return np.asarray((u * flip[..., None, :]) @ vt)


def principal_lengths(points: FloatArray) -> FloatArray:
    """Return the singular values of points (k, 3) around their mean, largest first."""
    return np.asarray(np.linalg.svd(points - points.mean(axis=0), compute_uv=False))


def turned_deg(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return by how many degrees rotations (n, 3, 3) turned, exactly 0 where they kept their bits."""
    same = (before == after).all(axis=(1, 2))
    return np.where(same, 0.0, rotation_angles_deg(after.transpose(0, 2, 1) @ before))
