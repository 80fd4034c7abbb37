"""The estimator of one direction from the matches of one pair, compiled; the package's header has the math.

Every kernel works on the matches of one pair, a row of ten numbers each: the unit rays a and b in world axes,
their epipolar normal, which is a x b in pixels, and its length, the parallax. Lengths and residuals are in
pixels.
"""

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.geometry import SIGMA_PER_MEDIAN
from sfm_shapefit.base.jit import inner_kernel, kernel

MIN_MATCHES = 5  # matches; two fix a direction, but a robust fit to fewer means nothing
MEASURES = ("inliers", "front", "behind", "voters", "rivals", "loyal", "residual_px", "parallax_rad")
"""What is counted and measured of a pair, in this order."""

_MIN_NOISE_PX = 1e-3  # pixels; exact matches still get a finite information
_WIDTH = 4.0  # kernel width in standard deviations of the noise; 95 % efficient, as simulated
_MIN_WIDTH_PX = 0.5  # pixels; matches are never better
_MAX_WIDTH_PX = 8.0  # pixels; inliers are never worse
_RESCALINGS = 8  # first steps that measure the noise anew; it is kept afterwards, so that the steps converge
_STEPS = 30  # steps, a bound; most pairs converge in fewer
_LONGEST_STEP_RAD = 0.3  # radians; steps are of first order
_LEVERAGE_QUANTILE = 0.9  # quantile of the leverages of inliers with parallax; few are larger
_LEVERAGE = 2.0  # multiples of that quantile; a match beyond would decide the direction alone
_MIN_VOTE_PX = 2.0  # pixels of parallax; a match with less does not vote on the sign
_VOTE_SIGMAS = 6.0  # standard deviations of parallax, likewise; without any, rays exceed it once in 8000


@kernel
def estimate_pairs(
    begin: int,
    end: int,
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
    """Fill the output rows of the pairs begin..end-1, which hold zeros; MIN_MATCHES at least change them.

    Outputs: directions (k, 3); measures (k, 8) in the order of MEASURES; moments (k, 2, 3, 3), the curvature
    of the cost and the variance of its slope, both in rad^-2.
    """
    for p in range(begin, end):
        first, last = offsets[p], offsets[p + 1]
        if last - first < MIN_MATCHES:
            continue
        matches = np.empty((last - first, 10))
        _fill_matches(rays_i[first:last], rays_j[first:last], pixel_angles[p], matches)
        d = directions[p]
        _find_hypothesis(matches, threshold_px, num_hypotheses, d)
        residuals = np.empty(last - first)
        noise_px, cap_px = _refine(matches, threshold_px, d, residuals)
        _fill_moments(matches, d, residuals, noise_px, cap_px, moments[p])
        sign = _measure(matches, d, residuals, threshold_px, noise_px, pixel_angles[p], measures[p])
        _count_rivals(matches, residuals, threshold_px, noise_px, num_hypotheses, measures[p])
        for c in range(3):
            d[c] *= sign


@inner_kernel
def _fill_matches(a: FloatArray, b: FloatArray, pixel_angle: float, matches: FloatArray) -> None:
    """Fill the rows of matches with rays a and b (n, 3)."""
    for k in range(len(a)):
        match = matches[k]
        for c in range(3):
            match[c], match[3 + c] = a[k, c], b[k, c]
        match[6] = (a[k, 1] * b[k, 2] - a[k, 2] * b[k, 1]) / pixel_angle
        match[7] = (a[k, 2] * b[k, 0] - a[k, 0] * b[k, 2]) / pixel_angle
        match[8] = (a[k, 0] * b[k, 1] - a[k, 1] * b[k, 0]) / pixel_angle
        match[9] = np.sqrt(match[6] * match[6] + match[7] * match[7] + match[8] * match[8])


@kernel
def _residual(match: FloatArray, d: FloatArray) -> float:
    """Return the signed Sampson error in px; its divisor has a floor where rays run along the baseline."""
    along_a = match[0] * d[0] + match[1] * d[1] + match[2] * d[2]
    along_b = match[3] * d[0] + match[4] * d[1] + match[5] * d[2]
    square = max(2.0 - along_a * along_a - along_b * along_b, 1e-12)
    return float((match[6] * d[0] + match[7] * d[1] + match[8] * d[2]) / np.sqrt(square))


@inner_kernel
def _squared_residual(match: FloatArray, d: FloatArray) -> float:
    """Return the squared Sampson error in px^2, without a root: most of the time is spent here."""
    along_a = match[0] * d[0] + match[1] * d[1] + match[2] * d[2]
    along_b = match[3] * d[0] + match[4] * d[1] + match[5] * d[2]
    square = max(2.0 - along_a * along_a - along_b * along_b, 1e-12)
    volume = match[6] * d[0] + match[7] * d[1] + match[8] * d[2]
    return float(volume * volume / square)


@inner_kernel
def _find_hypothesis(matches: FloatArray, threshold_px: float, num_hypotheses: int, best: FloatArray) -> None:
    """Fill `best` with the two-match direction of least truncated cost; its draws are fixed."""
    count = np.uint64(len(matches))
    best[0], best[1], best[2] = 1.0, 0.0, 0.0
    best_cost = np.inf
    d = np.empty(3)
    limit = threshold_px * threshold_px
    state = np.uint64(0x9E3779B97F4A7C15)
    for _ in range(num_hypotheses):
        state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
        m = matches[np.int64((state >> np.uint64(33)) % count)]
        state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
        n = matches[np.int64((state >> np.uint64(33)) % count)]
        x = m[7] * n[8] - m[8] * n[7]
        y = m[8] * n[6] - m[6] * n[8]
        z = m[6] * n[7] - m[7] * n[6]
        length = np.sqrt(x * x + y * y + z * z)
        if length <= 1e-12:
            continue
        d[0], d[1], d[2] = x / length, y / length, z / length
        cost = 0.0
        for k in range(len(matches)):
            cost += min(_squared_residual(matches[k], d), limit)
            if cost >= best_cost:
                break
        if cost < best_cost:
            best_cost = cost
            best[0], best[1], best[2] = d[0], d[1], d[2]


@inner_kernel
def _refine(
    matches: FloatArray, threshold_px: float, d: FloatArray, residuals: FloatArray
) -> tuple[float, float]:
    """Move d to the nearest minimum of the robust cost; fill its residuals.

    A step solves the weighted Gauss-Newton equations in the plane orthogonal to d.

    Returns:
        The standard deviation of the residuals, and the parallax up to which a match has full weight, in px.
    """
    noise_px, cap_px = threshold_px, np.inf
    basis, work = np.empty((2, 3)), np.empty(len(matches))
    for k in range(len(matches)):
        residuals[k] = _residual(matches[k], d)
    for step in range(_STEPS):
        if step < _RESCALINGS:
            noise_px, cap_px = _measure_noise(matches, residuals, _width(noise_px), work)
        width = _width(noise_px)
        fill_basis(d, basis)
        h00, h01, h11, g0, g1 = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(len(matches)):
            r = residuals[k]
            x, y, _, leverage = _linearize(matches[k], d, basis, r, cap_px)
            weight = leverage / (1.0 + (r / width) ** 2) ** 2
            h00 += weight * x * x
            h01 += weight * x * y
            h11 += weight * y * y
            g0 += weight * x * r
            g1 += weight * y * r
        determinant = h00 * h11 - h01 * h01
        if not determinant > 1e-14 * (h00 + h11) ** 2:
            break  # exactly degenerate, such as identical rays
        x, y = (h01 * g1 - h11 * g0) / determinant, (h01 * g0 - h00 * g1) / determinant
        length = np.sqrt(x * x + y * y)
        shorter = min(1.0, _LONGEST_STEP_RAD / max(length, 1e-300))
        for c in range(3):
            d[c] += shorter * (x * basis[0, c] + y * basis[1, c])
        norm = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        for c in range(3):
            d[c] /= norm
        for k in range(len(matches)):
            residuals[k] = _residual(matches[k], d)
        if step >= _RESCALINGS and length < 1e-10:
            break
    return noise_px, cap_px


@inner_kernel
def _width(noise_px: float) -> float:
    """Return the width of the kernel in px."""
    return float(min(max(_WIDTH * noise_px, _MIN_WIDTH_PX), _MAX_WIDTH_PX))


@inner_kernel
def _measure_noise(
    matches: FloatArray, residuals: FloatArray, cutoff_px: float, work: FloatArray
) -> tuple[float, float]:
    """Return the noise and the leverage cap in px, from the matches whose residual is below the cutoff.

    A fit of two unknowns leaves residuals that are too small by about (n - 2) / n in the median. The cap is
    taken from matches with parallax: few near points among many far ones are not suspicious.
    """
    count, seen = 0, 0
    for k in range(len(matches)):
        if abs(residuals[k]) < cutoff_px:
            work[count] = abs(residuals[k])
            count += 1
    if count < 3:
        return cutoff_px / _WIDTH, np.inf
    noise_px = max(SIGMA_PER_MEDIAN * median(work, int(count)) * count / (count - 2.0), _MIN_NOISE_PX)
    for k in range(len(matches)):
        if abs(residuals[k]) < cutoff_px and matches[k, 9] > _VOTE_SIGMAS * noise_px:
            work[seen] = matches[k, 9]
            seen += 1
    if seen < MIN_MATCHES:
        return noise_px, np.inf
    return noise_px, _LEVERAGE * _select(work, int(seen), int(_LEVERAGE_QUANTILE * (seen - 1)))


@inner_kernel
def median(values: FloatArray, count: int) -> float:
    """Return the median of the first `count` values, at least one; reorders them."""
    half = count >> 1
    upper = _select(values, count, half)
    if count & 1:
        return upper
    lower = values[0]
    for k in range(1, half):
        lower = max(lower, values[k])
    return float((lower + upper) / 2.0)


@inner_kernel
def _select(values: FloatArray, count: int, rank: int) -> float:
    """Return the value of a rank, from 0, among the first `count`; none before it is larger then (Hoare)."""
    low, high = 0, count - 1
    while low < high:
        pivot = values[(low + high) >> 1]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return float(values[rank])


@inner_kernel
def fill_basis(d: FloatArray, basis: FloatArray) -> None:
    """Fill the rows of `basis` (2, 3) with an orthonormal basis of the plane orthogonal to d."""
    smallest = 0
    for c in range(1, 3):
        if abs(d[c]) < abs(d[smallest]):
            smallest = c
    first, second = basis[0], basis[1]
    for c in range(3):
        first[c] = -d[smallest] * d[c]
    first[smallest] += 1.0
    norm = np.sqrt(first[0] * first[0] + first[1] * first[1] + first[2] * first[2])
    for c in range(3):
        first[c] /= norm
    second[0] = d[1] * first[2] - d[2] * first[1]
    second[1] = d[2] * first[0] - d[0] * first[2]
    second[2] = d[0] * first[1] - d[1] * first[0]


@inner_kernel
def _linearize(
    match: FloatArray, d: FloatArray, basis: FloatArray, residual: float, cap_px: float
) -> tuple[float, float, float, float]:
    """Return what a match says as d moves orthogonally to itself.

    The derivatives of its Sampson error along the two axes of the basis; |a x d|^2 + |b x d|^2, which divides
    the error's square; its weight by its parallax alone, (cap / parallax)^2 beyond the cap.
    """
    along_a = match[0] * d[0] + match[1] * d[1] + match[2] * d[2]
    along_b = match[3] * d[0] + match[4] * d[1] + match[5] * d[2]
    square = max(2.0 - along_a * along_a - along_b * along_b, 1e-12)
    root = np.sqrt(square)
    x, y = basis[0], basis[1]
    turn_x = along_a * (match[0] * x[0] + match[1] * x[1] + match[2] * x[2])
    turn_x += along_b * (match[3] * x[0] + match[4] * x[1] + match[5] * x[2])
    turn_y = along_a * (match[0] * y[0] + match[1] * y[1] + match[2] * y[2])
    turn_y += along_b * (match[3] * y[0] + match[4] * y[1] + match[5] * y[2])
    by_x = (match[6] * x[0] + match[7] * x[1] + match[8] * x[2]) / root + residual * turn_x / square
    by_y = (match[6] * y[0] + match[7] * y[1] + match[8] * y[2]) / root + residual * turn_y / square
    ratio = cap_px / max(match[9], 1e-300)
    return by_x, by_y, square, min(1.0, ratio * ratio)


@inner_kernel
def _fill_moments(
    matches: FloatArray,
    d: FloatArray,
    residuals: FloatArray,
    noise_px: float,
    cap_px: float,
    moments: FloatArray,
) -> None:
    """Fill the expected curvature of the cost (slice 0) and the variance of its slope (slice 1) at d.

    With psi = w r the slope is sum v psi J, so its variance is mean(psi^2) sum v^2 J J^T and its
    curvature mean(psi') sum v J J^T. The noise of the rays alone puts r^2 L / |.|^2 into J J^T,
    L = 2 I - a a^T - b b^T; where parallax is small that would feign information, so it is taken off.
    """
    width = _width(noise_px)
    total, curved, squared, count = 0.0, 0.0, 0.0, 0
    feigned, basis, jacobian = np.empty((3, 3)), np.empty((2, 3)), np.empty(3)
    fill_basis(d, basis)
    flat, steep = moments[0], moments[1]
    feigned[:] = 0.0
    for k in range(len(matches)):
        r, match = residuals[k], matches[k]
        x, y, square, leverage = _linearize(match, d, basis, r, cap_px)
        u = (r / width) ** 2
        w = 1.0 / (1.0 + u) ** 2
        count += u < 1.0
        total += w
        curved += (1.0 - 3.0 * u) / (1.0 + u) ** 3
        squared += (w * r) ** 2
        for axis in range(3):
            jacobian[axis] = x * basis[0, axis] + y * basis[1, axis]
        for row in range(3):
            for column in range(3):
                outer = w * leverage * jacobian[row] * jacobian[column]
                noise = 2.0 if row == column else 0.0
                noise = noise - match[row] * match[column] - match[3 + row] * match[3 + column]
                flat[row, column] += outer
                steep[row, column] += leverage * outer
                feigned[row, column] += leverage * w * r * r * noise / square
    total = max(total, 1e-300)
    few = count / (count - 5.0) if count > 5 else 6.0  # on the variance; see the package's header
    for row in range(3):
        for column in range(3):
            flat[row, column] = (curved / total) * flat[row, column] - feigned[row, column]
            steep[row, column] *= few * squared / total


@inner_kernel
def _count_sides(
    matches: FloatArray, d: FloatArray, threshold_px: float, noise_px: float
) -> tuple[int, int, int]:
    """Return the votes on the sign of d: how many matches that agree with d meet in front of both cameras for
    the baseline +d, how many behind both, and how many have enough parallax to vote.
    """
    front, behind, voters = 0, 0, 0
    vote_px = max(_MIN_VOTE_PX, _VOTE_SIGMAS * noise_px)
    for k in range(len(matches)):
        match = matches[k]
        if match[9] > vote_px and abs(_residual(match, d)) <= threshold_px:
            cosine = match[0] * match[3] + match[1] * match[4] + match[2] * match[5]
            along_a = match[0] * d[0] + match[1] * d[1] + match[2] * d[2]
            along_b = match[3] * d[0] + match[4] * d[1] + match[5] * d[2]
            depth_i, depth_j = cosine * along_b - along_a, along_b - cosine * along_a
            voters += 1
            front += depth_i > 0.0 and depth_j > 0.0
            behind += depth_i < 0.0 and depth_j < 0.0
    return front, behind, voters


@inner_kernel
def _measure(
    matches: FloatArray,
    d: FloatArray,
    residuals: FloatArray,
    threshold_px: float,
    noise_px: float,
    pixel_angle: float,
    measures: FloatArray,
) -> float:
    """Fill what the inliers say, see MEASURES; return the sign of d with more points in front."""
    front, behind, voters = _count_sides(matches, d, threshold_px, noise_px)
    sizes, angles, count = np.empty(len(matches)), np.empty(len(matches)), 0
    for k in range(len(matches)):
        if abs(residuals[k]) <= threshold_px:
            match = matches[k]
            cosine = match[0] * match[3] + match[1] * match[4] + match[2] * match[5]
            sizes[count], angles[count] = abs(residuals[k]), np.arctan2(match[9] * pixel_angle, cosine)
            count += 1
    measures[0], measures[1], measures[2], measures[3] = count, max(front, behind), min(front, behind), voters
    if count > 0:
        measures[6], measures[7] = median(sizes, int(count)), median(angles, int(count))
    return -1.0 if behind > front else 1.0


@inner_kernel
def _count_rivals(
    matches: FloatArray,
    residuals: FloatArray,
    threshold_px: float,
    noise_px: float,
    num_hypotheses: int,
    measures: FloatArray,
) -> None:
    """Fill how many of the others agree on a second direction, in front, and how many inliers do not."""
    measures[5] = measures[0]
    others, count = np.empty((len(matches), 10)), 0
    for k in range(len(matches)):
        if abs(residuals[k]) > 2.0 * max(threshold_px, 2.0 * noise_px):
            for c in range(10):
                others[count, c] = matches[k, c]
            count += 1
    if count < MIN_MATCHES:
        return
    d = np.empty(3)
    _find_hypothesis(others[:count], threshold_px, num_hypotheses, d)
    front, behind, _ = _count_sides(others[:count], d, threshold_px, noise_px)
    loyal = 0
    for k in range(len(matches)):
        loyal += abs(residuals[k]) <= threshold_px and abs(_residual(matches[k], d)) > threshold_px
    measures[4], measures[5] = max(front, behind), loyal
