"""The estimator of one direction from the matches of one pair, compiled; the package's header has the math.

Every kernel works on the matches of one pair: (n, 3) unit rays a and b in world axes and their epipolar
normals, the cross products in pixels. Lengths and residuals are in pixels.
"""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.geometry import SIGMA_PER_MEDIAN
from sfm_shapefit.jit import kernel

# Two matches fix a direction; below this number a robust fit means nothing.
MIN_MATCHES = 5
MEASURES = ("inliers", "front", "behind", "voters", "rivals", "loyal", "residual_px", "parallax_rad")
"""What is counted and measured of a pair, in this order."""

# With this least noise, exact matches still get a finite information.
_MIN_NOISE_PX = 1e-3
# Width of the kernel in standard deviations of the noise: 95 % efficient, as simulated.
_WIDTH = 4.0
# The width stays in this range: matches are never better, inliers never worse.
_MIN_WIDTH_PX = 0.5
_MAX_WIDTH_PX = 8.0
# The first steps measure the noise anew; it is kept from then on, so that the steps converge.
_RESCALINGS = 8
_STEPS = 30
_LONGEST_STEP_RAD = 0.3
_LEVERAGE_QUANTILE = 0.9
# A match has full weight up to this many times that quantile of the inliers with parallax.
_LEVERAGE = 2.0
# A match votes on the sign only if its parallax is larger than this, and than so many standard deviations of
# the noise, which rays without any parallax exceed once in 8000.
_MIN_VOTE_PX = 2.0
_VOTE_SIGMAS = 6.0


class _Pair(NamedTuple):
    """The matches of one pair."""

    a: FloatArray
    b: FloatArray
    """(n, 3) unit rays of both images."""
    normals: FloatArray
    """(n, 3) a x b in pixels."""


@kernel(exact=True)
def estimate_pairs(
    rows: IntArray,
    offsets: IntArray,
    rays_i: FloatArray,
    rays_j: FloatArray,
    pixel_angles: FloatArray,
    threshold_px: float,
    num_hypotheses: int,
    directions: FloatArray,
    measures: FloatArray,
    moments: FloatArray,
) -> None:
    """Fill the output rows of the given pairs; rows with fewer than MIN_MATCHES stay zero.

    Outputs: directions (k, 3); measures (k, 8) in the order of MEASURES; moments (k, 2, 3, 3), the curvature
    of the cost and the variance of its slope, both in rad^-2.
    """
    for p in rows:
        first, last = offsets[p], offsets[p + 1]
        if last - first < MIN_MATCHES:
            continue
        a, b = rays_i[first:last], rays_j[first:last]
        pair = _Pair(a, b, _epipolar_normals(a, b, pixel_angles[p]))
        d = _best_hypothesis(pair, np.arange(last - first), threshold_px, num_hypotheses)
        residuals = np.empty(last - first)
        noise_px, cap_px = _refine(pair, threshold_px, d, residuals)
        _fill_moments(pair, d, residuals, noise_px, cap_px, moments[p])
        vote_px = max(_MIN_VOTE_PX, _VOTE_SIGMAS * noise_px)
        inliers = np.flatnonzero(np.abs(residuals) <= threshold_px)
        sign = _count_sides(pair, d, inliers, vote_px, measures[p])
        _measure(pair, residuals, inliers, pixel_angles[p], measures[p])
        others = np.flatnonzero(np.abs(residuals) > 2.0 * max(threshold_px, 2.0 * noise_px))
        _count_rivals(pair, inliers, others, threshold_px, num_hypotheses, vote_px, measures[p])
        directions[p] = sign * d


@kernel(exact=True)
def cross(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Fill `out` with a x b."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@kernel(exact=True)
def _epipolar_normals(a: FloatArray, b: FloatArray, pixel_angle: float) -> FloatArray:
    """Return (a x b) / pixel_angle for every match: its length is the parallax in pixels."""
    normals = np.empty_like(a)
    for k in range(len(a)):
        cross(a[k], b[k], normals[k])
    return normals / pixel_angle


@kernel(exact=True)
def _dot(rows: FloatArray, k: int, d: FloatArray) -> float:
    """Return the inner product of row k with d."""
    return float(rows[k, 0] * d[0] + rows[k, 1] * d[1] + rows[k, 2] * d[2])


@kernel(exact=True)
def _length(rows: FloatArray, k: int) -> float:
    """Return the norm of row k."""
    return float(np.sqrt(rows[k, 0] ** 2 + rows[k, 1] ** 2 + rows[k, 2] ** 2))


@kernel(exact=True)
def _squared_gradient(along_a: float, along_b: float) -> float:
    """Return |a x d|^2 + |b x d|^2 from <a, d> and <b, d>, floored where both rays run along the baseline."""
    return float(max(2.0 - along_a * along_a - along_b * along_b, 1e-12))


@kernel(exact=True)
def _residual(pair: _Pair, d: FloatArray, k: int) -> float:
    """Return the signed Sampson error of match k in px."""
    return float(
        _dot(pair.normals, k, d) / np.sqrt(_squared_gradient(_dot(pair.a, k, d), _dot(pair.b, k, d)))
    )


@kernel(exact=True)
def _best_hypothesis(pair: _Pair, members: IntArray, threshold_px: float, num_hypotheses: int) -> FloatArray:
    """Return the two-match direction of least truncated cost over the members; its draws are fixed."""
    count = np.uint64(len(members))
    best, d = np.zeros(3), np.zeros(3)
    best[0] = 1.0
    best_cost = np.inf
    limit = threshold_px * threshold_px
    state = np.uint64(0x9E3779B97F4A7C15)
    for _ in range(num_hypotheses):
        state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
        m = pair.normals[members[np.int64((state >> np.uint64(33)) % count)]]
        state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
        n = pair.normals[members[np.int64((state >> np.uint64(33)) % count)]]
        cross(m, n, d)
        length = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        if length <= 1e-12:
            continue
        d /= length
        cost = 0.0
        for k in members:
            cost += min(_residual(pair, d, k) ** 2, limit)
            if cost >= best_cost:
                break
        if cost < best_cost:
            best_cost = cost
            best[:] = d
    return best


@kernel(exact=True)
def _refine(pair: _Pair, threshold_px: float, d: FloatArray, residuals: FloatArray) -> tuple[float, float]:
    """Move d to the nearest minimum of the robust cost; fill its residuals.

    Returns:
        The standard deviation of the residuals, and the parallax up to which a match has full weight, in px.
    """
    noise_px, cap_px = threshold_px, np.inf
    basis, normal_matrix = np.empty((2, 3)), np.empty(5)
    _fill_residuals(pair, d, residuals)
    for step in range(_STEPS):
        if step < _RESCALINGS:
            noise_px, cap_px = _noise(pair.normals, residuals, _width(noise_px))
        _fill_basis(d, basis)
        _fill_normal_matrix(pair, d, basis, residuals, noise_px, cap_px, normal_matrix)
        h00, h01, h11, g0, g1 = normal_matrix
        determinant = h00 * h11 - h01 * h01
        if not determinant > 1e-14 * (h00 + h11) ** 2:
            break  # exactly degenerate, such as identical rays
        x, y = (h01 * g1 - h11 * g0) / determinant, (h01 * g0 - h00 * g1) / determinant
        length = np.sqrt(x * x + y * y)
        shorter = min(1.0, _LONGEST_STEP_RAD / max(length, 1e-300))
        d += shorter * (x * basis[0] + y * basis[1])
        d /= np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        _fill_residuals(pair, d, residuals)
        if step >= _RESCALINGS and length < 1e-10:
            break
    return noise_px, cap_px


@kernel(exact=True)
def _width(noise_px: float) -> float:
    """Return the width of the kernel in px."""
    return float(min(max(_WIDTH * noise_px, _MIN_WIDTH_PX), _MAX_WIDTH_PX))


@kernel(exact=True)
def _fill_residuals(pair: _Pair, d: FloatArray, residuals: FloatArray) -> None:
    """Fill the signed Sampson error of every match in px."""
    for k in range(len(pair.normals)):
        residuals[k] = _residual(pair, d, k)


@kernel(exact=True)
def _noise(normals: FloatArray, residuals: FloatArray, cutoff_px: float) -> tuple[float, float]:
    """Return the noise and the leverage cap in px, from the matches whose residual is below the cutoff.

    A fit of two unknowns leaves residuals that are too small by about (n - 2) / n in the median. The cap is
    taken from matches with parallax: few near points among many far ones are not suspicious.
    """
    near = np.flatnonzero(np.abs(residuals) < cutoff_px)
    count = len(near)
    if count < 3:
        return cutoff_px / _WIDTH, np.inf
    noise_px = SIGMA_PER_MEDIAN * np.median(np.abs(residuals[near])) * count / (count - 2.0)
    noise_px = max(noise_px, _MIN_NOISE_PX)
    parallaxes, seen = np.empty(count), 0
    for row in range(count):
        length = _length(normals, near[row])
        if length > _VOTE_SIGMAS * noise_px:
            parallaxes[seen] = length
            seen += 1
    if seen < MIN_MATCHES:
        return noise_px, np.inf
    rank = int(_LEVERAGE_QUANTILE * (seen - 1))
    return noise_px, _LEVERAGE * np.partition(parallaxes[:seen], rank)[rank]


@kernel(exact=True)
def _leverage_weight(pair: _Pair, k: int, cap_px: float) -> float:
    """Return the weight of match k by its parallax alone: (cap / parallax)^2 beyond the cap."""
    ratio = cap_px / max(_length(pair.normals, k), 1e-300)
    return float(min(1.0, ratio * ratio))


@kernel(exact=True)
def _slope(pair: _Pair, d: FloatArray, residual: float, k: int, axis: FloatArray) -> float:
    """Return the derivative of the Sampson error of match k as d moves along an axis orthogonal to it."""
    along_a, along_b = _dot(pair.a, k, d), _dot(pair.b, k, d)
    square = _squared_gradient(along_a, along_b)
    turn = along_a * _dot(pair.a, k, axis) + along_b * _dot(pair.b, k, axis)
    return float(_dot(pair.normals, k, axis) / np.sqrt(square) + residual * turn / square)


@kernel(exact=True)
def _fill_basis(d: FloatArray, basis: FloatArray) -> None:
    """Fill the rows of `basis` (2, 3) with an orthonormal basis of the plane orthogonal to d."""
    smallest = np.argmin(np.abs(d))
    first = -d[smallest] * d
    first[smallest] += 1.0
    basis[0] = first / np.sqrt(np.sum(first * first))
    cross(d, basis[0], basis[1])


@kernel(exact=True)
def _fill_normal_matrix(
    pair: _Pair,
    d: FloatArray,
    basis: FloatArray,
    residuals: FloatArray,
    noise_px: float,
    cap_px: float,
    out: FloatArray,
) -> None:
    """Fill the weighted Gauss-Newton equations in the tangent plane: h00, h01, h11, g0, g1."""
    out[:] = 0.0
    width = _width(noise_px)
    for k in range(len(pair.normals)):
        r = residuals[k]
        weight = _leverage_weight(pair, k, cap_px) / (1.0 + (r / width) ** 2) ** 2
        x = _slope(pair, d, r, k, basis[0])
        y = _slope(pair, d, r, k, basis[1])
        out[0] += weight * x * x
        out[1] += weight * x * y
        out[2] += weight * y * y
        out[3] += weight * x * r
        out[4] += weight * y * r


@kernel(exact=True)
def _fill_moments(
    pair: _Pair, d: FloatArray, residuals: FloatArray, noise_px: float, cap_px: float, moments: FloatArray
) -> None:
    """Fill the expected curvature of the cost (slice 0) and the variance of its slope (slice 1) at d.

    With psi = w r the slope is sum v psi J, so its variance is mean(psi^2) sum v^2 J J^T and its
    curvature mean(psi') sum v J J^T. The noise of the rays alone puts r^2 L / |.|^2 into J J^T,
    L = 2 I - a a^T - b b^T; where parallax is small that would feign information, so it is taken off.
    """
    width = _width(noise_px)
    total, curved, squared, count = 0.0, 0.0, 0.0, 0
    feigned, steep, basis, jacobian = np.zeros((3, 3)), np.zeros((3, 3)), np.empty((2, 3)), np.empty(3)
    _fill_basis(d, basis)
    flat = np.zeros((3, 3))
    for k in range(len(pair.normals)):
        r, leverage = residuals[k], _leverage_weight(pair, k, cap_px)
        u = (r / width) ** 2
        w = 1.0 / (1.0 + u) ** 2
        count += u < 1.0
        total += w
        curved += (1.0 - 3.0 * u) / (1.0 + u) ** 3
        squared += (w * r) ** 2
        square = _squared_gradient(_dot(pair.a, k, d), _dot(pair.b, k, d))
        x = _slope(pair, d, r, k, basis[0])
        y = _slope(pair, d, r, k, basis[1])
        for axis in range(3):
            jacobian[axis] = x * basis[0, axis] + y * basis[1, axis]
        for row in range(3):
            for column in range(3):
                outer = w * leverage * jacobian[row] * jacobian[column]
                noise = (
                    (2.0 if row == column else 0.0)
                    - pair.a[k, row] * pair.a[k, column]
                    - pair.b[k, row] * pair.b[k, column]
                )
                flat[row, column] += outer
                steep[row, column] += leverage * outer
                feigned[row, column] += leverage * w * r * r * noise / square
    total = max(total, 1e-300)
    few = count / (count - 5.0) if count > 5 else 6.0  # of the variance; see the package's header
    moments[0] = (curved / total) * flat - feigned
    moments[1] = (few * squared / total) * steep


@kernel(exact=True)
def _depth_sign(pair: _Pair, d: FloatArray, k: int) -> int:
    """Return 1 if match k meets in front of both cameras for the baseline +d, -1 if behind both, else 0."""
    cosine = _dot(pair.a, k, pair.b[k])
    along_a, along_b = _dot(pair.a, k, d), _dot(pair.b, k, d)
    depth_i, depth_j = cosine * along_b - along_a, along_b - cosine * along_a
    return int(depth_i > 0.0 and depth_j > 0.0) - int(depth_i < 0.0 and depth_j < 0.0)


@kernel(exact=True)
def _count_sides(
    pair: _Pair, d: FloatArray, members: IntArray, vote_px: float, measures: FloatArray
) -> float:
    """Fill front, behind and voters among the members; return the sign with more points in front."""
    front, behind, voters = 0, 0, 0
    for k in members:
        if _length(pair.normals, k) > vote_px:
            side = _depth_sign(pair, d, k)
            voters += 1
            front += side == 1
            behind += side == -1
    measures[1], measures[2], measures[3] = max(front, behind), min(front, behind), voters
    return -1.0 if behind > front else 1.0


@kernel(exact=True)
def _measure(
    pair: _Pair, residuals: FloatArray, inliers: IntArray, pixel_angle: float, measures: FloatArray
) -> None:
    """Fill the number of inliers and their median residual and parallax."""
    measures[0] = len(inliers)
    if len(inliers) == 0:
        return
    angles = np.empty(len(inliers))
    for row in range(len(inliers)):
        k = inliers[row]
        cosine = _dot(pair.a, k, pair.b[k])
        angles[row] = np.arctan2(_length(pair.normals, k) * pixel_angle, cosine)
    measures[6], measures[7] = np.median(np.abs(residuals[inliers])), np.median(angles)


@kernel(exact=True)
def _count_rivals(
    pair: _Pair,
    inliers: IntArray,
    others: IntArray,
    threshold_px: float,
    num_hypotheses: int,
    vote_px: float,
    measures: FloatArray,
) -> None:
    """Fill how many of the others agree on a second direction, in front, and how many inliers do not."""
    measures[5] = len(inliers)
    if len(others) < MIN_MATCHES:
        return
    d = _best_hypothesis(pair, others, threshold_px, num_hypotheses)
    residuals = np.empty(len(pair.normals))
    _fill_residuals(pair, d, residuals)
    sides = np.zeros(4)
    _count_sides(pair, d, others[np.abs(residuals[others]) <= threshold_px], vote_px, sides)
    measures[4], measures[5] = sides[1], np.sum(np.abs(residuals[inliers]) > threshold_px)
