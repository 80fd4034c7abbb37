"""Relative poses of image pairs refined on all their matches, and what the matches say of the rotation.

A match is a pair of unit rays a and b in camera axes. With R = cam_j_from_cam_i and the unit translation t,
x_j = R x_i + t for a scale, the rays a' = R a and b meet if they and t are coplanar. The residual of a match
is its Sampson error in pixels, as of directions,

    e = t . (a' x b),    q = |a' x t|^2 + |b x t|^2,    r = e / sqrt(q) / pixel angle

which is e over the length of its gradient, as a' and b move on the sphere. Where R becomes exp(w) R and t
moves by d orthogonally to itself,

    dr/dw = ( a' x (b x t) + e (a'.t) (a' x t) / q ) / sqrt(q) / pixel angle
    dr/dd = ( a' x b       + e ((a'.t) a' + (b.t) b) / q ) / sqrt(q) / pixel angle

since a' moves by w x a', so that e changes by w . (a' x (b x t)), and q = 2 - (a'.t)^2 - (b.t)^2.
Gauss-Newton steps on these five unknowns, each match weighted by Geman and McClure's (1 + (r / s)^2)^-2, lead
from a rough start to the nearest robust optimum; s falls from 4 px, or from what a start is off by, which
forgives the start, to 1.5 px.

With the normal matrix of the last weights, sum w J J^T, split into translation (t) and rotation (w), the
information of the rotation alone, the translation being unknown, is the Schur complement

    ( H_ww - H_wt H_tt^-1 H_tw ) / variance,    variance = n / (n - 5) (1.4826 median |r|)^2

The median counts all matches, so false ones widen it. n / (n - 5) makes up for five unknowns that follow the
noise. The variance is at least (s / 10)^2, and (1 rad)^-2 is added to the information: a rotation is never
known less, and with a little more for rounding the matrix is positive definite. Without parallax H_tt is
noise, or 0 to rounding, and then is not inverted: a pure rotation is determined by itself.

Simulated, 100 matches of .5 px: the covariance of the estimates is .93 to .99 of the inverse information, and
.5 to .6 of it with a fifth of the matches false. Where the parallax is one to three times the noise, the
translation may be anywhere, and standard deviations are up to three times those that the information says.
"""

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.geometry import SIGMA_PER_MEDIAN
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.pairs.estimate import run_over_pairs
from sfm_shapefit.pairs.kernels import fill_basis, median
from sfm_shapefit.pairs.relative_rotations import RelativeRotations
from sfm_shapefit.scene.matches import RayMatches

_FIRST_WIDTH_PX = 4.0  # pixels, s of the first step at least; a pose from few trials is off by as much
LAST_WIDTH_PX = 1.5
"""s of the last steps. Measured: 1 to 1.5 px are alike, 3 px is a third worse."""
_NARROWING_STEPS = 3  # steps over which the width falls, in equal ratios; one more for each doubling
_STEPS = 9  # steps after these, a bound; most pairs converge in fewer
_LONGEST_STEP_RAD = 0.3  # radians; steps are of first order
_CONVERGED_RAD = 1e-7  # radians; a shorter step is the last
_LANES = 32  # matches that are linearized together; a multiple of what processors compute at once
_UNKNOWNS = 5  # three of the rotation, two of the unit translation; its length is free
_LEAST_PIVOT = 1e-13  # share of the trace; a smaller pivot is rounding, a parallax of 3e-7 focal lengths
_LEAST_INFORMATION = 1.0  # rad^-2; a rotation is never known less
_ROUNDING = 1e-12  # share of H_ww's trace; the rounding of the Schur complement


def refine_two_view_poses(
    matches: RayMatches,
    rotations: FloatArray,
    translations: FloatArray,
    threads: int = 1,
    off_rad: float = 0.0,
) -> RelativeRotations:
    """Return the relative poses that fit all matches best, near a start, whose signs translations keep.

    Each pair is refined on its own: neither batches nor `threads` change a bit of the answer.

    Args:
        matches: those of k pairs, any number each; rays are finite and in camera axes.
        rotations: (k, 3, 3) cam_j_from_cam_i to start from.
        translations: (k, 3) unit vectors to start from, in axes of camera j.
        threads: number of threads to share the pairs among.
        off_rad: radians by which the start makes rays miss one another.

    Source: Sampson's error as in Hartley and Zisserman, "Multiple View Geometry", 11.4.3, for rays.
    """
    k = len(matches.pairs)
    turns = np.array(rotations, dtype=np.float64, order="C").reshape(k, 3, 3)
    shifts = np.array(translations, dtype=np.float64, order="C").reshape(k, 3)
    information, shares = np.zeros((k, 3, 3)), np.zeros(k)
    run_over_pairs(refine_pairs, matches, threads, off_rad, turns, shifts, information, shares)
    return RelativeRotations(
        pairs=matches.pairs,
        rotations=turns,
        information=information,
        num_matches=matches.lengths(),
        weight_shares=shares,
        translations=shifts,
    )


@kernel
def refine_pairs(
    begin: int, end: int, offsets: IntArray, rays_i: FloatArray, rays_j: FloatArray, pixel_angles:
    FloatArray, off_rad: float, rotations: FloatArray, translations: FloatArray, information: FloatArray,
    weight_shares: FloatArray,
) -> None:  # fmt: skip
    """Refine rotations and translations of the pairs begin..end-1; fill information and weight shares."""
    system, basis, step = np.empty((_UNKNOWNS + 1, _UNKNOWNS + 1)), np.empty((2, 3)), np.empty(_UNKNOWNS)
    for p in range(begin, end):
        first, last = offsets[p], offsets[p + 1]
        count = last - first
        rays = np.zeros(-(-count // _LANES) * 6 * _LANES)
        for k in range(count):
            ray = rays[(k // _LANES) * 6 * _LANES + k % _LANES :]
            for c in range(3):
                ray[c * _LANES], ray[(3 + c) * _LANES] = rays_i[first + k, c], rays_j[first + k, c]
        rotation, t = rotations[p], translations[p]
        sizes = np.empty(count)
        first_px = max(_FIRST_WIDTH_PX, off_rad / pixel_angles[p])
        narrowing = _NARROWING_STEPS + int(np.ceil(np.log2(first_px / _FIRST_WIDTH_PX)))
        width_px = first_px
        for k in range(narrowing + _STEPS):
            fill_basis(t, basis)
            _fill_system(rays, pixel_angles[p], rotation, t, basis, width_px, system, sizes)
            length = _solve(system, step)
            _move(step, min(1.0, _LONGEST_STEP_RAD / max(length, 1e-300)), basis, rotation, t)
            if k >= narrowing - 1 and length < _CONVERGED_RAD:
                break
            if k < narrowing - 1:
                width_px *= (LAST_WIDTH_PX / first_px) ** (1.0 / (narrowing - 1))
        fill_basis(t, basis)
        total = _fill_system(rays, pixel_angles[p], rotation, t, basis, width_px, system, sizes)
        weight_shares[p] = total / max(count, 1)
        _fill_information(system, sizes, width_px, information[p])


@inner_kernel
def _fill_system(
    rays: FloatArray, pixel_angle: float, rotation: FloatArray, t: FloatArray, basis: FloatArray, width_px:
    float, system: FloatArray, sizes: FloatArray,
) -> float:  # fmt: skip
    """Fill the lower triangle of sum w (J, r) (J, r)^T (6, 6), and |r| of each match in px; return sum w.

    Unknowns are the translation along the two axes of `basis` and the rotation w, in this order. `rays` has
    blocks of _LANES matches: their first rays, coordinate by coordinate, then their second ones.
    """
    lines, count, total = np.empty((_UNKNOWNS + 2) * _LANES), len(sizes), 0.0
    for row in range(_UNKNOWNS + 1):
        for column in range(_UNKNOWNS + 1):
            system[row, column] = 0.0
    for at in range(0, count, _LANES):
        _linearize(rays[6 * at : 6 * (at + _LANES)], pixel_angle, rotation, t, basis, width_px, lines)
        for k in range(min(_LANES, count - at)):
            line = lines[k:]
            weight = line[(_UNKNOWNS + 1) * _LANES]
            total += weight
            sizes[at + k] = abs(line[_UNKNOWNS * _LANES])
            for row in range(_UNKNOWNS + 1):
                weighted = weight * line[row * _LANES]
                for column in range(row + 1):
                    system[row, column] += weighted * line[column * _LANES]
    return total


@inner_kernel
def _linearize(
    m: FloatArray, pixel_angle: float, rotation: FloatArray, t: FloatArray, basis: FloatArray, width_px:
    float, lines: FloatArray,
) -> None:  # fmt: skip
    """Fill a block's derivatives by the five unknowns, its residuals in px, then its weights, 7 x _LANES.

    q has a floor along the baseline.
    """
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    x0, x1, x2, y0, y1, y2 = basis[0, 0], basis[0, 1], basis[0, 2], basis[1, 0], basis[1, 1], basis[1, 2]
    t0, t1, t2 = t[0], t[1], t[2]
    for k in range(_LANES):
        p0, p1, p2 = m[k], m[_LANES + k], m[2 * _LANES + k]
        b0, b1, b2 = m[3 * _LANES + k], m[4 * _LANES + k], m[5 * _LANES + k]
        a0 = r00 * p0 + r01 * p1 + r02 * p2
        a1 = r10 * p0 + r11 * p1 + r12 * p2
        a2 = r20 * p0 + r21 * p1 + r22 * p2
        n0, n1, n2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
        along_a, along_b = a0 * t0 + a1 * t1 + a2 * t2, b0 * t0 + b1 * t1 + b2 * t2
        q = max(2.0 - along_a * along_a - along_b * along_b, 1e-12)
        scale = 1.0 / (np.sqrt(q) * pixel_angle)
        e = n0 * t0 + n1 * t1 + n2 * t2
        by_a, by_b = e * along_a / q, e * along_b / q
        d0, d1, d2 = n0 + by_a * a0 + by_b * b0, n1 + by_a * a1 + by_b * b1, n2 + by_a * a2 + by_b * b2
        # Both terms of the rotation's are a' x (...).
        m0 = b1 * t2 - b2 * t1 + by_a * t0
        m1 = b2 * t0 - b0 * t2 + by_a * t1
        m2 = b0 * t1 - b1 * t0 + by_a * t2
        ratio = scale * e / width_px
        weight = 1.0 / (1.0 + ratio * ratio)
        lines[k] = scale * (d0 * x0 + d1 * x1 + d2 * x2)
        lines[_LANES + k] = scale * (d0 * y0 + d1 * y1 + d2 * y2)
        lines[2 * _LANES + k] = scale * (a1 * m2 - a2 * m1)
        lines[3 * _LANES + k] = scale * (a2 * m0 - a0 * m2)
        lines[4 * _LANES + k] = scale * (a0 * m1 - a1 * m0)
        lines[5 * _LANES + k] = scale * e
        lines[6 * _LANES + k] = weight * weight


@inner_kernel
def _eliminate(system: FloatArray, count: int) -> None:
    """Eliminate the first `count` unknowns; one that nothing determines gets a pivot and a column of 0."""
    trace = 0.0
    for c in range(_UNKNOWNS):
        trace += system[c, c]
    for c in range(count):
        if not system[c, c] > _LEAST_PIVOT * trace:
            for row in range(c, _UNKNOWNS + 1):
                system[row, c] = 0.0
            continue
        for row in range(c + 1, _UNKNOWNS + 1):
            factor = system[row, c] / system[c, c]
            for column in range(c + 1, row + 1):
                system[row, column] -= factor * system[column, c]


@inner_kernel
def _solve(system: FloatArray, step: FloatArray) -> float:
    """Fill the Gauss-Newton step (5,), 0 along what nothing determines, and return its length."""
    _eliminate(system, _UNKNOWNS)
    square = 0.0
    for c in range(_UNKNOWNS - 1, -1, -1):
        step[c] = 0.0
        if system[c, c] > 0.0:
            right = -system[_UNKNOWNS, c]
            for row in range(c + 1, _UNKNOWNS):
                right -= system[row, c] * step[row]
            step[c] = right / system[c, c]
        square += step[c] * step[c]
    return float(np.sqrt(square))


@inner_kernel
def _move(step: FloatArray, share: float, basis: FloatArray, rotation: FloatArray, t: FloatArray) -> None:
    """Move t and the rotation by a share of a step.

    Cayley's map, I + 2 (W + W^2) / (1 + |v|^2) with W v = v x ., v = w / 2, is exp(w) up to the third order,
    and a rotation for any w.
    """
    for c in range(3):
        t[c] += share * (step[0] * basis[0, c] + step[1] * basis[1, c])
    norm = np.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
    for c in range(3):
        t[c] /= norm
    x, y, z = 0.5 * share * step[2], 0.5 * share * step[3], 0.5 * share * step[4]
    scale = 2.0 / (1.0 + x * x + y * y + z * z)
    for c in range(3):
        r0, r1, r2 = rotation[0, c], rotation[1, c], rotation[2, c]
        u0, u1, u2 = y * r2 - z * r1, z * r0 - x * r2, x * r1 - y * r0
        rotation[0, c] = r0 + scale * (u0 + y * u2 - z * u1)
        rotation[1, c] = r1 + scale * (u1 + z * u0 - x * u2)
        rotation[2, c] = r2 + scale * (u2 + x * u1 - y * u0)


@inner_kernel
def _fill_information(
    system: FloatArray, sizes: FloatArray, width_px: float, information: FloatArray
) -> None:
    """Fill the information (3, 3) of the rotation from the normal matrix and |r| (n,), which is reordered."""
    count, least_px = len(sizes), width_px / 10.0
    noise_px = max(SIGMA_PER_MEDIAN * median(sizes, count), least_px) if count > 0 else least_px
    spare = max(count - _UNKNOWNS, 1)
    precision = spare / ((spare + _UNKNOWNS) * noise_px * noise_px)
    trace = 0.0
    for row in range(2, _UNKNOWNS):
        trace += system[row, row]
    _eliminate(system, 2)
    for row in range(3):
        for column in range(row + 1):
            value = precision * system[2 + row, 2 + column]
            information[row, column] = information[column, row] = value
        information[row, row] += _LEAST_INFORMATION + _ROUNDING * precision * trace
