"""A proof that averaged rotations are a global optimum: of chordal least squares over the kept pairs.

With weights k_e of the kept pairs the problem is

    minimize  f(R) = sum_e k_e |R_ij - R_j R_i^T|_F^2 = tr(X^T M X),    X = (R_1; ...; R_n), X_i X_i^T = I,

M the (3n, 3n) connection Laplacian. For the symmetric blocks Lambda_i = sym((M X)_i X_i^T) let S = M -
Lambda. Every feasible Y has tr(Y^T Lambda Y) = sum_i tr Lambda_i = f(X) and |Y|_F^2 = 3n, so that

    f(Y) = f(X) + tr(Y^T S Y) >= f(X) + 3n lambda_min(S),

whether X is stationary or not, and for reflections Y too. S + mu I positive definite proves that no rotations
cost less than f(X) - 3n mu. It is asked for mu = 1e-6 f(X) / 3n, or the rounding of a factorization where
that is larger. At a stationary point S X = 0, so mu cannot be 0.

In world axes, with E_e = R_j^T R_ij R_i, S has the blocks sum_e k_e sym(E_e) on the diagonal and -k_e E_e at
(j, i): near the Laplacian of the weights. Where its factor is small, Cholesky decides. On expanders a few
Lanczos steps find the smallest eigenvalue m on the complement of the null vectors N = 1 (x) I / sqrt(n); then
lambda_min(S) >= -|S N|^2 / m, as N^T S N = 0 for any X. That it is the smallest is not proved: only the
answers of Cholesky are proofs to the last.

What it proves: of the pairs that are kept, with their final weights, no other rotations fit better. It does
not say that these pairs are the right ones. The averaged rotations minimize a finer cost, with the full
information, so the check walks from them to the nearby stationary point of f, and says how far that is.

Sources: Eriksson, Olsson, Kahl, Chin, "Rotation averaging and strong duality", CVPR 2018; Rosen, Carlone,
Bandeira, Leonard, "SE-Sync", IJRR 2019; Dellaert et al., "Shonan rotation averaging", ECCV 2020. That a
factorization shows definiteness to rounding: Rump, "Verification of positive definiteness", BIT 2006.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.geometry import angle_between
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.rotations.annealing import LONGEST_STEP
from sfm_shapefit.rotations.averaging_kernels import fill_matrix, relative_in_world, turn_cameras
from sfm_shapefit.rotations.averaging_system import AveragingSystem

_TOLERANCE = 1e-6  # mu relative to f(X) / 3n; see the header
_ROUNDING = 1e-13  # share of the mean diagonal; rounding of a factorization's pivots
_MOST_FLOPS = 3e11  # operations of a factorization; half a minute at 10 Gflop/s, more is not checked
_POLISHING_STEPS = 30  # steps to the stationary point; a bound
_SETTLED = 1e-10  # radians; a shorter step is the last
_REDUCTION = 1e-3  # share of the residual that a polishing step may leave; the next one takes it
_LANCZOS_STEPS = 300  # restarts of Lanczos' method; who has not settled is not certified, which is safe
_SEED = 3  # seed of Lanczos' start; same input, same answer


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DualCertificate:
    """What is shown of the kept pairs."""

    certified: bool
    """Whether no rotations cost less than `lower_bound`, proved or estimated."""
    proved: bool
    """Whether that is proved, by Cholesky. A Lanczos value is an upper bound of the smallest eigenvalue,
    so what rests on it is an estimate."""
    cost: float
    """f at the stationary point next to the averaged rotations."""
    lower_bound: float
    """Bound of the cost of any rotations; minus infinity if not certified."""
    distance_deg: float
    """How far that point is from the averaged rotations, as the largest turn of a camera."""


def certify_rotations(
    system: AveragingSystem, measured: FloatArray, weights: FloatArray, turns: FloatArray
) -> DualCertificate | None:
    """Check the answer of a connected graph of k pairs; None where that would take too long.

    The weights (k,) are the final, positive ones of `measured` (k, 4), cam_j_from_cam_i; `turns` (n, 4) are
    cam_from_world.
    """
    affordable = system.plan is not None and 27.0 * system.plan.flops <= _MOST_FLOPS
    if not (affordable or system.is_expander):
        return None
    n, pairs = system.num_nodes, system.pairs
    weights = weights / weights.mean()
    polished = _polish(system, measured, weights, turns)
    blocks, diagonal = np.empty((len(pairs), 3, 3)), np.empty((n, 3, 3))
    cost = certificate_blocks(pairs, measured, polished, weights, blocks, diagonal)
    scale = float(np.trace(diagonal, axis1=1, axis2=2).mean()) / 3.0
    shift = max(_TOLERANCE * cost / (3 * n), _ROUNDING * scale)
    certified = (
        system.is_definite(diagonal + shift * np.eye(3), blocks)
        if affordable
        else _least_eigenvalue(pairs, blocks, diagonal) >= -shift
    )
    moved = 2.0 * np.minimum(angle_between(polished, turns), angle_between(polished, -turns))
    return DualCertificate(
        certified=certified,
        proved=certified and affordable,
        cost=cost,
        lower_bound=cost - 3 * n * shift if certified else -np.inf,
        distance_deg=float(np.degrees(moved.max())),
    )


def _polish(
    system: AveragingSystem, measured: FloatArray, weights: FloatArray, turns: FloatArray
) -> FloatArray:
    """Return the stationary point of f near the given rotations, (n, 4)."""
    turns, gradient = turns.copy(), np.empty((system.num_nodes, 3))
    for _ in range(_POLISHING_STEPS):
        chordal_gradient(system.pairs, measured, turns, weights, gradient)
        if turn_cameras(turns, system.solve_scalar(weights, gradient, _REDUCTION), LONGEST_STEP) <= _SETTLED:
            break
    return turns


def _least_eigenvalue(pairs: IntArray, blocks: FloatArray, diagonal: FloatArray) -> float:
    """Estimate a lower bound of the smallest eigenvalue of S by Lanczos steps, -inf if none is found.

    m comes out up to a hundredth too large, which the bound, asked for as a power of ten, does not feel.
    """
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh  # it loads long

    n = len(diagonal)
    size = float(np.trace(diagonal, axis1=1, axis2=2).max())
    out = np.empty((n, 3))

    def apply(x: FloatArray) -> FloatArray:
        x = np.ascontiguousarray(x.reshape(n, 3))
        apply_certificate(pairs, blocks, diagonal, x, out)
        return np.asarray(out + size * x.mean(axis=0)).ravel()

    operator = LinearOperator((3 * n, 3 * n), matvec=apply, dtype=np.float64)
    start = np.random.default_rng(_SEED).normal(size=3 * n)
    try:
        values = eigsh(
            operator, k=1, which="SA", v0=start, tol=1e-2, maxiter=_LANCZOS_STEPS, return_eigenvectors=False
        )
    except ArpackNoConvergence:
        return -np.inf
    least = float(values[0])
    if least <= 0.0:
        return least
    slope = 0.0
    for axis in np.eye(3):
        apply_certificate(pairs, blocks, diagonal, np.tile(axis / np.sqrt(n), (n, 1)), out)
        slope += float(np.sum(out**2))
    return -slope / least


@kernel
def chordal_gradient(pairs: Any, measured: Any, turns: Any, weights: Any, gradient: Any) -> None:
    """Fill the gradient D^T W sin|x| x / |x| of f / 4, (n, 3)."""
    e = np.empty((3, 3))
    for i in range(len(gradient)):
        gradient[i, 0], gradient[i, 1], gradient[i, 2] = 0.0, 0.0, 0.0
    for k in range(len(pairs)):
        i, j = pairs[k, 0], pairs[k, 1]
        _around(measured[k], turns[i], turns[j], e)
        w = 0.5 * weights[k]
        s0, s1, s2 = w * (e[2, 1] - e[1, 2]), w * (e[0, 2] - e[2, 0]), w * (e[1, 0] - e[0, 1])
        gradient[i, 0] -= s0
        gradient[i, 1] -= s1
        gradient[i, 2] -= s2
        gradient[j, 0] += s0
        gradient[j, 1] += s1
        gradient[j, 2] += s2


@kernel
def certificate_blocks(
    pairs: Any, measured: Any, turns: Any, weights: Any, blocks: Any, diagonal: Any
) -> float:
    """Fill the blocks (i, j) of S, (k, 3, 3), and those of its diagonal, (n, 3, 3); return f."""
    e, cost = np.empty((3, 3)), 0.0
    for i in range(len(diagonal)):
        for a in range(3):
            for b in range(3):
                diagonal[i, a, b] = 0.0
    for k in range(len(pairs)):
        i, j, w = pairs[k, 0], pairs[k, 1], weights[k]
        _around(measured[k], turns[i], turns[j], e)
        for a in range(3):
            for b in range(3):
                blocks[k, a, b] = -w * e[b, a]
                symmetric = 0.5 * w * (e[a, b] + e[b, a])
                diagonal[i, a, b] += symmetric
                diagonal[j, a, b] += symmetric
                gap = e[a, b] - (1.0 if a == b else 0.0)
                cost += w * gap * gap
    return float(cost)


@kernel
def apply_certificate(pairs: Any, blocks: Any, diagonal: Any, x: Any, out: Any) -> None:
    """Fill out (n, 3) with S x."""
    for i in range(len(x)):
        for a in range(3):
            out[i, a] = (
                diagonal[i, a, 0] * x[i, 0] + diagonal[i, a, 1] * x[i, 1] + diagonal[i, a, 2] * x[i, 2]
            )
    for k in range(len(pairs)):
        i, j, b = pairs[k, 0], pairs[k, 1], blocks[k]
        for a in range(3):
            out[i, a] += b[a, 0] * x[j, 0] + b[a, 1] * x[j, 1] + b[a, 2] * x[j, 2]
            out[j, a] += b[0, a] * x[i, 0] + b[1, a] * x[i, 1] + b[2, a] * x[i, 2]


@inner_kernel
def _around(measured: Any, at_i: Any, at_j: Any, e: Any) -> None:
    """Fill the matrix E = R_j^T R_ij R_i of unit quaternions."""
    x, y, z, w = relative_in_world(measured, at_i, at_j)
    fill_matrix(x, y, z, w, e)
