"""Leave one out: pose and focal length of each image anew, from the points as the other images make them.

An image that is fitted together with its points bends them to its own errors, so its reprojection errors say
little. Here the rays of the image are taken out of each of its points,

    Y = X + A^-1 b,    A = sum_o P_o,    b = sum_o P_o (C - X),    P_o = (f / |X - C|)^2 (I - r r^T),

the sums over the other observations o of the point, whose unit ray is r in world axes, and whose image stands
at C with focal length f in pixels: Y is where the others alone have it, and A^-1 its covariance for an error
of a pixel. Rotation, shift and focal length of the image are then fitted to its points at Y by Gauss-Newton
on a robust loss (Cauchy's), with that covariance carried into the pixels. What an image changes beyond its
standard deviations is an error of its own, which the fit of the model could not hide.

A focal length is not observable where the other six unknowns can do what it does: before a flat wall that is
seen from the front, for one. Then the share of its column that they leave, `free_shares`, is tiny, and errors
that keypoints share, as those of distortion are, grow by one over its root.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, frozen
from sfm_shapefit.base.executors import in_ranges, in_threads
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.base.lists import RowLists
from sfm_shapefit.base.losses import CAUCHY, weighed
from sfm_shapefit.judgement.limits import FEWEST_POINTS, FITTING_PX
from sfm_shapefit.pairs.kernels import fill_basis, median
from sfm_shapefit.scene.lens import LARGEST_SIGMA
from sfm_shapefit.scene.points import Points
from sfm_shapefit.scene.structure import Structure

_UNKNOWNS = 7  # rotation, shift, log of the focal length; in this order
_MOST_STEPS = 25  # Gauss-Newton steps; ten are usual, a focal length 1.5 times too large takes 15
_STILL = 1e-2  # standard deviations; a shorter step is the last
_LONGEST_STEP = 0.3  # log of the focal length; its model is linear no farther
_MOST_OBSERVATIONS = 600  # observations of an image, evenly taken; more cost time and say little
_MEDIAN_SQUARE = 1.386  # median of the square of a residual of two axes with unit noise: 2 ln 2
_WIDTH = 2.0  # standard deviations of Cauchy's loss; see Holland and Welsch (1977) for one axis
_LEAST_DETERMINANT = 1e-12  # determinant of A over its trace cubed; below, the others do not hold a point
_LEAST_PIVOT = 1e-13  # pivot of a unit diagonal; rounding leaves as much where nothing determines an unknown
_LEAST_NOISE = 1e-4  # pixels squared; exact points have none, but bend to what is wrong elsewhere
_AT_ONCE = 50_000  # observations through one lens whose rays are made together; their arrays take 6 MB
_LEAST_FREE = 5e-6  # free share; exactly flat scenes have less, wrong lenses in true ones from 1e-5 on


@dataclass(frozen=True, slots=True, eq=False)
class LeftOut:
    """What the points of other images say of each image; NaN where they are too few."""

    num_observations: IntArray
    """(i,) observations that the fit used."""
    log_factors: FloatArray
    """(i,) logarithm of the fitted focal length over the given one."""
    sigmas: FloatArray
    """(i,) standard deviation of it, by the noise of its own fit."""
    free_shares: FloatArray
    """(i,) share of the squared change of the pixels by the focal length that no pose can make."""
    noise_px: FloatArray
    """(i,) standard deviation of an error of a pixel coordinate."""

    @property
    def observable(self) -> BoolArray:
        """Images (i,) whose focal length the points determine; of NaN is none."""
        return np.asarray((self.sigmas <= LARGEST_SIGMA) & (self.free_shares >= _LEAST_FREE))

    def of_little_noise(self, usual: BoolArray) -> "LeftOut":
        """Return the same without the sigmas of other images than `usual` ones (i,) that fit nowhere."""
        noisy = ~usual & ~(self.noise_px <= FITTING_PX)
        return replace(self, sigmas=np.where(noisy, np.nan, self.sigmas))


def leave_one_out(
    structure: Structure, threads: int = 1, believed: BoolArray | None = None, asked: BoolArray | None = None
) -> LeftOut:
    """Return pose and focal length of each image by the points as the others make them.

    Each image is fitted on its own: `threads` change no bit of the answer.

    Args:
        structure: images where they stand, and their points; those without a pose observe nothing.
        threads: number of threads to share the images among.
        believed: (i,) images whose rays make the points of others; all if None.
        asked: (i,) images that are left out; all if None. Nothing is known of the others.
    """
    images, points, n = structure.images, structure.points, structure.images.num_images
    believed = np.ones(n, dtype=np.bool_) if believed is None else believed
    rows: slice | BoolArray = slice(None)
    if asked is not None:
        seen = np.bincount(points.points_seen(), asked[points.images], points.num_points) > 0.0
        rows = seen[points.points_seen()]
        points = points.taken(rows)
    points, rays, on_plane = _look(replace(structure, points=points), structure.pixels[rows], threads)
    of_images = RowLists.by_label(points.images, n)
    given = (
        points.xyz, points.offsets, points.images, points.points_seen(), rays, on_plane, of_images.rows,
        of_images.offsets, images.rotations, images.centers, images.focal_lengths_px, images.are_angular,
        believed,
    )  # fmt: skip
    counts, figures = np.zeros(n, dtype=np.int64), np.full((n, 4), np.nan)
    arrays = *(frozen(np.ascontiguousarray(array)) for array in given), counts, figures

    left_out = np.arange(n) if asked is None else np.flatnonzero(asked)
    in_ranges(threads, len(left_out), fit_images, left_out, *arrays)
    return LeftOut(counts, *figures.T)


def _look(structure: Structure, pixels: FloatArray, threads: int) -> tuple[Points, FloatArray, FloatArray]:
    """Return the points with the observations that have a ray, these (o, 3), and their places.

    Observations are at `pixels` (o, 2). Rays are of length 1 and in camera axes; a place (o, 2) is that in a
    picture of focal length 1.
    """
    points, images = structure.points, structure.images
    rays, places = np.zeros((len(pixels), 3)), np.zeros((len(pixels), 2))

    def look(rows: IntArray) -> None:
        image = int(points.images[rows[0]])
        own = normalized(structure.pictures.rays(image, pixels[rows]))
        with np.errstate(divide="ignore", invalid="ignore"):
            stretch = 1.0 / own[:, 2]
            if images.lenses[images.lens_of[image]].is_angular:
                across = np.hypot(own[:, 0], own[:, 1])
                stretch = np.where(across > 0.0, np.arctan2(across, own[:, 2]) / across, 1.0)
        rays[rows], places[rows] = own, own[:, :2] * stretch[:, None]

    of_lenses = RowLists.by_label(images.lens_of[points.images], len(images.lenses))
    parts = (rows[k : k + _AT_ONCE] for rows in of_lenses for k in range(0, len(rows), _AT_ONCE))
    for _ in in_threads(threads, look, parts):
        pass
    has_ray = np.asarray(np.isfinite(rays).all(axis=1))
    if has_ray.all():
        return points, rays, places
    return points.taken(has_ray), rays[has_ray], places[has_ray]


@kernel
def fit_images(
    begin: int, end: int, rows: Any, xyz: Any, offsets: Any, image_of: Any, point_of: Any, rays: Any,
    on_plane: Any, order: Any, begins: Any, rotations: Any, centers: Any, focal_px: Any, angular: Any,
    believed: Any, counts: Any, figures: Any,
) -> None:  # fmt: skip
    """Fill counts and figures of the images rows[begin:end] by the points as the others make them."""
    held, seen = np.empty((_MOST_OBSERVATIONS, 3)), np.empty((_MOST_OBSERVATIONS, 2))
    spread, lines = np.empty((_MOST_OBSERVATIONS, 6)), np.empty((_MOST_OBSERVATIONS, 2, 8))
    squares, work = np.empty(_MOST_OBSERVATIONS), np.empty(_MOST_OBSERVATIONS)
    system, rotation, total, basis = np.empty((8, 8)), np.empty((3, 3)), np.empty(9), np.empty((2, 3))
    for i in rows[begin:end]:
        size = begins[i + 1] - begins[i]
        taken, count = min(size, _MOST_OBSERVATIONS), 0
        for k in range(taken):
            row = order[begins[i] + k * size // taken]
            x = point_of[row]
            total[:] = 0.0
            for o in range(offsets[x], offsets[x + 1]):
                other = image_of[o]
                if other != i and believed[other]:
                    _add_ray(rays[o], rotations[other], centers[other], focal_px[other], xyz[x], basis, total)
            if _solve_point(total, spread[count], held[count]):
                for c in range(3):
                    held[count, c] += xyz[x, c] - centers[i, c]
                seen[count, 0], seen[count, 1] = on_plane[row, 0], on_plane[row, 1]
                count += 1
        counts[i] = count
        for c in range(3):
            for k in range(3):
                rotation[c, k] = rotations[i, c, k]
        if count >= FEWEST_POINTS:
            _fit_image(
                held, seen, spread, count, rotation, focal_px[i], angular[i], lines, squares, work, system,
                figures[i],
            )  # fmt: skip


@inner_kernel
def _fit_image(
    held: Any, seen: Any, spread: Any, count: int, rotation: Any, focal_px: float, angular: bool, lines: Any,
    squares: Any, work: Any, system: Any, figures: Any,
) -> None:  # fmt: skip
    """Fill the figures of an image by Gauss-Newton from where it stands; they stay NaN if that runs away."""
    log_factor, step, t = 0.0, np.empty(_UNKNOWNS), np.zeros(3)
    for _ in range(_MOST_STEPS):
        scale = _fill_system(
            held, seen, spread, count, rotation, t, log_factor, focal_px, angular, lines, squares, work,
            system,
        )  # fmt: skip
        length = _solve(system, step)
        share = min(1.0, _LONGEST_STEP / max(abs(step[6]), 1e-300))
        _move(step, share, rotation, t)
        log_factor += share * step[6]
        if scale == 0.0:
            return
        if length < _STILL * np.sqrt(scale):
            figures[0], figures[1] = log_factor, np.sqrt(scale / system[6, 6])
            figures[2], figures[3] = system[7, 7], np.sqrt(scale)
            return


@inner_kernel
def _add_ray(
    ray: Any, rotation: Any, center: Any, focal_px: float, point: Any, basis: Any, total: Any
) -> None:
    """Add to `total` (9,) what a ray says of a point's shift: the upper triangle of A, then b."""
    fill_basis(ray, basis)
    d0, d1, d2 = point[0] - center[0], point[1] - center[1], point[2] - center[2]
    weight = focal_px * focal_px / (d0 * d0 + d1 * d1 + d2 * d2)
    for side in range(2):
        u = basis[side]
        v0 = rotation[0, 0] * u[0] + rotation[1, 0] * u[1] + rotation[2, 0] * u[2]
        v1 = rotation[0, 1] * u[0] + rotation[1, 1] * u[1] + rotation[2, 1] * u[2]
        v2 = rotation[0, 2] * u[0] + rotation[1, 2] * u[1] + rotation[2, 2] * u[2]
        off = weight * (v0 * d0 + v1 * d1 + v2 * d2)
        total[0] += weight * v0 * v0
        total[1] += weight * v0 * v1
        total[2] += weight * v0 * v2
        total[3] += weight * v1 * v1
        total[4] += weight * v1 * v2
        total[5] += weight * v2 * v2
        total[6] -= off * v0
        total[7] -= off * v1
        total[8] -= off * v2


@inner_kernel
def _solve_point(total: Any, spread: Any, shift: Any) -> bool:
    """Fill A^-1, its upper triangle (6,), and A^-1 b, (3,); return whether the rays hold the point."""
    h00, h01, h02, h11, h12, h22 = total[0], total[1], total[2], total[3], total[4], total[5]
    c00, c01, c02 = h11 * h22 - h12 * h12, h02 * h12 - h01 * h22, h01 * h12 - h02 * h11
    c11, c12, c22 = h00 * h22 - h02 * h02, h01 * h02 - h00 * h12, h00 * h11 - h01 * h01
    determinant, trace = h00 * c00 + h01 * c01 + h02 * c02, h00 + h11 + h22
    if not determinant > _LEAST_DETERMINANT * trace * trace * trace:
        return False
    spread[0], spread[1], spread[2] = c00 / determinant, c01 / determinant, c02 / determinant
    spread[3], spread[4], spread[5] = c11 / determinant, c12 / determinant, c22 / determinant
    shift[0] = spread[0] * total[6] + spread[1] * total[7] + spread[2] * total[8]
    shift[1] = spread[1] * total[6] + spread[3] * total[7] + spread[4] * total[8]
    shift[2] = spread[2] * total[6] + spread[4] * total[7] + spread[5] * total[8]
    return True


@inner_kernel
def _fill_system(
    held: Any, seen: Any, spread: Any, count: int, rotation: Any, t: Any, log_factor: float, focal_px: float,
    angular: bool, lines: Any, squares: Any, work: Any, system: Any,
) -> float:  # fmt: skip
    """Fill the lower triangle of sum w (J, r)^T S^-1 (J, r), (8, 8); return the variance of the noise.

    S is the unit matrix and the covariance of a point in the pixels. Points behind the image have no part;
    0 if they are half of all or more.
    """
    system[:] = 0.0
    factor, ahead = np.exp(log_factor), 0
    for k in range(count):
        if _linearize(held[k], seen[k], rotation, t, factor, focal_px, angular, lines[ahead]):
            squares[ahead] = work[ahead] = _whiten(spread[k], rotation, lines[ahead])
            ahead += 1
    if 2 * ahead <= count or ahead < FEWEST_POINTS:
        return 0.0
    scale = max(median(work, ahead) / _MEDIAN_SQUARE, _LEAST_NOISE)
    for k in range(ahead):
        weight = weighed(CAUCHY, 1.0, squares[k] / (_WIDTH * _WIDTH * scale))
        for side in range(2):
            line = lines[k, side]
            for row in range(8):
                weighted = weight * line[row]
                for column in range(row + 1):
                    system[row, column] += weighted * line[column]
    return float(scale)


@inner_kernel
def _linearize(
    point: Any, seen: Any, rotation: Any, t: Any, factor: float, focal_px: float, angular: bool, lines: Any
) -> bool:
    """Fill the derivatives of a residual by the seven unknowns, then it, in px; return whether it is ahead.

    In a plane picture a point is at f (x/z, y/z), in an angular one at f (x, y) times angle over hypot(x, y).
    """
    x = rotation[0, 0] * point[0] + rotation[0, 1] * point[1] + rotation[0, 2] * point[2] + t[0]
    y = rotation[1, 0] * point[0] + rotation[1, 1] * point[1] + rotation[1, 2] * point[2] + t[1]
    z = rotation[2, 0] * point[0] + rotation[2, 1] * point[1] + rotation[2, 2] * point[2] + t[2]
    across, square = x * x + y * y, x * x + y * y + z * z
    if angular and across > 1e-12 * square:
        angle = np.arctan2(np.sqrt(across), z)
        stretch, by_z = angle / np.sqrt(across), -1.0 / square
        bend = (z / square - stretch) / across
    elif z > 0.0 and z * z > 1e-6 * square:
        stretch, by_z, bend = 1.0 / z, -1.0 / (z * z), 0.0
    else:
        return False
    scale = factor * focal_px
    for side in range(2):
        own = x if side == 0 else y
        a0, a1, a2 = own * x * bend, own * y * bend, own * by_z
        if side == 0:
            a0 += stretch
        else:
            a1 += stretch
        a0, a1, a2 = scale * a0, scale * a1, scale * a2
        line = lines[side]
        line[0], line[1], line[2] = y * a2 - z * a1, z * a0 - x * a2, x * a1 - y * a0
        line[3], line[4], line[5] = a0, a1, a2
        line[6] = scale * stretch * own
        line[7] = scale * stretch * own - focal_px * seen[side]
    return True


@inner_kernel
def _whiten(spread: Any, rotation: Any, lines: Any) -> float:
    """Divide both lines by the Cholesky factor of S; return the square of the residual."""
    a, b, r = lines[0], lines[1], rotation
    u0 = a[3] * r[0, 0] + a[4] * r[1, 0] + a[5] * r[2, 0]
    u1 = a[3] * r[0, 1] + a[4] * r[1, 1] + a[5] * r[2, 1]
    u2 = a[3] * r[0, 2] + a[4] * r[1, 2] + a[5] * r[2, 2]
    v0 = b[3] * r[0, 0] + b[4] * r[1, 0] + b[5] * r[2, 0]
    v1 = b[3] * r[0, 1] + b[4] * r[1, 1] + b[5] * r[2, 1]
    v2 = b[3] * r[0, 2] + b[4] * r[1, 2] + b[5] * r[2, 2]
    c = spread
    q0, q1 = c[0] * u0 + c[1] * u1 + c[2] * u2, c[1] * u0 + c[3] * u1 + c[4] * u2
    p0, p1 = c[0] * v0 + c[1] * v1 + c[2] * v2, c[1] * v0 + c[3] * v1 + c[4] * v2
    q2, p2 = c[2] * u0 + c[4] * u1 + c[5] * u2, c[2] * v0 + c[4] * v1 + c[5] * v2
    s00, s01 = 1.0 + u0 * q0 + u1 * q1 + u2 * q2, v0 * q0 + v1 * q1 + v2 * q2
    s11 = 1.0 + v0 * p0 + v1 * p1 + v2 * p2
    first = np.sqrt(s00)
    below = s01 / first
    second = np.sqrt(max(s11 - below * below, 1.0))  # 1 or more, but for rounding
    for column in range(8):
        a[column] /= first
        b[column] = (b[column] - below * a[column]) / second
    return float(a[7] * a[7] + b[7] * b[7])


@inner_kernel
def _solve(system: Any, step: Any) -> float:
    """Fill the Gauss-Newton step (7,), 0 along what nothing determines; return its largest scaled entry.

    system[6, 6] becomes the information of the focal length, system[7, 7] the share that no pose can make.
    """
    sizes = np.empty(8)
    for c in range(8):
        sizes[c] = np.sqrt(system[c, c]) if system[c, c] > 0.0 else 1.0
    sizes[7] = 1.0
    for row in range(8):
        for column in range(row + 1):
            system[row, column] /= sizes[row] * sizes[column]
    for c in range(_UNKNOWNS):
        if not system[c, c] > _LEAST_PIVOT:
            system[c, c] = 0.0
            for row in range(c + 1, 8):
                system[row, c] = 0.0
            continue
        for row in range(c + 1, 8):
            factor = system[row, c] / system[c, c]
            for column in range(c + 1, row + 1):
                system[row, column] -= factor * system[column, c]
    largest = 0.0
    for c in range(_UNKNOWNS - 1, -1, -1):
        step[c] = 0.0
        if system[c, c] > 0.0:
            right = -system[7, c]
            for row in range(c + 1, _UNKNOWNS):
                right -= system[row, c] * step[row]
            step[c] = right / system[c, c]
        largest = max(largest, abs(step[c]))
    for c in range(_UNKNOWNS):
        step[c] /= sizes[c]
    system[7, 7] = system[6, 6]
    system[6, 6] *= sizes[6] * sizes[6]
    return largest


@inner_kernel
def _move(step: Any, share: float, rotation: Any, t: Any) -> None:
    """Turn by a share of a step's rotation, and shift by it; Cayley's map, a rotation for any step."""
    x, y, z = 0.5 * share * step[0], 0.5 * share * step[1], 0.5 * share * step[2]
    scale = 2.0 / (1.0 + x * x + y * y + z * z)
    for c in range(4):
        r0, r1, r2 = (t[0], t[1], t[2]) if c == 3 else (rotation[0, c], rotation[1, c], rotation[2, c])
        u0, u1, u2 = y * r2 - z * r1, z * r0 - x * r2, x * r1 - y * r0
        r0 += scale * (u0 + y * u2 - z * u1)
        r1 += scale * (u1 + z * u0 - x * u2)
        r2 += scale * (u2 + x * u1 - y * u0)
        if c == 3:
            t[0], t[1], t[2] = r0 + share * step[3], r1 + share * step[4], r2 + share * step[5]
        else:
            rotation[0, c], rotation[1, c], rotation[2, c] = r0, r1, r2
