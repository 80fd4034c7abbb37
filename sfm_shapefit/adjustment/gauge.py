"""What the observations cannot see: a shift, a turn and a scaling of everything, as far as nothing holds it.

A small similarity moves every frame by N_f xi, xi = (shift v, turn w, scaling s) about the centroid o:

    dC_f = v + w x (C_f - o) + s (C_f - o),        rotation vector in camera axes: -R_f w.

Fixed frames forbid what moves them; held rotations forbid turns; sensors off their rig's origin forbid
scaling; priors forbid what they inform about, however weakly. What is left is free. An adjustment chooses it
so that the centers' best similarity to the start has no such part: the gauge stays the start's.
"""

import math
from dataclasses import replace

import numpy as np

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.priors import cross_matrices
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.adjustment.residuals import Values
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.geometry import fit_similarity

_DIMENSION = 7  # motions of a similarity; three shifts, three turns, one scaling
_NONE = 1e-10  # share of the largest singular value; what holds less holds nothing
_MAX_ROUNDS = 100  # Gauss-Newton steps; each solves for seven unknowns
_SERIES_TERMS = 14  # terms of exp(A) for |A| <= 1/4; the first left out is 1e-19
_ROUNDING = 1e-12  # relative rise of a sum of squares; so little is its rounding


def small_similarities(rotations: FloatArray, centers: FloatArray, origin: FloatArray) -> FloatArray:
    """Return N: how shifts, turns and scalings move centers and rotations, (n, 6, 7)."""
    arms = centers - origin
    moves = np.zeros((len(centers), 6, _DIMENSION))
    moves[:, :3, :3] = np.eye(3)
    moves[:, :3, 3:6] = -cross_matrices(arms)
    moves[:, :3, 6] = arms
    moves[:, 3:, 3:6] = -rotations
    return moves


def free_similarities(problem: AdjustmentProblem, options: AdjustmentOptions) -> FloatArray:
    """Return a basis (7, f) of the small similarities about the centroid of the frames that nothing holds."""
    origin = problem.centers.mean(axis=0)
    spread = float(np.linalg.norm(problem.centers - origin, axis=1).max(initial=0.0)) or 1.0
    scale = np.repeat([1.0, 1.0 / spread, 1.0 / spread], [3, 3, 1])
    moves = small_similarities(problem.rotations, problem.centers, origin) * scale
    moves[:, 3:] *= spread
    may_turn, may_scale = not options.hold_rotations, not np.any(problem.rig.translations)
    basis = np.eye(_DIMENSION)[:, np.repeat([True, may_turn, may_scale], [3, 3, 1])]
    basis = basis @ _null_space((moves[problem.fixed] @ basis).reshape(-1, basis.shape[1]))
    for frames, given, slots in problem.priors_of_poses():
        size = np.einsum("naa->n", given)
        information = given / np.where(size > 0.0, size, 1.0)[:, None, None]
        felt = moves[frames, slots] @ basis
        basis = basis @ _null_space(np.einsum("nai,nab,nbj->ij", felt, information, felt))
    basis[np.abs(basis) < _NONE] = 0.0
    return scale[:, None] * basis


def _null_space(matrix: FloatArray) -> FloatArray:
    """Return an orthonormal basis of what a matrix maps to nearly nothing; all is kept if it has no row."""
    width = matrix.shape[1]
    if not matrix.any() or width == 0:
        return np.eye(width)
    _, values, rows = np.linalg.svd(matrix.T @ matrix)
    return np.asarray(rows[values <= _NONE * values[0]].T)


@one_blas_thread()  # matrices this small keep other threads waiting for hundreds of times as long
def restore_gauge(problem: AdjustmentProblem, values: Values, free: FloatArray) -> Values:
    """Return the values moved by that similarity of the `free_similarities` that brings centers nearest.

    Nearest to the centers of the problem, which are those of the start.
    """
    if free.shape[1] == _DIMENSION:
        motion = _best_similarity(problem, values)
    else:
        motion = _best_free_similarity(problem, values, free) if free.size else np.eye(4)
    return _apply(problem, values, motion, turned=bool(free[3:6].any()))


def _best_similarity(problem: AdjustmentProblem, values: Values) -> FloatArray:
    """Return the similarity, 4 x 4, that maps the centers best to the start's; the identity if mirrored."""
    fit, motion = fit_similarity(values.centers, problem.centers), np.eye(4)
    if fit.scale > 0.0:
        motion[:3, :3], motion[:3, 3] = fit.scale * fit.rotation, fit.translation
    return motion


def _best_free_similarity(problem: AdjustmentProblem, values: Values, free: FloatArray) -> FloatArray:
    """Return the best one of those that are free, by Gauss-Newton steps."""
    origin = problem.centers.mean(axis=0)
    motion, apart = np.eye(4), _apart(problem, values, np.eye(4))
    for _ in range(_MAX_ROUNDS):
        centers = _moved(values.centers, motion)
        moves = small_similarities(values.rotations, centers, origin)[:, :3] @ free
        lead = (problem.centers - centers).ravel()
        step = free @ np.linalg.lstsq(moves.reshape(-1, free.shape[1]), lead, rcond=_NONE)[0]
        nearer = _similarity(step, origin) @ motion
        # A camera that ran far away asks for a scaling of many times, where the linear step is no guide.
        while step.any() and not _apart(problem, values, nearer) <= (1.0 + _ROUNDING) * apart:
            step *= 0.5
            nearer = _similarity(step, origin) @ motion
        motion, apart = nearer, _apart(problem, values, nearer)
        if np.abs(step[3:]).max() < 1e-15:
            break
    return motion


def _moved(centers: FloatArray, motion: FloatArray) -> FloatArray:
    """Return centers (n, 3) after a similarity, given as a 4 x 4 matrix."""
    return centers @ motion[:3, :3].T + motion[:3, 3]


def _apart(problem: AdjustmentProblem, values: Values, motion: FloatArray) -> float:
    """Return the sum of squared distances of the centers, after a similarity, from the start's."""
    return float(np.sum((problem.centers - _moved(values.centers, motion)) ** 2))


def _similarity(step: FloatArray, origin: FloatArray) -> FloatArray:
    """Return the similarity exp(step) about the origin given, as a 4 x 4 matrix."""
    generator = np.zeros((4, 4))
    generator[:3, :3] = cross_matrices(step[None, 3:6])[0] + step[6] * np.eye(3)
    generator[:3, 3] = step[:3] - generator[:3, :3] @ origin
    return exponential(generator)


def exponential(generator: FloatArray) -> FloatArray:
    """Return exp(A) of a small square matrix, by its series for A / 2^k and k squarings."""
    squarings = max(0, math.ceil(math.log2(max(float(np.abs(generator).sum()), 0.25))) + 2)
    scaled = generator / 2.0**squarings
    power = total = np.eye(len(generator))
    for k in range(1, _SERIES_TERMS):
        power = power @ scaled / k
        total = total + power
    return np.asarray(np.linalg.matrix_power(total, 2**squarings))


def _apply(problem: AdjustmentProblem, values: Values, motion: FloatArray, *, turned: bool) -> Values:
    """Return the values after a similarity of the world; fixed frames stay, rotations if not `turned`."""
    size = np.cbrt(np.linalg.det(motion[:3, :3]))
    moves = ~problem.fixed
    centers, rotations = values.centers.copy(), values.rotations
    centers[moves] = _moved(values.centers[moves], motion)
    if turned:
        rotations = rotations.copy()
        rotations[moves] = rotations[moves] @ (motion[:3, :3] / size).T
    return replace(
        values,
        rotations=rotations,
        centers=centers,
        points=_moved(values.points, motion),
        sensor_translations=problem.rig.resized(values.sensor_translations, size),
    )


def restore_baselines(problem: AdjustmentProblem, values: Values) -> Values:
    """Return the values in the scale in which the free sensors' mean distance from their rigs' origins stays.

    The longest alone had kept its length. All of them together are known better than any one.
    """
    before, now = map(problem.rig.mean_baseline, (problem.rig.translations, values.sensor_translations))
    size, fixed = before / now, problem.fixed
    origin = values.centers[fixed if fixed.any() else slice(None)].mean(axis=0)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = size * np.eye(3), (1.0 - size) * origin
    return _apply(problem, values, motion, turned=False)
