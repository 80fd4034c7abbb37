"""Standard deviations of what an adjustment delivers: noise that keypoints share, rotations, calibration.

A covariance from independent observations is far too small on photographs: keypoints near one another err
together, a lens is never quite what it is taken for, and rotations that are held have errors of their own.
Here the errors themselves are propagated. With weights w of the loss, the points eliminated (Q), and

    K = kappa J^T w Q J + P,        kappa = sum w^2 / sum w,        P the pull of the priors,

an error e of the pixels moves the frames by K^-1 J^T w Q e, and the covariance of their centers is the sum of
the squares of such moves. kappa is how far the mean derivative of a Cauchy loss falls short of its weight.

noise        e are the residuals of one group of points, for each of up to 64 groups of neighbors in space:
             errors that neighbors share add up as they do, those of single points alone as they would. This
             is the covariance of clustered scores (Liang and Zeger, "Longitudinal data analysis using
             generalized linear models", 1986); the residuals' own size and tails are in it.
rotations    e is what errors of given rotations do to the pixels, where these are held by estimate; where
             they are weighted, their errors enter through P.
calibration  e is a smooth field for each image: ten polynomials in the plane for each axis, each of 0.45
             times the median error. Smooth errors of a lens hide for the greatest part behind centers,
             rotations and points: their size cannot be read off the part that is seen. Whether there are any
             can be tested: the visible part of one field for all images of a lens must explain more of the
             residuals than independent noise does. The size is what two sets with truth call for: 0.57 times
             the median error on castle-P30, 0.3 times on lego100.
             What all images of a lens share moves them together, and adds up. Its size is estimated from the
             part that is seen: where an error of the coefficient k of a field shows, the residuals tell it as
             a_k with the variance v_k of the noise, and the variance t of the coefficients that makes these
             likeliest (empirical Bayes) holds for the part that hides, too, if the test finds any at all. On
             photographs t^1/2 is 0.01 to 0.05 px, and up to 0.23 px where others had calibrated the lenses.

The gauge is that of the adjustment: relative to the centers' mean, and to their scale and axes as far as
nothing holds these (`covariance`).
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.covariance import GroundedSystem, ground_system
from sfm_shapefit.adjustment.layout import SLOTS
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.adjustment.projection import (
    SHIFT,
    look,
    observe,
    turn_to_frame,
    turn_to_world,
)
from sfm_shapefit.adjustment.residuals import chunks_of, kernel_inputs
from sfm_shapefit.adjustment.solve import reprojection_errors_px, values_of
from sfm_shapefit.base.arrays import FloatArray, IntArray, quantile
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import METRIC_SIGMA
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.base.losses import CAUCHY, weighed
from sfm_shapefit.laplacian.operators import Workers
from sfm_shapefit.scene.lens import LensErrors

_MOST_GROUPS = 64  # groups of neighboring points; each is one more right side for the factor
_FEWEST_OF_A_GROUP = 8  # points of a group; fewer would share no noise
_DEGREE = 3  # degree of the polynomials of a smooth field; ten coefficients for each axis
_NUM_FIELDS = (_DEGREE + 1) * (_DEGREE + 2) // 2
# Draws of smooth fields and turns; a variance from as many has a standard deviation of (2 / 24)^1/2 = 29 %.
_SAMPLES = 24
# Observations of a chunk for each node: its sums, which are made and added, are large here.
_OBSERVATIONS_OF_A_NODE = 64
# Smooth field of a doubted lens, in median errors; between what two sets with truth call for, see the header.
_CALIBRATION_OF_ERROR = 0.45
_VISIBLE = 0.05  # share of a field's energy left in the residuals; a field of less cannot be read off them
_REDUNDANCY = 0.1  # share of the squared noise left in residuals; what leaves less does not tell it
# Standard scores beyond noise of the visible part, from which calibration is doubted at all, and fully;
# three are rare by chance, four are no chance even of the largest of eight.
_DOUBT, _CERTAIN = 3.0, 4.0
# Lenses that are tested, those of most observations; each takes twenty right sides.
_MOST_LENSES = 8
# Observations of a tested lens; ten for each of the twenty coefficients of its fields.
_FEWEST_OF_A_LENS = 200
# Steps to the fixed point of a likelihood; each costs next to nothing.
_LIKELIHOOD_STEPS = 30


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CenterErrors:
    """What is known of the errors of adjusted centers."""

    covariances: FloatArray
    """Covariances (n, 3, 3) of the frames' centers, squared units of the world; 0 for fixed frames, NaN where
    no point is seen."""
    lens_errors: LensErrors
    """What the covariances take errors of the lenses for."""
    scale_sigma: float | None
    """Relative standard deviation of the scale; None where nothing in the problem sets it. From a tenth on,
    the covariances leave errors of the scale out: they are then those of the shape, in whatever scale."""
    draws: FloatArray
    """(n, 6, s) errors of the frames: centers in units of the world, then turns in rad, axes of the rig. The
    sum over s of products of two frames' draws is their covariance; 0 and NaN as in the covariances."""
    noise_px: float
    """Standard deviation of an observation along an axis, by the residuals."""


def estimate_center_errors(
    problem: AdjustmentProblem, options: AdjustmentOptions, turn_sigma_rad: float | FloatArray = 0.0
) -> CenterErrors:
    """Return the covariances of the centers at the minimum that a problem stands at.

    Args:
        problem: `Adjusted.problem`, with its priors.
        options: as it was adjusted with.
        turn_sigma_rad: standard deviation per axis of the errors of rotations that are held; one for all, or
            one for each frame.

    Raises:
        UnsolvableError: if the observations leave more open than a similarity, or no camera sees its points.
    """
    errors = reprojection_errors_px(problem)
    errors = errors[np.isfinite(errors)]
    if not len(errors):
        raise UnsolvableError("no camera sees a point that it observes, so that nothing tells errors")
    scale = np.inf if options.loss_scale_px is None else options.loss_scale_px
    weights = weighed(CAUCHY, 1.0, (errors / scale) ** 2)
    kappa = float(np.sum(weights**2) / np.sum(weights))
    redundancy = 1.0 - (3.0 * problem.num_points + 6.0 * problem.num_frames) / (2.0 * len(errors))
    noise2 = float(np.sum(weights**2 * errors**2) / (2.0 * np.sum(weights))) / max(redundancy, _REDUNDANCY)
    # The system is that of K / kappa.
    system = ground_system(problem, replace(options, noise_px=options.noise_px / np.sqrt(kappa)))
    pulls = _Pulls(problem, options, system)
    freely = replace(problem, rotation_prior=None), replace(options, hold_rotations=False)
    evidence, lens_errors_px = _Pulls(*freely, ground_system(*freely)).detect_lens_errors(noise2)
    calibration_px = _CALIBRATION_OF_ERROR * float(np.median(errors) * np.sqrt(_doubt(evidence)))
    turn_sigmas = np.broadcast_to(np.asarray(turn_sigma_rad, dtype=np.float64), (problem.num_frames,))
    by_group, by_sample = pulls.draw(calibration_px, lens_errors_px, turn_sigmas)
    _add_errors_of_priors(by_sample, problem, options, system, kappa)
    groups = max(by_group.shape[2], 2)
    pulled = by_group / kappa * np.sqrt(groups / (groups - 1.0)), by_sample / np.sqrt(_SAMPLES)
    draws, scale_sigma = system.solve(np.concatenate(pulled, axis=2)), None
    moves = draws[:, :3]
    if not (system.free[6].any() or problem.fixed.any()):
        scale_sigma, same_scale = _split_scale(problem, system, moves)
        moves = same_scale if scale_sigma > METRIC_SIGMA else moves
    return CenterErrors(
        covariances=system.by_frame(moves @ moves.transpose(0, 2, 1)),
        lens_errors=LensErrors(
            score=evidence, own_px=calibration_px, shared_px=float(lens_errors_px.max(initial=0.0))
        ),
        scale_sigma=scale_sigma,
        draws=system.by_frame(np.concatenate([moves, draws[:, 3:]], axis=1)),
        noise_px=float(np.sqrt(noise2)) / kappa,
    )


def _split_scale(
    problem: AdjustmentProblem, system: GroundedSystem, moves: FloatArray
) -> tuple[float, FloatArray]:
    """Return the standard deviation of the scale, and moves of the nodes (N, 3, s) without its errors."""
    moving = (system.layout.node_of_frame >= 0) & ~system.unseen
    nodes = system.layout.node_of_frame[moving]
    arms = np.zeros(moves.shape[:2])
    arms[nodes] = problem.centers[moving] - problem.centers[moving].mean(axis=0)
    scales = np.einsum("na,nas->s", arms, moves) / max(float(np.sum(arms**2)), 1e-300)
    return float(np.linalg.norm(scales)), moves - arms[:, :, None] * scales


def _add_errors_of_priors(
    by_sample: FloatArray,
    problem: AdjustmentProblem,
    options: AdjustmentOptions,
    system: GroundedSystem,
    kappa: float,
) -> None:
    """Add the pulls of priors that are in error as they say they are, in units of K / kappa."""
    rng = np.random.default_rng(1)
    layout = system.layout
    for frames, information, slots in problem.priors_of_poses():
        if slots.start == 3 and options.hold_rotations:
            continue
        nodes = layout.node_of_frame[frames]
        moves = nodes >= 0
        values, axes = np.linalg.eigh(information)
        # The symmetric root: axes of equal values are any, by rounding, and draws along others are others.
        roots = (axes * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ axes.transpose(0, 2, 1)
        draws = rng.standard_normal((len(frames), 3, by_sample.shape[2]))
        by_sample[nodes[moves], slots] += options.noise_px**2 / kappa * (roots @ draws)[moves]


class _Pulls:
    """What errors of the pixels of one problem do to the right side of its reduced system."""

    def __init__(
        self, problem: AdjustmentProblem, options: AdjustmentOptions, system: GroundedSystem
    ) -> None:
        self.problem, self.system = problem, system
        self.given = kernel_inputs(system.layout, values_of(problem), options.loss_scale_px)
        self.windows = _windows(problem)
        self.groups = group_neighbors(problem.points)
        self.workers = Workers(options.threads)

    def draw(
        self, calibration_px: float, lens_errors_px: FloatArray, turn_sigmas_rad: FloatArray
    ) -> tuple[FloatArray, ...]:
        """Return the pulls of each group's residuals (N, 6, g), and of samples of smooth errors (N, 6, s)."""
        rng = np.random.default_rng(0)
        problem, fields_of_one = self.problem, (2, _NUM_FIELDS, _SAMPLES)
        fields = calibration_px * rng.standard_normal((problem.num_cameras, *fields_of_one))
        turns = turn_sigmas_rad[:, None, None] * rng.standard_normal((problem.num_frames, 3, _SAMPLES))
        shared = rng.standard_normal((len(problem.lenses), *fields_of_one))
        fields += (lens_errors_px[:, None, None, None] * shared)[problem.lens_of_camera]
        return self.pull(fields, turns)[:2]

    def pull(self, fields: FloatArray, turns: FloatArray, square: int = 0) -> tuple[FloatArray, ...]:
        """Return what residuals of groups, and fields (c, 2, t, s) and turns (n, 3, s), pull at the nodes.

        By each group (N, 6, g), by each field (N, 6, s), and, if wanted, squares: the products of fields and
        residuals among one another as the points leave them.
        """
        layout, num_groups = self.system.layout, int(self.groups.max(initial=0)) + 1
        by_node = [(layout.num_nodes, SLOTS, count) for count in (num_groups, fields.shape[3])]

        def job(begin: int, end: int) -> tuple[FloatArray, ...]:
            groups, columns = (np.zeros(shape) for shape in by_node)
            squares = np.zeros((square, square))
            _pull(
                begin, end, self.given, layout.frame_of_camera, layout.node_of_frame,
                self.system.inverses, self.groups, self.windows, fields, turns,
                groups, columns, squares, 6 if layout.turns else 3,
            )  # fmt: skip
            return groups, columns, squares

        chunks = chunks_of(layout, _OBSERVATIONS_OF_A_NODE)
        return self.workers.total([partial(job, *chunk) for chunk in chunks])

    def detect_lens_errors(self, noise2: float) -> tuple[float, FloatArray]:
        """Return the score of fields of the lenses beyond noise of `noise2` px^2, and the size of each (l,).

        Lenses that few observations see, and those beyond the most used ones, get the mean of the others.
        """
        problem = self.problem
        counts = np.bincount(problem.lens_of_camera[problem.cameras_seeing], minlength=len(problem.lenses))
        most = np.argsort(-counts, kind="stable")[:_MOST_LENSES]
        tested = most[counts[most] >= _FEWEST_OF_A_LENS]
        found = [self._detect(lens, noise2) for lens in tested.tolist()]
        variances = np.full(len(problem.lenses), np.mean([one.variance for one in found] or [0.0]))
        variances[tested] = [one.variance for one in found]
        return max((one.evidence for one in found), default=0.0), np.sqrt(variances)

    def _detect(self, lens: int, noise2: float) -> "_SharedErrors":
        """Return what the visible part of the fields of a lens says of them."""
        own = self.problem.lens_of_camera == lens
        count = 2 * _NUM_FIELDS
        unit = np.eye(count).reshape(2, _NUM_FIELDS, count)
        fields = np.where(own[:, None, None, None], unit, 0.0)
        turns = np.zeros((self.problem.num_frames, 3, count))
        by_group, pulls, squares = self.pull(fields, turns, count + 1)
        # What the residuals still want of the frames is not the lens's.
        pulls = np.concatenate([pulls, by_group.sum(axis=2, keepdims=True)], axis=2)
        explained = np.einsum("nak,naj->kj", pulls[:, :, :count], self.system.solve(pulls, gauge=False))
        left = squares[:count] - explained
        visible, wanted = left[:, :count], left[:, count]
        shares, modes = np.linalg.eigh(0.5 * (visible + visible.T))
        seen = shares > _VISIBLE * np.trace(squares[:count, :count]) / count
        if not seen.any() or noise2 <= 0.0:
            return _SharedErrors(0.0, 0.0)
        amplitudes, variances = (modes.T @ wanted)[seen] / shares[seen], noise2 / shares[seen]
        evidence = score_of_squares(float(np.sum(amplitudes**2 / variances)), int(seen.sum()))
        return _SharedErrors(evidence, _doubt(evidence) * likeliest_variance(amplitudes, variances))


class _SharedErrors(NamedTuple):
    """What the residuals say of smooth errors that all images of a lens share."""

    evidence: float
    """Standard score of what the fields explain beyond noise."""
    variance: float
    """Variance of each coefficient of the fields, px^2."""


def _doubt(evidence: float) -> float:
    """Return how far lenses are to be doubted, in [0, 1]."""
    return float(np.interp(evidence, [_DOUBT, _CERTAIN], [0.0, 1.0]))


def score_of_squares(total: float, count: int) -> float:
    """Return the standard score that is as rare as a sum of `count` squares of standard normal numbers.

    By the cube root, which is nearly normal (Wilson and Hilferty, "The distribution of chi-square", 1931). A
    sum of twenty is three standard deviations too large five times as often as a normal number.
    """
    variance = 2.0 / (9.0 * count)
    return float((np.cbrt(total / count) - (1.0 - variance)) / np.sqrt(variance))


def likeliest_variance(values: FloatArray, variances: FloatArray) -> float:
    """Return the variance t of normal numbers that were measured as `values` (k,) with known variances (k,).

    By the fixed point of the likelihood, t = sum w^2 (x^2 - v) / sum w^2 with w = 1 / (t + v) (Efron and
    Morris, "Data analysis using Stein's estimator and its generalizations", 1975); 0 if noise explains all.
    """
    excess = values**2 - variances
    found = max(float(excess.mean()), 0.0)
    for _ in range(_LIKELIHOOD_STEPS):
        weights = 1.0 / (found + variances) ** 2
        found = max(float(weights @ excess / weights.sum()), 0.0)
    return found


def _windows(problem: AdjustmentProblem) -> FloatArray:
    """Return the middle and the half size of the pixels that the lens of each camera uses, (c, 4)."""
    lenses = problem.lens_of_camera[problem.cameras_seeing]
    low, high = np.full((2, len(problem.lenses)), np.inf), np.full((2, len(problem.lenses)), -np.inf)
    for axis, values in enumerate(problem.pixels.T):  # NumPy is five times as fast by columns
        np.minimum.at(low[axis], lenses, values)
        np.maximum.at(high[axis], lenses, values)
    low, high = low.T, high.T
    low, high = np.where(low < high, low, -1.0), np.where(low < high, high, 1.0)
    windows = np.concatenate([0.5 * (low + high), 0.5 * (high - low)], axis=1)
    return np.ascontiguousarray(windows[problem.lens_of_camera])


def group_neighbors(points: FloatArray) -> IntArray:
    """Return the group of each point (k,): halved along the longest axis until there are enough groups."""
    groups = np.zeros(len(points), np.int64)
    count = 1
    while 2 * count <= _MOST_GROUPS and len(points) >= 2 * count * _FEWEST_OF_A_GROUP:
        for group in range(count):
            own = np.flatnonzero(groups == group)
            low, high = quantile(points[own], 0.1), quantile(points[own], 0.9)
            order = np.argsort(points[own, int(np.argmax(high - low))], kind="stable")
            groups[own[order[len(order) // 2 :]]] = group + count
        count *= 2
    return groups


@kernel
def _pull(
    begin: int, end: int, given: Any, frame_of_camera: Any, node_of_frame: Any,
    inverses: Any, groups: Any, windows: Any, fields: Any, turns: Any,
    by_group: Any, by_field: Any, squares: Any, slots: int,
) -> None:  # fmt: skip
    """Add what fields, turns and residuals of the points begin..end-1 pull at the nodes, these following.

    Column s of `fields` and `turns` goes to column s of `by_field`, the residuals of a point to the column of
    its group in `by_group`; residuals are the last row and column of `squares`.
    """
    first, cameras, pixels, views, points, scale = given
    count = fields.shape[3]
    has_squares = len(squares) > 0
    longest = 0
    for p in range(begin, end):
        longest = max(longest, first[p + 1] - first[p])
    residual = np.empty(2)
    by_points, by_frames = np.empty((longest, 2, 3)), np.zeros((longest, 2, 6))
    errors, weights = np.empty((longest, 2, count + 1)), np.empty(longest)
    basis, p_x, p_y = np.empty(_NUM_FIELDS), np.ones(_DEGREE + 1), np.ones(_DEGREE + 1)
    sums, along, left = np.empty((3, count + 1)), np.empty(3), np.empty((2, count + 1))
    for p in range(begin, end):
        sums[:] = 0.0
        for k in range(first[p], first[p + 1]):
            at, camera = k - first[p], cameras[k]
            frame = frame_of_camera[camera]
            weights[at] = 0.0
            bx, by, bz = look(views, camera, points, p)
            x = bx + views[camera, SHIFT]
            y = by + views[camera, SHIFT + 1]
            z = bz + views[camera, SHIFT + 2]
            ray = (x / z, y / z, 1.0 / z)
            ahead, rx, ry, a0, a1, a2, b0, b1, b2 = observe(views, camera, (x, y, z), ray, pixels, k)
            if not ahead:
                continue
            residual[0], residual[1] = rx, ry
            slopes = (a0, a1, a2, b0, b1, b2)
            _differentiate_by_frame(views, camera, (bx, by, bz), slopes, by_points[at], by_frames[at])
            square = residual[0] * residual[0] + residual[1] * residual[1]
            weights[at] = weighed(CAUCHY, 1.0, square / scale)
            x = (pixels[k, 0] - windows[camera, 0]) / windows[camera, 2]
            y = (pixels[k, 1] - windows[camera, 1]) / windows[camera, 3]
            _write_polynomials(x, y, p_x, p_y, basis)
            for axis in range(2):
                errors[at, axis, :] = 0.0
                for a in range(3):
                    for s in range(count):
                        errors[at, axis, s] += by_frames[at, axis, 3 + a] * turns[frame, a, s]
                for t in range(_NUM_FIELDS):
                    for s in range(count):
                        errors[at, axis, s] += basis[t] * fields[camera, axis, t, s]
                errors[at, axis, count] = residual[axis]
            for a in range(3):
                u, v = weights[at] * by_points[at, 0, a], weights[at] * by_points[at, 1, a]
                for s in range(count + 1):
                    sums[a, s] += u * errors[at, 0, s] + v * errors[at, 1, s]
        v00, v01, v02 = inverses[p, 0], inverses[p, 1], inverses[p, 2]
        v11, v12, v22 = inverses[p, 3], inverses[p, 4], inverses[p, 5]
        for s in range(count + 1):
            along[0], along[1], along[2] = sums[0, s], sums[1, s], sums[2, s]
            sums[0, s] = v00 * along[0] + v01 * along[1] + v02 * along[2]
            sums[1, s] = v01 * along[0] + v11 * along[1] + v12 * along[2]
            sums[2, s] = v02 * along[0] + v12 * along[1] + v22 * along[2]
        for k in range(first[p], first[p + 1]):
            at = k - first[p]
            w, node = weights[at], node_of_frame[frame_of_camera[cameras[k]]]
            if w == 0.0:
                continue
            x_left, y_left = left[0], left[1]
            for s in range(count + 1):
                x_left[s], y_left[s] = errors[at, 0, s], errors[at, 1, s]
            for a in range(3):
                for s in range(count + 1):
                    x_left[s] -= by_points[at, 0, a] * sums[a, s]
                    y_left[s] -= by_points[at, 1, a] * sums[a, s]
            if has_squares:
                for q in range(count + 1):
                    for s in range(count + 1):
                        squares[q, s] += w * (errors[at, 0, q] * x_left[s] + errors[at, 1, q] * y_left[s])
            if node < 0:
                continue
            for a in range(slots):
                by_x, by_y = by_frames[at, 0, a], by_frames[at, 1, a]
                for s in range(count):
                    by_field[node, a, s] += w * (by_x * x_left[s] + by_y * y_left[s])
                by_group[node, a, groups[p]] += w * (by_x * x_left[count] + by_y * y_left[count])


@inner_kernel
def _differentiate_by_frame(
    views: Any, camera: int, point: Any, slopes: Any, by_point: Any, by_frame: Any
) -> None:
    """Write the derivatives of a pixel by its point (2, 3) and by center and rotation of its frame (2, 6).

    Args:
        views, camera: of the observation.
        point: less the frame's center, in axes of the camera. slopes: derivatives by it, see `observe`.
        by_point, by_frame: are written.
    """
    b0, b1, b2 = turn_to_frame(views, camera, point[0], point[1], point[2])
    for axis in range(2):
        j0, j1, j2 = slopes[3 * axis], slopes[3 * axis + 1], slopes[3 * axis + 2]
        by_point[axis, 0], by_point[axis, 1], by_point[axis, 2] = turn_to_world(views, camera, j0, j1, j2)
        for a in range(3):
            by_frame[axis, a] = -by_point[axis, a]
        g0, g1, g2 = turn_to_frame(views, camera, j0, j1, j2)
        by_frame[axis, 3], by_frame[axis, 4] = b1 * g2 - b2 * g1, b2 * g0 - b0 * g2
        by_frame[axis, 5] = b0 * g1 - b1 * g0


@inner_kernel
def _write_polynomials(x: float, y: float, p_x: Any, p_y: Any, basis: Any) -> None:
    """Write the products of Legendre polynomials of x and y in [-1, 1], each of mean square 1 there.

    `p_x` and `p_y` are for the polynomials of one coordinate; the first, 1, is there.
    """
    p_x[1], p_y[1] = x, y
    for i in range(1, _DEGREE):
        p_x[i + 1] = ((2 * i + 1) * x * p_x[i] - i * p_x[i - 1]) / (i + 1)
        p_y[i + 1] = ((2 * i + 1) * y * p_y[i] - i * p_y[i - 1]) / (i + 1)
    t = 0
    for i in range(_DEGREE + 1):
        for j in range(_DEGREE + 1 - i):
            basis[t] = p_x[i] * p_y[j] * np.sqrt((2.0 * i + 1.0) * (2.0 * j + 1.0))
            t += 1
