"""The estimator of one direction from the matches of one pair, compiled; the package's header has the math.

Every kernel works on the matches of one pair, ten numbers each: the unit rays a and b in world axes, their
epipolar normal, which is a x b in pixels, and its length, the parallax. Lengths and residuals are in pixels.
Matches stand in blocks of 32, in each the first numbers of all, then their second ones: what is computed of
each match alone is computed of several at once. Sums are in the order of the matches.
"""

from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.geometry import SIGMA_PER_MEDIAN
from sfm_shapefit.base.jit import inner_kernel, kernel

MIN_MATCHES = 5  # matches; two fix a direction, but a robust fit to fewer means nothing
MEASURES = ("inliers", "front", "behind", "voters", "rivals", "loyal", "residual_px", "parallax_rad")
"""What is counted and measured of a pair, in this order."""

_LANES = 32  # matches of a block; a multiple of what processors compute at once
_BLOCK = 10 * _LANES  # numbers of a block; those without a match, in the last one, are 0
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
    begin: int, end: int, offsets: IntArray, rays_i: FloatArray, rays_j: FloatArray, pixel_angles: FloatArray,
    threshold_px: float, num_hypotheses: int, directions: FloatArray, measures: FloatArray, moments:
    FloatArray,
) -> None:  # fmt: skip
    """Fill the output rows of the pairs begin..end-1, which hold zeros; MIN_MATCHES at least change them.

    Outputs: directions (k, 3); measures (k, 8) in the order of MEASURES; moments (k, 2, 3, 3), the curvature
    of the cost and the variance of its slope, both in rad^-2.
    """
    for p in range(begin, end):
        first, last = offsets[p], offsets[p + 1]
        if last - first < MIN_MATCHES:
            continue
        blocks = -(-(last - first) // _LANES)
        matches, residuals = np.zeros(blocks * _BLOCK), np.empty(blocks * _LANES)
        _fill_matches(rays_i[first:last], rays_j[first:last], pixel_angles[p], matches)
        d = directions[p]
        _find_hypothesis(matches, last - first, threshold_px, num_hypotheses, d)
        noise_px, cap_px = _refine(matches, last - first, threshold_px, d, residuals)
        _fill_moments(matches, last - first, d, residuals, noise_px, cap_px, moments[p])
        sign = _measure(
            matches, last - first, d, residuals, threshold_px, noise_px, pixel_angles[p], measures[p]
        )
        _count_rivals(matches, last - first, residuals, threshold_px, noise_px, num_hypotheses, measures[p])
        for c in range(3):
            d[c] *= sign


@inner_kernel
def _place(k: Any) -> Any:
    """Return where the numbers of match k begin, each _LANES after the last."""
    return (k // _LANES) * _BLOCK + k % _LANES


@inner_kernel
def _fill_matches(a: FloatArray, b: FloatArray, pixel_angle: float, matches: FloatArray) -> None:
    """Fill the blocks of matches with rays a and b (n, 3)."""
    for k in range(len(a)):
        match = matches[_place(k) :]
        for c in range(3):
            match[c * _LANES], match[(3 + c) * _LANES] = a[k, c], b[k, c]
        x = (a[k, 1] * b[k, 2] - a[k, 2] * b[k, 1]) / pixel_angle
        y = (a[k, 2] * b[k, 0] - a[k, 0] * b[k, 2]) / pixel_angle
        z = (a[k, 0] * b[k, 1] - a[k, 1] * b[k, 0]) / pixel_angle
        match[6 * _LANES], match[7 * _LANES], match[8 * _LANES] = x, y, z
        match[9 * _LANES] = np.sqrt(x * x + y * y + z * z)


@inner_kernel
def _fill_residuals(matches: FloatArray, d: FloatArray, residuals: FloatArray) -> None:
    """Fill the signed Sampson errors in px; their divisor has a floor where rays run along the baseline."""
    for at in range(len(residuals) // _LANES):
        m, out = matches[at * _BLOCK : (at + 1) * _BLOCK], residuals[at * _LANES : (at + 1) * _LANES]
        x, y, z = d[0], d[1], d[2]
        for k in range(_LANES):
            along_a = m[k] * x + m[_LANES + k] * y + m[2 * _LANES + k] * z
            along_b = m[3 * _LANES + k] * x + m[4 * _LANES + k] * y + m[5 * _LANES + k] * z
            square = max(2.0 - along_a * along_a - along_b * along_b, 1e-12)
            volume = m[6 * _LANES + k] * x + m[7 * _LANES + k] * y + m[8 * _LANES + k] * z
            out[k] = volume / np.sqrt(square)


@inner_kernel
def _fill_squares(m: FloatArray, x: float, y: float, z: float, limit: float, squares: FloatArray) -> None:
    """Fill the squared Sampson errors of a block in px^2, at most `limit`, without a root."""
    for k in range(_LANES):
        along_a = m[k] * x + m[_LANES + k] * y + m[2 * _LANES + k] * z
        along_b = m[3 * _LANES + k] * x + m[4 * _LANES + k] * y + m[5 * _LANES + k] * z
        square = max(2.0 - along_a * along_a - along_b * along_b, 1e-12)
        volume = m[6 * _LANES + k] * x + m[7 * _LANES + k] * y + m[8 * _LANES + k] * z
        squares[k] = min(volume * volume / square, limit)


@inner_kernel
def _find_hypothesis(
    matches: FloatArray, number: int, threshold_px: float, num_hypotheses: int, best: FloatArray
) -> None:
    """Fill `best` with the two-match direction of least truncated cost; its draws are fixed."""
    count = np.uint64(number)
    best[0], best[1], best[2] = 1.0, 0.0, 0.0
    best_cost = np.inf
    squares = np.empty(_LANES)
    limit = threshold_px * threshold_px
    state = np.uint64(0x9E3779B97F4A7C15)
    for _ in range(num_hypotheses):
        state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
        m = matches[_place(np.int64((state >> np.uint64(33)) % count)) + 6 * _LANES :]
        state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
        n = matches[_place(np.int64((state >> np.uint64(33)) % count)) + 6 * _LANES :]
        x = m[_LANES] * n[2 * _LANES] - m[2 * _LANES] * n[_LANES]
        y = m[2 * _LANES] * n[0] - m[0] * n[2 * _LANES]
        z = m[0] * n[_LANES] - m[_LANES] * n[0]
        length = np.sqrt(x * x + y * y + z * z)
        if length <= 1e-12:
            continue
        x, y, z = x / length, y / length, z / length
        cost = 0.0
        for at in range(0, number, _LANES):
            first = (at // _LANES) * _BLOCK
            _fill_squares(matches[first : first + _BLOCK], x, y, z, limit, squares)
            for k in range(min(_LANES, number - at)):
                cost += squares[k]
            if cost >= best_cost:
                break
        if cost < best_cost:
            best_cost = cost
            best[0], best[1], best[2] = x, y, z


@inner_kernel
def _refine(
    matches: FloatArray, number: int, threshold_px: float, d: FloatArray, residuals: FloatArray
) -> tuple[float, float]:
    """Move d to the nearest minimum of the robust cost; fill its residuals.

    A step solves the weighted Gauss-Newton equations in the plane orthogonal to d.

    Returns:
        The standard deviation of the residuals, and the parallax up to which a match has full weight, in px.
    """
    noise_px, cap_px = threshold_px, np.inf
    basis, work, lines = np.empty((2, 3)), np.empty(number), np.empty(4 * _LANES)
    _fill_residuals(matches, d, residuals)
    for step in range(_STEPS):
        if step < _RESCALINGS:
            noise_px, cap_px = _measure_noise(matches, number, residuals, _width(noise_px), work)
        width = _width(noise_px)
        fill_basis(d, basis)
        h00, h01, h11, g0, g1 = 0.0, 0.0, 0.0, 0.0, 0.0
        for at in range(0, number, _LANES):
            first = (at // _LANES) * _BLOCK
            r = residuals[at : at + _LANES]
            _linearize(matches[first : first + _BLOCK], d, basis, r, cap_px, lines)
            for k in range(_LANES):
                lines[3 * _LANES + k] /= (1.0 + (r[k] / width) ** 2) ** 2
            for k in range(min(_LANES, number - at)):
                x, y, weight = lines[k], lines[_LANES + k], lines[3 * _LANES + k]
                h00 += weight * x * x
                h01 += weight * x * y
                h11 += weight * y * y
                g0 += weight * x * r[k]
                g1 += weight * y * r[k]
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
        _fill_residuals(matches, d, residuals)
        if step >= _RESCALINGS and length < 1e-10:
            break
    return noise_px, cap_px


@inner_kernel
def _width(noise_px: float) -> float:
    """Return the width of the kernel in px."""
    return float(min(max(_WIDTH * noise_px, _MIN_WIDTH_PX), _MAX_WIDTH_PX))


@inner_kernel
def _measure_noise(
    matches: FloatArray, number: int, residuals: FloatArray, cutoff_px: float, work: FloatArray
) -> tuple[float, float]:
    """Return the noise and the leverage cap in px, from the matches whose residual is below the cutoff.

    A fit of two unknowns leaves residuals that are too small by about (n - 2) / n in the median. The cap is
    taken from matches with parallax: few near points among many far ones are not suspicious.
    """
    count, seen = 0, 0
    for k in range(number):
        if abs(residuals[k]) < cutoff_px:
            work[count] = abs(residuals[k])
            count += 1
    if count < 3:
        return cutoff_px / _WIDTH, np.inf
    noise_px = max(SIGMA_PER_MEDIAN * median(work, int(count)) * count / (count - 2.0), _MIN_NOISE_PX)
    for k in range(number):
        parallax_px = matches[_place(k) + 9 * _LANES]
        if abs(residuals[k]) < cutoff_px and parallax_px > _VOTE_SIGMAS * noise_px:
            work[seen] = parallax_px
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
    m: FloatArray, d: FloatArray, basis: FloatArray, residuals: FloatArray, cap_px: float, lines: FloatArray
) -> None:
    """Fill what the matches of a block say as d moves orthogonally to itself, 4 times _LANES numbers.

    The derivatives of their Sampson errors along the two axes of the basis; |a x d|^2 + |b x d|^2, which
    divides the error's square; their weights by their parallax alone, (cap / parallax)^2 beyond the cap.
    """
    d0, d1, d2, x0, x1, x2 = d[0], d[1], d[2], basis[0, 0], basis[0, 1], basis[0, 2]
    y0, y1, y2 = basis[1, 0], basis[1, 1], basis[1, 2]
    for k in range(_LANES):
        a0, a1, a2 = m[k], m[_LANES + k], m[2 * _LANES + k]
        b0, b1, b2 = m[3 * _LANES + k], m[4 * _LANES + k], m[5 * _LANES + k]
        n0, n1, n2 = m[6 * _LANES + k], m[7 * _LANES + k], m[8 * _LANES + k]
        along_a, along_b = a0 * d0 + a1 * d1 + a2 * d2, b0 * d0 + b1 * d1 + b2 * d2
        square = max(2.0 - along_a * along_a - along_b * along_b, 1e-12)
        root, residual = np.sqrt(square), residuals[k]
        turn_x = along_a * (a0 * x0 + a1 * x1 + a2 * x2) + along_b * (b0 * x0 + b1 * x1 + b2 * x2)
        turn_y = along_a * (a0 * y0 + a1 * y1 + a2 * y2) + along_b * (b0 * y0 + b1 * y1 + b2 * y2)
        ratio = cap_px / max(m[9 * _LANES + k], 1e-300)
        lines[k] = (n0 * x0 + n1 * x1 + n2 * x2) / root + residual * turn_x / square
        lines[_LANES + k] = (n0 * y0 + n1 * y1 + n2 * y2) / root + residual * turn_y / square
        lines[2 * _LANES + k] = square
        lines[3 * _LANES + k] = min(1.0, ratio * ratio)


@inner_kernel
def _fill_moments(
    matches: FloatArray, number: int, d: FloatArray, residuals: FloatArray, noise_px: float, cap_px: float,
    moments: FloatArray,
) -> None:  # fmt: skip
    """Fill the expected curvature of the cost (slice 0) and the variance of its slope (slice 1) at d.

    With psi = w r the slope is sum v psi J, so its variance is mean(psi^2) sum v^2 J J^T and its
    curvature mean(psi') sum v J J^T. The noise of the rays alone puts r^2 L / |.|^2 into J J^T,
    L = 2 I - a a^T - b b^T; where parallax is small that would feign information, so it is taken off.
    """
    width = _width(noise_px)
    total, curved, squared, count = 0.0, 0.0, 0.0, 0
    feigned, basis, jacobian = np.empty((3, 3)), np.empty((2, 3)), np.empty(3)
    lines = np.empty(4 * _LANES)
    fill_basis(d, basis)
    flat, steep = moments[0], moments[1]
    feigned[:] = 0.0
    for k in range(number):
        r, match, lane = residuals[k], matches[_place(k) :], k % _LANES
        if lane == 0:
            _linearize(match[:_BLOCK], d, basis, residuals[k : k + _LANES], cap_px, lines)
        x, y = lines[lane], lines[_LANES + lane]
        square, leverage = lines[2 * _LANES + lane], lines[3 * _LANES + lane]
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
                noise = noise - match[row * _LANES] * match[column * _LANES]
                noise = noise - match[(3 + row) * _LANES] * match[(3 + column) * _LANES]
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
    matches: FloatArray, number: int, d: FloatArray, residuals: FloatArray, threshold_px: float, noise_px:
    float,
) -> tuple[int, int, int]:  # fmt: skip
    """Return the votes on the sign of d: how many matches that agree with d meet in front of both cameras for
    the baseline +d, how many behind both, and how many have enough parallax to vote.
    """
    front, behind, voters = 0, 0, 0
    vote_px = max(_MIN_VOTE_PX, _VOTE_SIGMAS * noise_px)
    for k in range(number):
        match = matches[_place(k) :]
        if match[9 * _LANES] > vote_px and abs(residuals[k]) <= threshold_px:
            cosine, along_a, along_b = 0.0, 0.0, 0.0
            for c in range(3):
                cosine += match[c * _LANES] * match[(3 + c) * _LANES]
                along_a += match[c * _LANES] * d[c]
                along_b += match[(3 + c) * _LANES] * d[c]
            depth_i, depth_j = cosine * along_b - along_a, along_b - cosine * along_a
            voters += 1
            front += depth_i > 0.0 and depth_j > 0.0
            behind += depth_i < 0.0 and depth_j < 0.0
    return front, behind, voters


@inner_kernel
def _measure(
    matches: FloatArray, number: int, d: FloatArray, residuals: FloatArray, threshold_px: float, noise_px:
    float, pixel_angle: float, measures: FloatArray,
) -> float:  # fmt: skip
    """Fill what the inliers say, see MEASURES; return the sign of d with more points in front."""
    front, behind, voters = _count_sides(matches, number, d, residuals, threshold_px, noise_px)
    sizes, angles, count = np.empty(number), np.empty(number), 0
    for k in range(number):
        if abs(residuals[k]) <= threshold_px:
            match, cosine = matches[_place(k) :], 0.0
            for c in range(3):
                cosine += match[c * _LANES] * match[(3 + c) * _LANES]
            sizes[count] = abs(residuals[k])
            angles[count] = np.arctan2(match[9 * _LANES] * pixel_angle, cosine)
            count += 1
    measures[0], measures[1], measures[2], measures[3] = count, max(front, behind), min(front, behind), voters
    if count > 0:
        measures[6], measures[7] = median(sizes, int(count)), median(angles, int(count))
    return -1.0 if behind > front else 1.0


@inner_kernel
def _count_rivals(
    matches: FloatArray, number: int, residuals: FloatArray, threshold_px: float, noise_px: float,
    num_hypotheses: int, measures: FloatArray,
) -> None:  # fmt: skip
    """Fill how many of the others agree on a second direction, in front, and how many inliers do not."""
    measures[5] = measures[0]
    others, rivals, count = np.zeros(len(matches)), np.empty(len(residuals)), 0
    for k in range(number):
        if abs(residuals[k]) > 2.0 * max(threshold_px, 2.0 * noise_px):
            other, match = others[_place(count) :], matches[_place(k) :]
            for c in range(10):
                other[c * _LANES] = match[c * _LANES]
            count += 1
    if count < MIN_MATCHES:
        return
    d = np.empty(3)
    _find_hypothesis(others, count, threshold_px, num_hypotheses, d)
    _fill_residuals(others, d, rivals)
    front, behind, _ = _count_sides(others, count, d, rivals, threshold_px, noise_px)
    _fill_residuals(matches, d, rivals)
    loyal = 0
    for k in range(number):
        loyal += abs(residuals[k]) <= threshold_px and abs(rivals[k]) > threshold_px
    measures[4], measures[5] = max(front, behind), loyal
