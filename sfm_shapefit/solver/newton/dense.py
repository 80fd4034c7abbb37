"""Newton cycles with a dense Cholesky factor of M, nd x nd, compiled as one function over LAPACK."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.jit import array_address, inner_kernel, kernel
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.dense import Blas, blas_of, potrf, solve_factored
from sfm_shapefit.solver.newton.irls_start import approach
from sfm_shapefit.solver.newton.steps import (
    REFINEMENTS,
    STALL,
    STEPS_PER_FACTOR,
    NewtonProgress,
    Scalars,
    allocate,
    allowed_violation,
    answer,
    close_cycle,
    combine,
    dot,
    extend_step,
    is_cancelled,
    is_within,
    linearize_program,
    measure_gap,
    pays,
    set_gradient,
    set_residuals,
    smoothing,
    start_from,
    take_step,
    working_dimension,
)
from sfm_shapefit.solver.solver_options import OnIteration

_RIDGES = {4: (1e-8, 1e-8), 8: (1e-14, 1e-9)}
"""By bytes per number: first and last multiple of the identity added to M, per mean eigenvalue."""
_REFINEMENTS = {4: 8, 8: REFINEMENTS}
"""By bytes per number: in single precision each gains a digit or more, or M is too ill-conditioned."""
_PATIENCE = {4: 3, 8: STALL}
"""Factorizations without progress after which it is given up; by bytes per number."""
_SINGLE_FROM = 450  # unknowns; from here on a factor in float32 saves more than its refinements cost
# Operations of a dense factorization in the time of a step's pass over one edge, and over one matrix entry:
# memory decides there, not arithmetic.
_EDGE_WORK, _SOLVE_WORK = 1000.0, 10.0
# One call takes about 0.1 s: so long an interrupt may have to wait.
_OPERATIONS_PER_CALL = 4e9


class DenseNewtonFactor(NamedTuple):
    """Room for M and its Cholesky factor, and what LAPACK is called with."""

    is_single: bool
    """Whether the factor is of float32: one kernel for both types takes half as long to compile as two."""
    matrix: FloatArray
    """(nd * nd,) lower triangle in column-major order; empty if the factor is of float32."""
    right: FloatArray
    """(nd,) scratch: right-hand side, then solution; empty if the factor is of float32."""
    single_matrix: npt.NDArray[np.float32]
    """(nd * nd,) as `matrix`, of float32; else empty."""
    single_right: npt.NDArray[np.float32]
    """(nd,) as `right`, of float32; else empty."""
    diagonal: FloatArray
    """(n, d, d) scratch: the diagonal blocks of M."""
    half: FloatArray
    """(d, d - 1) scratch."""
    blas: Blas
    ridge: tuple[float, float]
    """First and last multiple of the identity added to M, per mean eigenvalue."""
    refinements: int
    """After which a step must fulfill its equations, or is not taken."""
    patience: int
    """Factorizations without progress after which more of this precision will not help."""


def solve_newton_dense(
    graph: ViewGraph, tol: float, max_iterations: int, on_iteration: OnIteration | None = None
) -> tuple[FloatArray, FloatArray, int]:
    """Solve as `solve_newton_sparse` with a dense factor of nd x nd, for n up to about a thousand."""
    problem, iterate, linearization, step = allocate(graph, working_dimension(graph))
    n, d = problem.c.shape
    single = n * d >= _SINGLE_FROM
    factor = _allocate_factor(n, d, np.float32 if single else np.float64)
    with one_blas_thread():
        if not (approach(problem, iterate, step) or _start(problem, iterate, linearization, factor)):
            raise UnsolvableError("the directions do not determine the locations; check the graph's rigidity")
        progress = NewtonProgress(*measure_gap(problem, iterate))
        count, stalled = 0, 0
        chunk = 1 if on_iteration else max(1, int(_OPERATIONS_PER_CALL / (problem.c.size**3 / 3)))
        while progress.gap > tol and count < max_iterations and stalled < STALL:
            limit = min(chunk, max_iterations - count)
            done, stalled, after = _newton(
                problem, iterate, linearization, factor, step, progress, tol, limit, stalled
            )
            progress = NewtonProgress(*after)
            count += done
            if is_cancelled(on_iteration, count, progress):
                break
            if single and stalled >= factor.patience:
                single, factor, stalled = False, _allocate_factor(n, d, np.float64), 0
    return *answer(problem, iterate, progress, tol, graph.dimension), count


def _allocate_factor(n: int, d: int, dtype: type[np.floating[Any]]) -> DenseNewtonFactor:
    size, order = np.dtype(dtype).itemsize, n * d
    single, double = (order, 0) if size == 4 else (0, order)
    return DenseNewtonFactor(
        is_single=size == 4,
        matrix=np.empty(double**2),
        right=np.empty(double),
        single_matrix=np.empty(single**2, np.float32),
        single_right=np.empty(single, np.float32),
        diagonal=np.empty((n, d, d)),
        half=np.empty((d, d - 1)),
        blas=blas_of(dtype),
        ridge=_RIDGES[size],
        refinements=_REFINEMENTS[size],
        patience=_PATIENCE[size],
    )


@kernel
def _newton(
    problem: Any,
    iterate: Any,
    linearization: Any,
    factor: Any,
    step: Any,
    progress: Any,
    tol: float,
    limit: int,
    stalled: int,
) -> tuple[int, int, Scalars]:
    """Run up to `limit` cycles; return how many ran, for how many there was no progress, and the scalars."""
    count = 0
    order = float(problem.c.size)
    step_work = _EDGE_WORK * len(problem.w) + _SOLVE_WORK * order**2
    cycle_work = order**3 / 3.0 + 0.5 * _EDGE_WORK * len(problem.w)
    while count < limit and progress.gap > tol and stalled < factor.patience:
        first, work = progress.gap, cycle_work
        mu = smoothing(progress, progress.mu)
        set_residuals(problem, iterate.t, iterate.r)
        linearize_program(problem, iterate, mu, linearization)
        if _factorize(problem, linearization, factor) == 0:
            for _ in range(STEPS_PER_FACTOR):
                previous = progress.gap
                mu = smoothing(progress, mu)
                target, exact = _propose(problem, iterate, linearization, factor, step, mu, previous)
                if not exact:
                    break
                progress = NewtonProgress(*take_step(problem, iterate, step, mu, progress, target))
                work += step_work
                if progress.gap <= tol or not pays(first, previous, progress.gap, work, step_work):
                    break
            mu = progress.mu
        progress = NewtonProgress(*close_cycle(iterate, progress, mu, first))
        count += 1
        stalled = 0 if progress.gap < 0.9 * first else stalled + 1
        if progress.gap == first and factor.is_single:
            stalled = factor.patience  # no step could be taken, nor could one by the same matrix again
    scalars = progress.mu, progress.multiplier, progress.objective, progress.gap, progress.clips
    return count, stalled, scalars


@kernel
def _start(problem: Any, iterate: Any, linearization: Any, factor: Any) -> bool:
    """Factor the projected Laplacian D^T W P D, which is M at rho = 1, y = r = 0, and start from it."""
    if _factorize(problem, linearization, factor) != 0:
        return False
    return start_from(problem, linearization.a, iterate)


@inner_kernel
def _factorize(problem: Any, linearization: Any, factor: Any) -> int:
    """Assemble and factor M, with more ridge if it is not positive definite; solve for a. 0 if it worked."""
    order = problem.c.size
    size = 0.0  # mean eigenvalue
    for e in range(len(problem.w)):
        size += 2.0 * (len(problem.axes) - 1) * problem.w[e] * linearization.inverse[e] / order
    ridge, last = factor.ridge
    info = 1
    while info != 0 and ridge <= last:
        if factor.is_single:
            _lift(problem, factor.single_matrix, size, ridge * size)
            _add_edge_blocks(problem, linearization, factor.single_matrix, factor.diagonal, factor.half)
        else:
            _lift(problem, factor.matrix, size, ridge * size)
            _add_edge_blocks(problem, linearization, factor.matrix, factor.diagonal, factor.half)
        info = potrf(factor.blas, (_address(factor), order), order)
        ridge *= 100.0
    if info == 0:
        _solve(factor, problem.c, linearization.a)
    return info


@inner_kernel
def _address(factor: Any) -> Any:
    return array_address(factor.single_matrix) if factor.is_single else array_address(factor.matrix)


@inner_kernel
def _lift(problem: Any, matrix: Any, size: float, ridge: float) -> None:
    """Overwrite a matrix by outer products of c and of translations, of norm `size`, plus the ridge."""
    order = problem.c.size
    c = problem.c.reshape(order)
    along_c, along_axis = size / dot(problem.c, problem.c), size / len(problem.c)
    for q in range(order):
        column = matrix[q * order + q : (q + 1) * order]
        rest = c[q:]
        slope = along_c * c[q]
        for p in range(len(column)):  # over views that begin at 0: an index that may be negative is slow
            column[p] = slope * rest[p]
        for p in range(0, len(column), len(problem.axes)):
            column[p] += along_axis
        column[0] += ridge


@inner_kernel
def _add_edge_blocks(problem: Any, linearization: Any, matrix: Any, diagonal: Any, half: Any) -> None:
    """Add D^T S D to the lower triangle of a matrix."""
    edges, basis, s = problem.edges, problem.basis, linearization.s
    n, d = len(problem.c), len(problem.axes)
    order = n * d
    diagonal[:] = 0.0
    for e in range(len(edges)):
        i, j = np.int64(edges[e, 0]), np.int64(edges[e, 1])
        corner = min(i, j) * d * order + max(i, j) * d
        for k in range(d):
            for g in range(len(problem.transverse)):
                x = 0.0
                for f in range(len(problem.transverse)):
                    x += basis[e, k, f] * s[e, f, g]
                half[k, g] = x
        for k in range(d):
            for q in range(k, d):
                x = 0.0
                for g in range(len(problem.transverse)):
                    x += half[k, g] * basis[e, q, g]
                matrix[corner + k * order + q] -= x
                if k < q:
                    matrix[corner + q * order + k] -= x
                diagonal[i, k, q] += x
                diagonal[j, k, q] += x
    for node in range(n):
        for k in range(d):
            for q in range(k, d):
                matrix[(node * d + k) * order + node * d + q] += diagonal[node, k, q]


@inner_kernel
def _propose(
    problem: Any, iterate: Any, linearization: Any, factor: Any, step: Any, mu: float, gap: float
) -> tuple[float, bool]:
    """Return lambda+ of the refined step, and whether D^T y+ = lambda+ c: else do not take it."""
    c, a, nodes, addend = problem.c, linearization.a, step.nodes, step.addend
    allowed, scale = allowed_violation(problem, gap), dot(c, a)
    set_gradient(problem, iterate, linearization, mu, step)
    _solve(factor, nodes, nodes)
    multiplier = dot(c, nodes) / scale
    combine(multiplier, a, -1.0, nodes, addend)
    for _ in range(factor.refinements):
        extend_step(problem, linearization, step)
        combine(multiplier, c, -1.0, nodes, nodes)
        if is_within(nodes, allowed):
            return float(multiplier), True
        _solve(factor, nodes, nodes)
        shift = dot(c, nodes) / scale
        multiplier -= shift
        combine(1.0, nodes, -shift, a, addend)
    extend_step(problem, linearization, step)
    combine(multiplier, c, -1.0, nodes, nodes)
    return float(multiplier), is_within(nodes, allowed)


@inner_kernel
def _solve(factor: Any, nodes: Any, solution: Any) -> None:
    """Write M^-1 nodes, which may be in place."""
    if factor.is_single:
        _solve_by(factor.blas, factor.single_matrix, factor.single_right, nodes, solution)
    else:
        _solve_by(factor.blas, factor.matrix, factor.right, nodes, solution)


@inner_kernel
def _solve_by(blas: Any, matrix: Any, right: Any, nodes: Any, solution: Any) -> None:
    """Do what `_solve` does by arrays of one type."""
    n, d = nodes.shape
    for i in range(n):
        for k in range(d):
            right[i * d + k] = nodes[i, k]
    solve_factored(blas, (array_address(matrix), right.size), right.size, array_address(right))
    for i in range(n):
        for k in range(d):
            solution[i, k] = right[i * d + k]
