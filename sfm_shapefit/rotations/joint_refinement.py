"""Rotations and centers refined together on the matches themselves, without 3D points.

A match of pair (i, j) is two unit rays a, b in world axes, as the given rotations place them. A camera that
turns by the small rotation vector w_i turns its rays, a -> exp([w_i]) a. With the baseline
d = (C_i - C_j) / |C_i - C_j| the residual of the match is its Sampson error in pixels,

    r = e / (sigma s),   e = <a x b, d>,   s^2 = |a x d|^2 + |b x d|^2 = 2 - <a, d>^2 - <b, d>^2,

with sigma the angle of one pixel. Its derivatives, all exact:

    e by w_i:  a x (b x d)        s^2 / 2 by w_i:  -<a, d> (a x d)
    e by w_j:  b x (d x a)        s^2 / 2 by w_j:  -<b, d> (b x d)
    e by d:    a x b              s^2 / 2 by d:    -<a, d> a - <b, d> b

and d moves with C_i - C_j by (I - d d^T) / |C_i - C_j|. One pass over the matches sums, for each pair, the
normal matrix (9, 9) of (w_i, w_j, C_i - C_j). The sum of Cauchy losses plus a soft prior on the w_i is
minimized by Levenberg-Marquardt steps over 6 unknowns per camera. The prior fixes the common rotation; the
damping takes care of shift and scale.

Sources: Sampson error: Hartley and Zisserman, "Multiple View Geometry", 2nd ed., section 11.4.3;
Levenberg-Marquardt with robust weights: Triggs et al., "Bundle Adjustment - A Modern Synthesis", 1999,
section 6; Cauchy weights: Zhang, "Parameter estimation techniques", IVC 1997, table 1.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.directions.matches import RayMatches
from sfm_shapefit.jit import cross, inner_kernel, kernel
from sfm_shapefit.laplacian.dense import one_blas_thread
from sfm_shapefit.laplacian.operators import block_matrix
from sfm_shapefit.solver.damping import DampingRange, take_damped_step

_STEPS = 12
# The damping multiplies the diagonal of the normal matrix.
_DAMPING = DampingRange(least=0.0, most=1e4)
# This share of the largest diagonal entry is added as well, so that gauge directions stay put.
_ABSOLUTE_DAMPING = 1e-12
# The steps end where one lowers the cost by less than this share of it.
_SETTLED = 1e-6
_DENSE_UNKNOWNS = 900
# Of a pair's 9 unknowns, those that move camera i, and those that move camera j.
_OF_I, _OF_J = [0, 1, 2, 6, 7, 8], [3, 4, 5, 6, 7, 8]
# C_j enters C_i - C_j with a minus.
_SIGN_J = np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])


class State(NamedTuple):
    """What is sought: rotations in world axes that turn each camera's rays, and the centers."""

    turns: FloatArray
    """(n, 3, 3)"""
    centers: FloatArray
    """(n, 3)"""

    def move(self, step: FloatArray) -> "State":
        """Return the state after a step (n, 6)."""
        turned = Rotation.from_rotvec(step[:, :3]).as_matrix() @ self.turns
        return State(turned, self.centers + step[:, 3:])


@inner_kernel
def _residual_and_gradient(
    p: FloatArray,
    q: FloatArray,
    d: FloatArray,
    length: float,
    pixel_angle: float,
    jacobian: FloatArray,
    work: FloatArray,
) -> float:
    """Return the Sampson error in px of rays p and q, and fill its derivatives by w_i, w_j, C_i - C_j."""
    along_p = p[0] * d[0] + p[1] * d[1] + p[2] * d[2]
    along_q = q[0] * d[0] + q[1] * d[1] + q[2] * d[2]
    square = max(2.0 - along_p * along_p - along_q * along_q, 1e-12)
    normal, q_d, d_p = work[0], work[1], work[2]
    cross(p, q, normal)
    cross(q, d, q_d)
    cross(d, p, d_p)
    value = normal[0] * d[0] + normal[1] * d[1] + normal[2] * d[2]
    ratio, size = value / square, 1.0 / (pixel_angle * np.sqrt(square))
    cross(p, q_d, jacobian[0:3])
    cross(q, d_p, jacobian[3:6])
    for c in range(3):
        jacobian[c] = size * (jacobian[c] - ratio * along_p * d_p[c])
        jacobian[3 + c] = size * (jacobian[3 + c] + ratio * along_q * q_d[c])
        jacobian[6 + c] = size * (normal[c] + ratio * (along_p * p[c] + along_q * q[c])) / max(length, 1e-300)
    along = jacobian[6] * d[0] + jacobian[7] * d[1] + jacobian[8] * d[2]
    for c in range(3):
        jacobian[6 + c] -= along * d[c]
    return float(value * size)


@kernel
def _add_pairs(
    offsets: IntArray,
    rays_i: FloatArray,
    rays_j: FloatArray,
    turns_i: FloatArray,
    turns_j: FloatArray,
    baselines: FloatArray,
    pixel_angles: FloatArray,
    scale_px: float,
    found: Any,
) -> None:
    """Fill the `NormalEquations` of all pairs, which hold zeros."""
    jacobian, p, q, work = np.empty(9), np.empty(3), np.empty(3), np.empty((3, 3))
    for pair in range(len(baselines)):
        baseline, turn_i, turn_j = baselines[pair], turns_i[pair], turns_j[pair]
        matrix, vector = found.matrices[pair], found.vectors[pair]
        length = np.sqrt(baseline[0] ** 2 + baseline[1] ** 2 + baseline[2] ** 2)
        d = baseline / max(length, 1e-300)
        cost = 0.0
        for k in range(offsets[pair], offsets[pair + 1]):
            a, b = rays_i[k], rays_j[k]
            for c in range(3):
                p[c] = turn_i[c, 0] * a[0] + turn_i[c, 1] * a[1] + turn_i[c, 2] * a[2]
                q[c] = turn_j[c, 0] * b[0] + turn_j[c, 1] * b[1] + turn_j[c, 2] * b[2]
            residual = _residual_and_gradient(p, q, d, length, pixel_angles[pair], jacobian, work)
            loss = 1.0 + (residual / scale_px) ** 2
            cost += 0.5 * scale_px**2 * np.log(loss)
            for row in range(9):
                weighted = jacobian[row] / loss
                vector[row] += weighted * residual
                for column in range(row + 1):
                    matrix[row, column] += weighted * jacobian[column]
        for row in range(9):
            for column in range(row):
                matrix[column, row] = matrix[row, column]
        found.costs[pair] = cost


class NormalEquations(NamedTuple):
    """Normal equations of every pair, at what the pair sees of its two cameras."""

    matrices: FloatArray
    """(k, 9, 9) of (w_i, w_j, C_i - C_j), px^2 per unit squared."""
    vectors: FloatArray
    """(k, 9) gradients of the costs."""
    costs: FloatArray
    """(k,) sums of Cauchy losses in px^2."""


def normal_equations(
    matches: RayMatches, turns: tuple[FloatArray, FloatArray], baselines: FloatArray, scale_px: float
) -> NormalEquations:
    """Sum the matches of each pair in one pass, at one scale of the Cauchy loss.

    Args:
        matches: k pairs.
        turns: for camera i and for camera j of each pair, (k, 3, 3) what turns its rays.
        baselines: (k, 3) C_i - C_j.
        scale_px: of the loss.
    """
    k = len(matches.pairs)
    found = NormalEquations(np.zeros((k, 9, 9)), np.zeros((k, 9)), np.zeros(k))
    turns_i, turns_j, baselines = map(np.ascontiguousarray, (*turns, baselines))
    rays = matches.offsets, matches.rays_i, matches.rays_j
    _add_pairs(*rays, turns_i, turns_j, baselines, matches.pixel_angles, scale_px, found)
    return found


def at_state(matches: RayMatches, state: State, scale_px: float) -> NormalEquations:
    """Return the normal equations of all pairs at one state."""
    i, j = matches.pairs.T
    baselines = state.centers[i] - state.centers[j]
    return normal_equations(matches, (state.turns[i], state.turns[j]), baselines, scale_px)


Blocks = tuple[FloatArray, FloatArray, FloatArray]
"""Diagonal blocks (n, 6, 6), each pair's block of camera i by camera j (k, 6, 6), and the gradient (n, 6)."""


def camera_blocks(normal: NormalEquations, pairs: IntArray, num_cameras: int) -> Blocks:
    """Return the normal equations of (w, C) of all cameras; see `Blocks`."""
    i, j = pairs.T
    diagonal, gradient = np.zeros((num_cameras, 6, 6)), np.zeros((num_cameras, 6))
    np.add.at(diagonal, i, normal.matrices[:, _OF_I][:, :, _OF_I])
    np.add.at(diagonal, j, normal.matrices[:, _OF_J][:, :, _OF_J] * np.outer(_SIGN_J, _SIGN_J))
    np.add.at(gradient, i, normal.vectors[:, _OF_I])
    np.add.at(gradient, j, normal.vectors[:, _OF_J] * _SIGN_J)
    return diagonal, normal.matrices[:, _OF_I][:, :, _OF_J] * _SIGN_J, gradient


class TurnPrior(NamedTuple):
    """A prior of the turns with Cauchy tails, px^2: sum 2 log(1 + |w|^2 / level^2), and who may turn.

    Most cameras turn by about the level, a few by as much as their matches demand.
    """

    level: float
    """Radians."""
    free: BoolArray
    """(n,) the other cameras keep their turns."""

    def cost(self, state: State) -> float:
        """Return the prior's share of the cost."""
        return float(2.0 * np.log1p(np.sum(turn_vectors(state.turns) ** 2, axis=1) / self.level**2).sum())

    def add_to(self, state: State, diagonal: FloatArray, gradient: FloatArray) -> None:
        """Add the prior's normal equations, the curvature as that of reweighted least squares."""
        vectors = turn_vectors(state.turns)
        weights = 4.0 / (self.level**2 + np.sum(vectors**2, axis=1))
        diagonal[:, range(3), range(3)] += weights[:, None]
        gradient[:, :3] += weights[:, None] * vectors


def turn_vectors(turns: FloatArray) -> FloatArray:
    """Return the rotation vectors (n, 3) of turns (n, 3, 3)."""
    return np.asarray(Rotation.from_matrix(turns).as_rotvec())


def minimize(matches: RayMatches, state: State, scale_px: float, prior: TurnPrior) -> State:
    """Return the state after Levenberg-Marquardt steps on all matches at one scale of the Cauchy loss."""

    def evaluate(state: State) -> _Fit:
        normal = at_state(matches, state, scale_px)
        return _Fit(state, normal, float(normal.costs.sum()) + prior.cost(state))

    def propose(damping: float) -> _Fit | None:
        moved = fit.state.move(_step(system, matches.pairs, prior.free, damping))
        candidate = evaluate(moved)
        return candidate if candidate.cost <= fit.cost else None

    fit, damping = evaluate(state), _DAMPING.first
    for _ in range(_STEPS):
        system = camera_blocks(fit.normal, matches.pairs, len(fit.state.centers))
        prior.add_to(fit.state, system[0], system[2])
        better, damping = take_damped_step(propose, damping, _DAMPING)
        before, fit = fit.cost, fit if better is None else better
        if before - fit.cost <= _SETTLED * fit.cost:
            break
    return fit.state


class _Fit(NamedTuple):
    """A state, its normal equations without the prior, and its cost with it."""

    state: State
    normal: NormalEquations
    cost: float


def _step(system: Blocks, pairs: IntArray, free: BoolArray, damping: float) -> FloatArray:
    """Return the damped step (n, 6); cameras that are not free move without turning."""
    diagonal, coupling, gradient = (block.copy() for block in system)
    own = diagonal[:, range(6), range(6)]
    diagonal[:, range(6), range(6)] += damping * own + _ABSOLUTE_DAMPING * own.max(axis=0)
    i, j = pairs.T
    coupling[~free[i], :3] = 0.0
    coupling[~free[j], :, :3] = 0.0
    gradient[~free, :3] = 0.0
    diagonal[~free, :3] = 0.0
    diagonal[~free, :, :3] = 0.0
    diagonal[np.ix_(~free, np.arange(3), np.arange(3))] = np.eye(3)
    return -_solve_blocks(diagonal, coupling, pairs, gradient)


def _solve_blocks(diagonal: FloatArray, coupling: FloatArray, pairs: IntArray, rhs: FloatArray) -> FloatArray:
    """Solve the symmetric positive definite block system; right-hand side and answer (n, 6)."""
    n, matrix = len(diagonal), block_matrix(diagonal, coupling, pairs)
    with one_blas_thread():
        if 6 * n <= _DENSE_UNKNOWNS:
            return np.asarray(cho_solve(cho_factor(matrix.toarray()), rhs.ravel())).reshape(n, 6)
        factor = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A")
        return np.asarray(factor.solve(rhs.ravel())).reshape(n, 6)
