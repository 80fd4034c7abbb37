"""Matches and known rotations to one direction per image pair, with its support and uncertainty.

With both rotations known, a match gives two unit rays a, b in world axes, and the baseline
d = C_i - C_j lies in their plane: <a x b, d> = 0. The residual of a match is its Sampson error,

    r = <a x b, d> / (sigma sqrt(|a x d|^2 + |b x d|^2)),    sigma = angle of one pixel,

the distance in pixels, to first order, that both image points must move for the rays to meet. The
direction minimises sum rho(r) with the Geman-McClure kernel: two matches give a hypothesis
(a1 x b1) x (a2 x b2), the best of many by truncated squares starts reweighted least squares, whose
step is the smallest eigenvector of M = sum w (a x b)(a x b)^T / (|a x d|^2 + |b x d|^2). The sign is
the one that puts the points in front of both cameras. M restricted to the plane orthogonal to d is
the information matrix of the direction.

Sources: Sampson error and cheirality: Hartley and Zisserman, "Multiple View Geometry", 2nd ed.,
sections 11.4.3 and 21; truncated-squares consensus: Torr and Zisserman, "MLESAC", CVIU 2000;
Geman-McClure weights: Zhang, "Parameter estimation techniques", IVC 1997, table 1.
"""

import enum
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.geometry import normalized, tangent_bases
from sfm_shapefit.jit import kernel

_MIN_MATCHES = 5  # two fix a direction; below this a robust fit means nothing
_REWEIGHTINGS = 15
_MEDIAN_TO_SIGMA = 1.4826  # of |x| for a normal x
_MIN_NOISE_PX = 1e-3  # exact matches still get a finite information
_MIN_SCALE_PX = 0.5  # the kernel's width stays in this range: matches are never better, inliers never worse
_MAX_SCALE_PX = 4.0
_MEASURES = ("inliers", "front", "behind", "voters", "residual_px", "parallax_rad")
_PARALLAX_VOTE_PX = 2.0  # a match votes on the sign only if its rays differ by more than this


class DirectionStatus(enum.Enum):
    """Why a pair has, or has not, a direction; the value is what reports say of it."""

    USABLE = "usable"
    TOO_FEW_MATCHES = "too few matches"
    FEW_INLIERS = "too few inlier matches in front of both cameras"
    LOW_INLIER_RATIO = "most matches contradict the given rotations"
    NO_PARALLAX = "no parallax: the matches do not determine the direction"
    AMBIGUOUS_SIGN = "points lie in front of the cameras for either sign of the direction"
    ROTATION_MISMATCH = "the relative rotation contradicts the given rotations"


CONTRADICTIONS = (DirectionStatus.LOW_INLIER_RATIO, DirectionStatus.ROTATION_MISMATCH)
"""The reasons that speak against the given rotations."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DirectionOptions:
    """What a pair must show before its direction is believed."""

    min_inliers: int = 15
    """Least number of inlier matches with parallax whose point lies in front of both cameras."""
    min_inlier_ratio: float = 0.5
    """Least share of inliers among the pair's matches; repeated facades show up below it."""
    min_sign_majority: float = 5.0
    """Points in front of both cameras must outnumber those behind both by this factor."""
    max_sigma_deg: float = 10.0
    """Largest standard deviation of the direction; beyond it there is no parallax to speak of."""
    inlier_threshold_px: float = 2.0
    """Largest Sampson error of an inlier; a Sampson error of 2 px allows 2.8 px off the epipolar line."""
    max_rotation_error_deg: float = 10.0
    """Largest angle between a stored relative rotation and the given ones (relative poses only)."""
    num_hypotheses: int = 200
    """Two-match hypotheses per pair."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("min_inliers", 2, np.inf),
            ("min_inlier_ratio", 0.0, 1.0),
            ("min_sign_majority", 1.0, np.inf),
            ("max_sigma_deg", 1e-6, 90.0),
            ("inlier_threshold_px", 1e-3, np.inf),
            ("max_rotation_error_deg", 1e-6, 180.0),
            ("num_hypotheses", 1, 10_000),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"DirectionOptions.{name} must lie in [{low}, {high}], got {value}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairDirections:
    """Directions of k image pairs and the evidence for each; rows without a direction hold NaN."""

    pairs: IntArray
    """(k, 2) camera indices i < j."""
    directions: FloatArray
    """(k, 3) unit directions of C_i - C_j in world axes."""
    status: Sequence[DirectionStatus]
    """k values; only USABLE rows have a direction."""
    num_matches: IntArray
    """(k,) matches the pair came with."""
    num_inliers: IntArray
    """(k,) matches whose Sampson error is below the inlier threshold."""
    cheirality_fraction: FloatArray
    """(k,) share of the inliers with parallax whose point lies in front of both cameras."""
    median_residual_px: FloatArray
    """(k,) median Sampson error of the inliers."""
    parallax_deg: FloatArray
    """(k,) median angle between the two rays of an inlier."""
    covariance: FloatArray
    """(k, 2, 2) covariance of the direction in rad^2, in the basis `tangent_bases(directions)`."""

    def usable(self) -> IntArray:
        """Return the rows that have a direction."""
        return np.flatnonzero([status is DirectionStatus.USABLE for status in self.status])

    def counts(self) -> dict[DirectionStatus, int]:
        """Return how many pairs have each status, most frequent first."""
        return dict(Counter(self.status).most_common())

    def sigma_deg(self) -> FloatArray:
        """Return the standard deviation along each direction's least certain axis, shape (k,)."""
        largest = np.linalg.eigvalsh(np.nan_to_num(self.covariance))[:, -1]
        missing = np.isnan(self.covariance).any(axis=(1, 2))
        return np.where(missing, np.nan, np.degrees(np.sqrt(np.maximum(largest, 0.0))))


def concatenate(parts: Sequence[PairDirections]) -> PairDirections:
    """Return the rows of all parts, in order.

    Raises:
        ValueError: if there are no parts.
    """
    columns: dict[str, Any] = {}
    for field in fields(PairDirections):
        columns[field.name] = np.concatenate([getattr(part, field.name) for part in parts])
    columns["status"] = list(columns["status"])
    return PairDirections(**columns)


def estimate_directions(
    pairs: IntArray,
    offsets: IntArray,
    rays_i: FloatArray,
    rays_j: FloatArray,
    pixel_angles: FloatArray,
    options: DirectionOptions | None = None,
    threads: int = 1,
) -> PairDirections:
    """Return one direction per pair from its matches and the known rotations.

    Each pair is estimated on its own and with the same draws, so neither batches nor threads change
    a bit of the answer.

    Args:
        pairs: (k, 2) camera indices.
        offsets: (k + 1,) rows of the matches of pair p are offsets[p] to offsets[p + 1].
        rays_i, rays_j: (M, 3) unit rays of the matched points in world axes.
        pixel_angles: (k,) angle of one pixel in radians, 1 / focal length in px.
        options: what to believe; defaults if None.
        threads: number of threads to share the pairs among.
    """
    options = options or DirectionOptions()
    k = len(pairs)
    directions, measures, information = np.zeros((k, 3)), np.zeros((k, len(_MEASURES))), np.zeros((k, 3, 3))
    a, b = np.ascontiguousarray(rays_i), np.ascontiguousarray(rays_j)
    settings = (options.inlier_threshold_px, options.num_hypotheses)

    def run(rows: IntArray) -> None:
        _estimate_pairs(rows, offsets, a, b, pixel_angles, *settings, directions, measures, information)

    shares = np.array_split(np.arange(k, dtype=np.int64), max(1, threads))
    with ThreadPoolExecutor(max(1, threads)) as pool:
        list(pool.map(run, shares))
    return _judged(pairs, np.diff(offsets), directions, measures, information, options)


def _judged(
    pairs: IntArray,
    num_matches: IntArray,
    directions: FloatArray,
    measures: FloatArray,
    information: FloatArray,
    options: DirectionOptions,
) -> PairDirections:
    """Decide which estimates to believe, and give the others their reason."""
    inliers, front, behind, voters, residual_px, parallax_rad = measures.T
    covariance = _tangent_covariance(directions, information)
    sigma_deg = np.degrees(np.sqrt(np.linalg.eigvalsh(covariance)[:, -1]))
    rules = (  # the first that fires names the reason
        (num_matches < max(options.min_inliers, _MIN_MATCHES), DirectionStatus.TOO_FEW_MATCHES),
        (inliers < options.min_inlier_ratio * num_matches, DirectionStatus.LOW_INLIER_RATIO),
        (inliers < options.min_inliers, DirectionStatus.FEW_INLIERS),
        ((sigma_deg > options.max_sigma_deg) | (voters < options.min_inliers), DirectionStatus.NO_PARALLAX),
        (front <= options.min_sign_majority * behind, DirectionStatus.AMBIGUOUS_SIGN),
        (front < options.min_inliers, DirectionStatus.FEW_INLIERS),
    )
    status = np.full(len(pairs), DirectionStatus.USABLE, dtype=object)
    for fired, reason in reversed(rules):
        status[fired] = reason
    usable: BoolArray = np.array([value is DirectionStatus.USABLE for value in status], dtype=np.bool_)
    return PairDirections(
        pairs=pairs,
        directions=np.where(usable[:, None], directions, np.nan),
        status=list(status),
        num_matches=np.asarray(num_matches, dtype=np.int64),
        num_inliers=inliers.astype(np.int64),
        cheirality_fraction=front / np.maximum(voters, 1.0),
        median_residual_px=residual_px,
        parallax_deg=np.degrees(parallax_rad),
        covariance=np.where(usable[:, None, None], covariance, np.nan),
    )


def _tangent_covariance(directions: FloatArray, information: FloatArray) -> FloatArray:
    """Return the inverse of the information in each direction's tangent basis, shape (k, 2, 2).

    An eigenvalue of no information becomes a variance of (1 rad)^2, which means: unknown.
    """
    bases = tangent_bases(
        np.where(np.linalg.norm(directions, axis=1, keepdims=True) > 0.0, directions, [1.0, 0.0, 0.0])
    )
    projected = np.einsum("kab,kac,kcd->kbd", bases, information, bases)
    values, vectors = np.linalg.eigh(projected)
    variances = 1.0 / np.maximum(values, 1.0)
    covariance: FloatArray = np.einsum("kab,kb,kcb->kac", vectors, variances, vectors)
    return covariance


def from_relative_poses(
    pairs: IntArray,
    cam2_from_cam1: tuple[FloatArray, FloatArray],
    rotations: FloatArray,
    num_inliers: IntArray,
    options: DirectionOptions | None = None,
) -> PairDirections:
    """Return directions R_j^T t_ij from relative poses and the known rotations.

    Args:
        pairs: (k, 2) camera indices i < j.
        cam2_from_cam1: rotations (k, 3, 3) and translations (k, 3), of any positive length, of camera j
            from camera i.
        rotations: (n, 3, 3) cam_from_world of all cameras.
        num_inliers: (k,) inlier matches behind each relative pose.
        options: what to believe; defaults if None.

    Returns:
        Directions; what only matches can tell (residual, parallax, covariance) is NaN.
    """
    options = options or DirectionOptions()
    relative_rotations, translations = cam2_from_cam1
    r_i, r_j = rotations[pairs[:, 0]], rotations[pairs[:, 1]]
    known = r_j @ r_i.transpose(0, 2, 1)
    sine = np.linalg.norm(relative_rotations - known, axis=(1, 2)) / np.sqrt(8.0)  # of half the angle
    mismatch = 2.0 * np.degrees(np.arcsin(np.minimum(sine, 1.0))) > options.max_rotation_error_deg
    status = np.full(len(pairs), DirectionStatus.USABLE, dtype=object)
    status[num_inliers < options.min_inliers] = DirectionStatus.TOO_FEW_MATCHES
    status[mismatch] = DirectionStatus.ROTATION_MISMATCH
    usable: BoolArray = np.array([value is DirectionStatus.USABLE for value in status], dtype=np.bool_)
    directions = normalized(np.einsum("kab,ka->kb", r_j, translations))
    unknown = np.full(len(pairs), np.nan)
    return PairDirections(
        pairs=pairs,
        directions=np.where(usable[:, None], directions, np.nan),
        status=list(status),
        num_matches=num_inliers,
        num_inliers=num_inliers,
        cheirality_fraction=unknown,
        median_residual_px=unknown,
        parallax_deg=unknown,
        covariance=np.full((len(pairs), 2, 2), np.nan),
    )


@kernel(exact=True)
def _estimate_pairs(
    rows: IntArray,
    offsets: IntArray,
    rays_i: FloatArray,
    rays_j: FloatArray,
    pixel_angles: FloatArray,
    threshold_px: float,
    num_hypotheses: int,
    directions: FloatArray,
    measures: FloatArray,
    information: FloatArray,
) -> None:
    """Fill the output rows of the given pairs; rows with fewer than _MIN_MATCHES stay zero."""
    for p in rows:
        first, last = offsets[p], offsets[p + 1]
        if last - first < _MIN_MATCHES:
            continue
        a, b = rays_i[first:last], rays_j[first:last]
        normals = _epipolar_normals(a, b, pixel_angles[p])
        d = _best_hypothesis(a, b, normals, threshold_px, num_hypotheses)
        d = _reweighted(a, b, normals, d)
        sign = _measure(a, b, normals, d, pixel_angles[p], threshold_px, measures[p])
        noise_px = max(_MEDIAN_TO_SIGMA * measures[p, 4], _MIN_NOISE_PX)
        _inlier_information(a, b, normals, d, threshold_px, noise_px, information[p])
        directions[p] = sign * d


@kernel(exact=True)
def _epipolar_normals(a: FloatArray, b: FloatArray, pixel_angle: float) -> FloatArray:
    """Return (a x b) / pixel_angle for every match: its length is the parallax in pixels."""
    normals = np.empty_like(a)
    for k in range(len(a)):
        normals[k, 0] = (a[k, 1] * b[k, 2] - a[k, 2] * b[k, 1]) / pixel_angle
        normals[k, 1] = (a[k, 2] * b[k, 0] - a[k, 0] * b[k, 2]) / pixel_angle
        normals[k, 2] = (a[k, 0] * b[k, 1] - a[k, 1] * b[k, 0]) / pixel_angle
    return normals


@kernel(exact=True)
def _squared_gradient(a: FloatArray, b: FloatArray, d: FloatArray, k: int) -> float:
    """Return |a x d|^2 + |b x d|^2 of match k, floored where both rays run along the baseline."""
    along_a = a[k, 0] * d[0] + a[k, 1] * d[1] + a[k, 2] * d[2]
    along_b = b[k, 0] * d[0] + b[k, 1] * d[1] + b[k, 2] * d[2]
    return float(max(2.0 - along_a * along_a - along_b * along_b, 1e-12))


@kernel(exact=True)
def _squared_residual(a: FloatArray, b: FloatArray, normals: FloatArray, d: FloatArray, k: int) -> float:
    """Return the squared Sampson error of match k in px^2."""
    e = normals[k, 0] * d[0] + normals[k, 1] * d[1] + normals[k, 2] * d[2]
    return float(e * e / _squared_gradient(a, b, d, k))


@kernel(exact=True)
def _best_hypothesis(
    a: FloatArray, b: FloatArray, normals: FloatArray, threshold_px: float, num_hypotheses: int
) -> FloatArray:
    """Return the two-match direction of least truncated cost; the draws are the same for every pair."""
    count = len(a)
    best, d = np.zeros(3), np.zeros(3)
    best[0] = 1.0
    best_cost = np.inf
    limit = threshold_px * threshold_px
    state = np.uint64(0x9E3779B97F4A7C15)
    for _ in range(num_hypotheses):
        state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
        first = np.int64((state >> np.uint64(33)) % np.uint64(count))
        state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
        second = np.int64((state >> np.uint64(33)) % np.uint64(count))
        m, n = normals[first], normals[second]
        d[0] = m[1] * n[2] - m[2] * n[1]
        d[1] = m[2] * n[0] - m[0] * n[2]
        d[2] = m[0] * n[1] - m[1] * n[0]
        length = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        if length <= 1e-12:
            continue
        d /= length
        cost = 0.0
        for k in range(count):
            cost += min(_squared_residual(a, b, normals, d, k), limit)
            if cost >= best_cost:
                break
        if cost < best_cost:
            best_cost = cost
            best[:] = d
    return best


@kernel(exact=True)
def _reweighted(a: FloatArray, b: FloatArray, normals: FloatArray, start: FloatArray) -> FloatArray:
    """Return the direction refined by reweighted least squares with the Geman-McClure kernel."""
    d = start.copy()
    squares = np.empty(len(a))
    for _ in range(_REWEIGHTINGS):
        for k in range(len(a)):
            squares[k] = _squared_residual(a, b, normals, d, k)
        scale = 3.0 * _MEDIAN_TO_SIGMA * np.sqrt(np.median(squares))
        scale = min(max(scale, _MIN_SCALE_PX), _MAX_SCALE_PX)
        moments = np.zeros((3, 3))
        for k in range(len(a)):
            weight = 1.0 / (1.0 + squares[k] / (scale * scale)) ** 2
            weight /= _squared_gradient(a, b, d, k)
            for row in range(3):
                for column in range(3):
                    moments[row, column] += weight * normals[k, row] * normals[k, column]
        new = np.ascontiguousarray(np.linalg.eigh(moments)[1][:, 0])
        change = 1.0 - abs(new[0] * d[0] + new[1] * d[1] + new[2] * d[2])
        d = new
        if change < 1e-15:
            break
    return d


@kernel(exact=True)
def _depth_sign(a: FloatArray, b: FloatArray, d: FloatArray, k: int) -> int:
    """Return 1 if match k meets in front of both cameras for the baseline +d, -1 if behind both, else 0."""
    cosine = a[k, 0] * b[k, 0] + a[k, 1] * b[k, 1] + a[k, 2] * b[k, 2]
    along_a = a[k, 0] * d[0] + a[k, 1] * d[1] + a[k, 2] * d[2]
    along_b = b[k, 0] * d[0] + b[k, 1] * d[1] + b[k, 2] * d[2]
    depth_i, depth_j = cosine * along_b - along_a, along_b - cosine * along_a
    return int(depth_i > 0.0 and depth_j > 0.0) - int(depth_i < 0.0 and depth_j < 0.0)


@kernel(exact=True)
def _measure(
    a: FloatArray,
    b: FloatArray,
    normals: FloatArray,
    d: FloatArray,
    pixel_angle: float,
    threshold_px: float,
    measures: FloatArray,
) -> float:
    """Fill the support of a pair in the order of _MEASURES; return the sign with more points in front."""
    count = len(a)
    residuals, parallaxes = np.empty(count), np.empty(count)
    inliers, front, behind, voters = 0, 0, 0, 0
    for k in range(count):
        square = _squared_residual(a, b, normals, d, k)
        if square > threshold_px * threshold_px:
            continue
        length = np.sqrt(normals[k, 0] ** 2 + normals[k, 1] ** 2 + normals[k, 2] ** 2)
        cosine = a[k, 0] * b[k, 0] + a[k, 1] * b[k, 1] + a[k, 2] * b[k, 2]
        residuals[inliers] = np.sqrt(square)
        parallaxes[inliers] = np.arctan2(length * pixel_angle, cosine)
        inliers += 1
        if length > _PARALLAX_VOTE_PX:
            side = _depth_sign(a, b, d, k)
            voters += 1
            front += side == 1
            behind += side == -1
    if inliers > 0:
        measures[4] = np.median(residuals[:inliers])
        measures[5] = np.median(parallaxes[:inliers])
    measures[0], measures[3] = inliers, voters
    measures[1], measures[2] = max(front, behind), min(front, behind)
    return -1.0 if behind > front else 1.0


@kernel(exact=True)
def _inlier_information(
    a: FloatArray,
    b: FloatArray,
    normals: FloatArray,
    d: FloatArray,
    threshold_px: float,
    noise_px: float,
    information: FloatArray,
) -> None:
    """Add every inlier's information about the direction, in rad^-2, at noise of `noise_px`."""
    for k in range(len(a)):
        if _squared_residual(a, b, normals, d, k) > threshold_px * threshold_px:
            continue
        weight = 1.0 / (noise_px * noise_px * _squared_gradient(a, b, d, k))
        for row in range(3):
            for column in range(3):
                information[row, column] += weight * normals[k, row] * normals[k, column]
