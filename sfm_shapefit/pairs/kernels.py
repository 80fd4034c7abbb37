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

_LANES = 16  # matches of a block; a multiple of what processors compute at once
_BLOCK = 10 * _LANES  # numbers of a block; those without a match, in the last one, are 0
_MIN_NOISE_PX = 1e-3  # pixels; exact matches still get a finite information
_WIDTH = 4.0  # kernel width in standard deviations of the noise; 95 % efficient, as simulated
_MIN_WIDTH_PX = 0.5  # pixels; matches are never better
_MAX_WIDTH_PX = 8.0  # pixels; inliers are never worse
_SURE = 30.0  # - ln of the probability that no hypothesis is of two inliers; fewer miss some of 20 matches
_LEAST_HYPOTHESES = 20  # hypotheses at least, unless fewer are asked for; two inliers may be close together
_RESCALINGS = 8  # first steps, a bound, that measure the noise anew; it is kept then, so that they converge
_STILL, _CONVERGED = 1e-3, 1e-4
"""Standard deviations of the direction; the noise is kept after a step below the first, which hardly changes
it, and a step below the other is the last."""
_STEPS = 30  # steps, a bound; most pairs converge in fewer
_LEAST_CURVATURE = 0.5  # mean slope of the kernel per mean weight; steps are lengthened for one beyond
_LONGEST_STEP_RAD = 0.3  # radians; steps are of first order
_LEVERAGE_QUANTILE = 0.9  # quantile of the leverages of inliers with parallax; few are larger
_LEVERAGE = 2.0  # multiples of that quantile; a match beyond would decide the direction alone
_NO_CAP_PX = 1e100  # pixels; no parallax is as large, and its square is a number
_MIN_VOTE_PX = 2.0  # pixels of parallax; a match with less does not vote on the sign
_VOTE_SIGMAS = 6.0  # standard deviations of parallax, likewise; without any, rays exceed it once in 8000


@kernel
def estimate_pairs(
    begin: int, end: int, offsets: IntArray, rays_i: FloatArray, rays_j: FloatArray, pixel_angles: FloatArray,
    threshold_px: float, num_hypotheses: int, directions: FloatArray, measures: FloatArray, moments:
    FloatArray,
) -> None:  # fmt: skip
    """Fill the output rows of the pairs begin..end-1, which hold zeros; MIN_MATCHES at least change them.

    Outputs: directions (k, 3); measures (k, 8) in the order of MEASURES; moments (k, 2, 2, 2), the curvature
    of the cost and the variance of its slope, both in rad^-2, along the axes of `fill_basis`.
    """
    for p in range(begin, end):
        first, last = offsets[p], offsets[p + 1]
        number = last - first
        if number < MIN_MATCHES:
            continue
        size = -(-number // _LANES) * _LANES
        matches, residuals, lines = np.zeros(10 * size), np.empty(size), np.empty(2 * size)
        _fill_matches(rays_i[first:last], rays_j[first:last], pixel_angles[p], matches)
        d = directions[p]
        _find_hypothesis(matches, number, threshold_px, num_hypotheses, d)
        noise_px, cap_px = _refine(matches, number, threshold_px, d, residuals, lines)
        _fill_moments(matches, number, d, residuals, lines, noise_px, cap_px, moments[p])
        sign = _measure(matches, number, d, residuals, threshold_px, noise_px, pixel_angles[p], measures[p])
        _count_rivals(matches, number, residuals, lines, threshold_px, noise_px, num_hypotheses, measures[p])
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
def _fill_squares(
    m: FloatArray, x: float, y: float, z: float, length: float, limit: float, squares: FloatArray
) -> None:
    """Fill the squared Sampson errors of a block in px^2, at most `limit`, without a root.

    `length` is the square of that of (x, y, z), which may be any.
    """
    least = 1e-12 * length
    for k in range(_LANES):
        along_a = m[k] * x + m[_LANES + k] * y + m[2 * _LANES + k] * z
        along_b = m[3 * _LANES + k] * x + m[4 * _LANES + k] * y + m[5 * _LANES + k] * z
        square = max(2.0 * length - along_a * along_a - along_b * along_b, least)
        volume = m[6 * _LANES + k] * x + m[7 * _LANES + k] * y + m[8 * _LANES + k] * z
        squares[k] = min(volume * volume / square, limit)


@inner_kernel
def _total(lanes: FloatArray) -> float:
    """Return the sum of _LANES numbers, which are overwritten; halves are added to each other."""
    for k in range(8):
        lanes[k] += lanes[8 + k]
    for k in range(4):
        lanes[k] += lanes[4 + k]
    return float((lanes[0] + lanes[1]) + (lanes[2] + lanes[3]))


@inner_kernel
def _find_hypothesis(
    matches: FloatArray, number: int, threshold_px: float, num_hypotheses: int, best: FloatArray
) -> None:
    """Fill `best` with the two-match direction of least truncated cost; its draws are fixed.

    Few matches are all paired. Otherwise hypotheses are made until one of two inliers with a clear parallax
    is among them: the others are at most as many as limits are in a cost, and matches without one.
    """
    count = np.uint64(number)
    best[0], best[1], best[2] = 1.0, 0.0, 0.0
    best_cost, limit = np.inf, threshold_px * threshold_px
    squares = np.empty(_LANES)
    state, first, second = np.uint64(0x9E3779B97F4A7C15), 0, 0
    is_drawn, wanted, done, distant = number * (number - 1) // 2 > num_hypotheses, num_hypotheses, 0, 0
    for k in range(number):
        distant += matches[_place(k) + 9 * _LANES] < _VOTE_SIGMAS * threshold_px
    while done < wanted:
        done += 1
        if is_drawn:
            state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            first = int(((state >> np.uint64(33)) * count) >> np.uint64(31))
            state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            second = int(((state >> np.uint64(33)) * count) >> np.uint64(31))
        else:
            second += 1
            if second == number:
                first, second = first + 1, first + 2
            if second == number:
                break
        m, n = matches[_place(first) + 6 * _LANES :], matches[_place(second) + 6 * _LANES :]
        x = m[_LANES] * n[2 * _LANES] - m[2 * _LANES] * n[_LANES]
        y = m[2 * _LANES] * n[0] - m[0] * n[2 * _LANES]
        z = m[0] * n[_LANES] - m[_LANES] * n[0]
        length = x * x + y * y + z * z  # its square, and so x, y, z may stay as long as they are
        if length <= 1e-24:
            continue
        cost = 0.0
        for at in range(0, 10 * number, _BLOCK):
            _fill_squares(matches[at : at + _BLOCK], x, y, z, length, limit, squares)
            cost += _total(squares)
            if cost >= best_cost:
                break
        if cost < best_cost:
            best_cost = cost
            root = np.sqrt(length)
            best[0], best[1], best[2] = x / root, y / root, z / root
            both = max(1.0 - (cost / limit + distant) / number, 0.0) ** 2  # probability of two in a draw
            if both * num_hypotheses > _SURE:
                wanted = max(_LEAST_HYPOTHESES, int(_SURE / both))


@inner_kernel
def _refine(
    matches: FloatArray, number: int, threshold_px: float, d: FloatArray, residuals: FloatArray, lines:
    FloatArray,
) -> tuple[float, float]:  # fmt: skip
    """Move d to the nearest minimum of the robust cost; fill its residuals and what `_linearize` does.

    A step solves the weighted Gauss-Newton equations in the plane orthogonal to d. By the kernel's curvature
    they are too stiff, all alike in the mean, so that steps are lengthened.

    Returns:
        The standard deviation of the residuals, and the parallax up to which a match has full weight, in px.
    """
    noise_px, cap_px, is_still, is_last = threshold_px, _NO_CAP_PX, False, False
    basis, work, sums = np.empty((2, 3)), np.empty(number + 1), np.empty((7, _LANES))
    for step in range(_STEPS + 1):
        fill_basis(d, basis)
        _linearize(matches, d, basis, residuals, lines)
        if is_last or step == _STEPS:
            break
        if step < _RESCALINGS and not is_still:
            noise_px, cap_px = _measure_noise(matches, number, residuals, _width(noise_px), work)
        _add_equations(matches, residuals, lines, 1.0 / _width(noise_px), cap_px, sums)
        h00, h01, h11, g0, g1 = sums[0, 0], sums[1, 0], sums[2, 0], sums[3, 0], sums[4, 0]
        without = len(residuals) - number  # with a weight of 1 each
        curvature = (sums[5, 0] - without) / max(sums[6, 0] - without, 1e-300)
        determinant = h00 * h11 - h01 * h01
        if not determinant > 1e-14 * (h00 + h11) ** 2:
            break  # exactly degenerate, such as identical rays
        x, y = (h01 * g1 - h11 * g0) / determinant, (h01 * g0 - h00 * g1) / determinant
        sigmas = np.sqrt(max(-x * g0 - y * g1, 0.0)) / noise_px
        longer = 1.0 / curvature if curvature > _LEAST_CURVATURE else 1.0
        longer = min(longer, _LONGEST_STEP_RAD / max(np.sqrt(x * x + y * y), 1e-300))
        for c in range(3):
            d[c] += longer * (x * basis[0, c] + y * basis[1, c])
        norm = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        for c in range(3):
            d[c] /= norm
        is_last = (is_still or step >= _RESCALINGS) and sigmas < _CONVERGED
        is_still = is_still or sigmas < _STILL
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
        work[count] = abs(residuals[k])
        count += work[count] < cutoff_px
    if count < 3:
        return cutoff_px / _WIDTH, _NO_CAP_PX
    noise_px = max(SIGMA_PER_MEDIAN * median(work, int(count)) * count / (count - 2.0), _MIN_NOISE_PX)
    for k in range(number):
        work[seen] = matches[_place(k) + 9 * _LANES]
        seen += (abs(residuals[k]) < cutoff_px) & (work[seen] > _VOTE_SIGMAS * noise_px)
    if seen < MIN_MATCHES:
        return noise_px, _NO_CAP_PX
    return noise_px, _LEVERAGE * select_rank(work, int(seen), int(_LEVERAGE_QUANTILE * (seen - 1)))


@inner_kernel
def median(values: FloatArray, count: int) -> float:
    """Return the median of the first `count` values, at least one; reorders them."""
    half = count >> 1
    upper = select_rank(values, count, half)
    if count & 1:
        return upper
    lower = values[0]
    for k in range(1, half):
        lower = max(lower, values[k])
    return float((lower + upper) / 2.0)


@inner_kernel
def select_rank(values: FloatArray, count: int, rank: int) -> float:
    """Return the value of a rank, from 0, among the first `count`; none before it is larger then.

    As Hoare's, but parted without a branch for each number, which processors could not foresee (Lomuto).
    """
    low, high = 0, count
    while high - low > 1:
        middle = (low + high) >> 1
        pivot, values[middle] = values[middle], values[low]
        below = low
        for k in range(low + 1, high):
            value = values[k]
            values[k] = values[below + 1]
            values[below + 1] = value
            below += value < pivot
        values[low], values[below] = values[below], pivot
        if below == low:  # none is less: all that are equal go with it
            for k in range(low + 1, high):
                value = values[k]
                values[k] = values[below + 1]
                values[below + 1] = value
                below += value == pivot
            if rank <= below:
                return float(pivot)
        if rank < below:
            high = below
        elif rank > below:
            low = below + 1
        else:
            break
    return float(values[rank])


@inner_kernel
def fill_basis(d: FloatArray, basis: FloatArray) -> None:
    """Fill the rows of `basis` (2, 3) with an orthonormal basis of the plane orthogonal to a unit vector d.

    They are the columns of `tangent_bases`, for d and -d alike.
    """
    sign = -1.0 if d[0] < 0.0 else 1.0
    mixed = d[1] * d[2] / (1.0 + abs(d[0]))
    basis[0, 0], basis[0, 1], basis[0, 2] = -sign * d[1], 1.0 - d[1] * d[1] / (1.0 + abs(d[0])), -mixed
    basis[1, 0], basis[1, 1], basis[1, 2] = -sign * d[2], -mixed, 1.0 - d[2] * d[2] / (1.0 + abs(d[0]))


@inner_kernel
def _linearize(
    matches: FloatArray, d: FloatArray, basis: FloatArray, residuals: FloatArray, lines: FloatArray
) -> None:
    """Fill the Sampson errors of all matches, and their derivatives as d moves along the axes of the basis.

    `lines` has blocks, too: in each the derivatives of all its matches along the first axis, then the others.
    """
    d0, d1, d2, x0, x1, x2 = d[0], d[1], d[2], basis[0, 0], basis[0, 1], basis[0, 2]
    y0, y1, y2 = basis[1, 0], basis[1, 1], basis[1, 2]
    for at in range(0, len(residuals), _LANES):
        m, r, line = matches[10 * at : 10 * at + _BLOCK], residuals[at : at + _LANES], lines[2 * at :]
        for k in range(_LANES):
            a0, a1, a2 = m[k], m[_LANES + k], m[2 * _LANES + k]
            b0, b1, b2 = m[3 * _LANES + k], m[4 * _LANES + k], m[5 * _LANES + k]
            n0, n1, n2 = m[6 * _LANES + k], m[7 * _LANES + k], m[8 * _LANES + k]
            along_a, along_b = a0 * d0 + a1 * d1 + a2 * d2, b0 * d0 + b1 * d1 + b2 * d2
            per_root = 1.0 / np.sqrt(max(2.0 - along_a * along_a - along_b * along_b, 1e-12))
            residual = (n0 * d0 + n1 * d1 + n2 * d2) * per_root
            turn_x = along_a * (a0 * x0 + a1 * x1 + a2 * x2) + along_b * (b0 * x0 + b1 * x1 + b2 * x2)
            turn_y = along_a * (a0 * y0 + a1 * y1 + a2 * y2) + along_b * (b0 * y0 + b1 * y1 + b2 * y2)
            off = residual * per_root
            r[k] = residual
            line[k] = (n0 * x0 + n1 * x1 + n2 * x2 + off * turn_x) * per_root
            line[_LANES + k] = (n0 * y0 + n1 * y1 + n2 * y2 + off * turn_y) * per_root


@inner_kernel
def _add_equations(
    matches: FloatArray, residuals: FloatArray, lines: FloatArray, per_width: float, cap_px: float, sums:
    FloatArray,
) -> None:  # fmt: skip
    """Fill the sums of the normal equations (7, _LANES): of the matrix, of the right side, of psi' and of w.

    Matches weigh in the equations by their parallax, too: (cap / parallax)^2 beyond the cap.
    """
    most = cap_px * cap_px
    for row in range(7):
        for k in range(_LANES):
            sums[row, k] = 0.0
    for at in range(0, len(residuals), _LANES):
        r, line, parallaxes = residuals[at:], lines[2 * at :], matches[10 * at + 9 * _LANES :]
        for k in range(_LANES):
            u = (r[k] * per_width) ** 2
            near, square = 1.0 + u, max(most, parallaxes[k] * parallaxes[k])
            x, y, w = line[k], line[_LANES + k], 1.0 / (near * near)
            weight = w * (most / square)
            sums[0, k] += weight * x * x
            sums[1, k] += weight * x * y
            sums[2, k] += weight * y * y
            sums[3, k] += weight * x * r[k]
            sums[4, k] += weight * y * r[k]
            sums[5, k] += (1.0 - 3.0 * u) * w / near
            sums[6, k] += w
    for row in range(7):
        sums[row, 0] = _total(sums[row])


@inner_kernel
def _fill_moments(
    matches: FloatArray, number: int, d: FloatArray, residuals: FloatArray, lines: FloatArray, noise_px:
    float, cap_px: float, moments: FloatArray,
) -> None:  # fmt: skip
    """Fill the expected curvature of the cost (slice 0) and the variance of its slope (slice 1) at d.

    With psi = w r the slope is sum v psi J, so its variance is mean(psi^2) sum v^2 J J^T and its
    curvature mean(psi') sum v J J^T. The noise of the rays alone puts r^2 L / |.|^2 into J J^T,
    L = 2 I - a a^T - b b^T; where parallax is small that would feign information, so it is taken off.
    """
    basis, sums = np.empty((2, 3)), np.zeros((13, _LANES))
    fill_basis(d, basis)
    per_width, most = 1.0 / _width(noise_px), cap_px * cap_px
    d0, d1, d2, x0, x1, x2 = d[0], d[1], d[2], basis[0, 0], basis[0, 1], basis[0, 2]
    y0, y1, y2 = basis[1, 0], basis[1, 1], basis[1, 2]
    for at in range(0, len(residuals), _LANES):
        m, r, line = matches[10 * at : 10 * at + _BLOCK], residuals[at:], lines[2 * at :]
        for k in range(_LANES):
            a0, a1, a2 = m[k], m[_LANES + k], m[2 * _LANES + k]
            b0, b1, b2 = m[3 * _LANES + k], m[4 * _LANES + k], m[5 * _LANES + k]
            along_a, along_b = a0 * d0 + a1 * d1 + a2 * d2, b0 * d0 + b1 * d1 + b2 * d2
            ax, ay = a0 * x0 + a1 * x1 + a2 * x2, a0 * y0 + a1 * y1 + a2 * y2
            bx, by = b0 * x0 + b1 * x1 + b2 * x2, b0 * y0 + b1 * y1 + b2 * y2
            square = r[k] * r[k]
            u = square * per_width * per_width
            near, parallax = 1.0 + u, m[9 * _LANES + k]
            x, y, w = line[k], line[_LANES + k], 1.0 / (near * near)
            v = most / max(most, parallax * parallax)
            outer = w * v
            feigned = outer * square / max(2.0 - along_a * along_a - along_b * along_b, 1e-12)
            sums[0, k] += outer * x * x
            sums[1, k] += outer * x * y
            sums[2, k] += outer * y * y
            sums[3, k] += feigned * (2.0 - ax * ax - bx * bx)
            sums[4, k] -= feigned * (ax * ay + bx * by)
            sums[5, k] += feigned * (2.0 - ay * ay - by * by)
            sums[6, k] += v * outer * x * x
            sums[7, k] += v * outer * x * y
            sums[8, k] += v * outer * y * y
            sums[9, k] += w
            sums[10, k] += (1.0 - 3.0 * u) * w / near
            sums[11, k] += w * w * square
            sums[12, k] += 1.0 if u < 1.0 else 0.0
    for row in range(13):
        sums[row, 0] = _total(sums[row])
    without = len(residuals) - number  # with a weight of 1 each
    total, count = max(sums[9, 0] - without, 1e-300), sums[12, 0] - without
    curvature, variance = (sums[10, 0] - without) / total, sums[11, 0] / total
    variance *= count / (count - 5.0) if count > 5 else 6.0  # see the package's header
    for row in range(2):
        for column in range(2):
            at = row + column
            moments[0, row, column] = curvature * sums[at, 0] - sums[3 + at, 0]
            moments[1, row, column] = variance * sums[6 + at, 0]


@inner_kernel
def _count_sides(
    matches: FloatArray, d: FloatArray, residuals: FloatArray, threshold_px: float, noise_px: float
) -> tuple[int, int, int]:
    """Return the votes on the sign of d: how many matches that agree with d meet in front of both cameras for
    the baseline +d, how many behind both, and how many have enough parallax to vote.
    """
    front, behind, voters = 0, 0, 0
    vote_px, d0, d1, d2 = max(_MIN_VOTE_PX, _VOTE_SIGMAS * noise_px), d[0], d[1], d[2]
    for at in range(0, len(residuals), _LANES):
        m, r = matches[10 * at : 10 * at + _BLOCK], residuals[at : at + _LANES]
        for k in range(_LANES):
            a0, a1, a2 = m[k], m[_LANES + k], m[2 * _LANES + k]
            b0, b1, b2 = m[3 * _LANES + k], m[4 * _LANES + k], m[5 * _LANES + k]
            cosine = a0 * b0 + a1 * b1 + a2 * b2
            along_a, along_b = a0 * d0 + a1 * d1 + a2 * d2, b0 * d0 + b1 * d1 + b2 * d2
            depth_i, depth_j = cosine * along_b - along_a, along_b - cosine * along_a
            votes = (m[9 * _LANES + k] > vote_px) & (abs(r[k]) <= threshold_px)
            voters += votes
            front += votes & (depth_i > 0.0) & (depth_j > 0.0)
            behind += votes & (depth_i < 0.0) & (depth_j < 0.0)
    return front, behind, voters


@inner_kernel
def _measure(
    matches: FloatArray, number: int, d: FloatArray, residuals: FloatArray, threshold_px: float, noise_px:
    float, pixel_angle: float, measures: FloatArray,
) -> float:  # fmt: skip
    """Fill what the inliers say, see MEASURES; return the sign of d with more points in front."""
    front, behind, voters = _count_sides(matches, d, residuals, threshold_px, noise_px)
    own, count = np.empty((2, number + 1)), 0
    for k in range(number):
        match, cosine = matches[_place(k) :], 0.0
        for c in range(3):
            cosine += match[c * _LANES] * match[(3 + c) * _LANES]
        sine = match[9 * _LANES] * pixel_angle
        own[0, count], own[1, count] = abs(residuals[k]), sine if cosine >= 0.0 else 2.0 - sine
        count += own[0, count] <= threshold_px
    measures[0], measures[1], measures[2], measures[3] = count, max(front, behind), min(front, behind), voters
    if count > 0:
        for row in range(2):
            measures[6 + row] = median(own[row], int(count))
        sine = min(measures[7], 2.0 - measures[7], 1.0)
        measures[7] = np.arcsin(sine) if measures[7] < 1.0 else np.pi - np.arcsin(sine)
    return -1.0 if behind > front else 1.0


@inner_kernel
def _count_rivals(
    matches: FloatArray, number: int, residuals: FloatArray, lines: FloatArray, threshold_px: float,
    noise_px: float, num_hypotheses: int, measures: FloatArray,
) -> None:  # fmt: skip
    """Fill how many of the others agree on a second direction, in front, and how many inliers do not.

    `lines` is overwritten.
    """
    measures[5] = measures[0]
    off_px, count = 2.0 * max(threshold_px, 2.0 * noise_px), 0
    for k in range(number):
        count += abs(residuals[k]) > off_px
    if count < MIN_MATCHES:
        return
    others, rivals, d = np.zeros(-(-count // _LANES) * _BLOCK), np.empty(len(residuals)), np.empty(3)
    basis, count = np.empty((2, 3)), 0
    for k in range(number):
        if abs(residuals[k]) > off_px:
            other, match = others[_place(count) :], matches[_place(k) :]
            for c in range(10):
                other[c * _LANES] = match[c * _LANES]
            count += 1
    _find_hypothesis(others, int(count), threshold_px, max(num_hypotheses // 4, 1), d)
    fill_basis(d, basis)
    _linearize(matches, d, basis, rivals, lines)
    loyal = 0
    for k in range(number):
        loyal += (abs(residuals[k]) <= threshold_px) & (abs(rivals[k]) > threshold_px)
        if abs(residuals[k]) <= off_px:
            rivals[k] = np.inf
    front, behind, _ = _count_sides(matches, d, rivals, threshold_px, noise_px)
    measures[4], measures[5] = max(front, behind), loyal
