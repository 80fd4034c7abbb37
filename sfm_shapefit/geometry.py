"""Unit vectors, angles, tangent bases and similarity alignment: the geometry that other modules share.

Everything here works on plain float64 arrays and imports nothing but numpy.
"""

from dataclasses import dataclass

import numpy as np

from sfm_shapefit.arrays import FloatArray


def normalized(vectors: FloatArray) -> FloatArray:
    """Return the unit vectors along the last axis of `vectors`, shape (..., d); zero vectors give NaN."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def angle_between_deg(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the angles in degrees between unit vectors, shapes (..., d) and (..., d).

    Uses tan(angle / 2) = |a - b| / |a + b| (Kahan), exact to rounding at 0 and at 180 degrees, where
    arccos of the inner product loses half of the digits.
    """
    half = np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
    return np.degrees(2.0 * half)


def tangent_bases(directions: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the complement of each unit vector.

    Args:
        directions: (m, d) unit vectors.

    Returns:
        (m, d, d - 1); the columns of slice e are orthonormal and orthogonal to `directions[e]`. They
        are the last columns of the Householder reflection that maps the first axis to -+ `directions[e]`.
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
        mapped: FloatArray = self.scale * points @ self.rotation.T + self.translation
        return mapped


def fit_similarity(
    source: FloatArray, target: FloatArray, weights: FloatArray | None = None, *, rotate: bool = True
) -> Similarity:
    """Return the similarity that maps `source` onto `target` with least weighted squares.

    Args:
        source, target: (n, d) corresponding points.
        weights: (n,) non-negative weights; equal if None.
        rotate: False keeps the axes and fits scale and translation only.

    Source: Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", PAMI 1991, eqs. 40-42.
    """
    w = np.full(len(source), 1.0 / len(source)) if weights is None else weights / weights.sum()
    source_mean, target_mean = w @ source, w @ target
    x, y = source - source_mean, target - target_mean
    spread = float(w @ np.sum(x * x, axis=1))
    cross = (w[:, None] * y).T @ x
    rotation = _nearest_rotation(cross) if rotate else np.eye(source.shape[1])
    scale = float(np.sum(rotation * cross)) / spread if spread > 0.0 else 1.0
    return Similarity(
        scale=scale, rotation=rotation, translation=target_mean - scale * rotation @ source_mean
    )


def fit_similarity_l1(
    source: FloatArray, target: FloatArray, *, rotate: bool = True, iterations: int = 200
) -> Similarity:
    """Return the similarity that minimises the sum of unsquared distances: a few bad points hardly matter.

    Iteratively reweighted least squares, from the equal-weight solution and from the one that fits the
    best half of the points; the lower sum is kept. The floor of the weights is 1e-9 of the target's
    spread, so that points which fit exactly do not stop the iteration.

    Args:
        source, target: (n, d) corresponding points, n >= 1.
        rotate: False keeps the axes and fits scale and translation only.
        iterations: limit of reweighting steps from each start; it stops earlier once nothing changes.
    """
    spread = float(np.median(np.linalg.norm(target - np.median(target, axis=0), axis=1)))
    floor = max(1e-9 * spread, np.finfo(float).tiny)

    def distances(similarity: Similarity) -> FloatArray:
        return np.asarray(np.linalg.norm(similarity.apply(source) - target, axis=1))

    def reweighted(start: Similarity) -> tuple[float, Similarity]:
        best, cost = start, float(distances(start).sum())
        current = start
        for _ in range(iterations):
            weights = 1.0 / np.maximum(distances(current), floor)
            current = fit_similarity(source, target, weights, rotate=rotate)
            new_cost = float(distances(current).sum())
            if new_cost >= cost * (1.0 - 1e-12):
                break
            best, cost = current, new_cost
        return cost, best

    plain = fit_similarity(source, target, rotate=rotate)
    closest_half = distances(plain) <= np.median(distances(plain))
    trimmed = fit_similarity(source[closest_half], target[closest_half], rotate=rotate)
    return min(reweighted(plain), reweighted(trimmed), key=lambda pair: pair[0])[1]


def _nearest_rotation(matrix: FloatArray) -> FloatArray:
    """Return the rotation R that maximises trace(R^T matrix)."""
    u, _, vt = np.linalg.svd(matrix)
    flip = np.ones(len(matrix))
    flip[-1] = np.sign(np.linalg.det(u) * np.linalg.det(vt)) or 1.0
    rotation: FloatArray = (u * flip) @ vt
    return rotation
