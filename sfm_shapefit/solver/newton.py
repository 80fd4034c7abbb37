"""Primal-dual Newton steps on the smoothed sum of norms, dual feasible at every iterate.

The norms of the program (`program`) are smoothed to rho_e = sqrt(||r_e||^2 + mu^2), and Newton's method
is applied to the optimality conditions of the smoothed program, written without a quotient:

    rho_e y_e = w_e r_e,    D^T y = lambda c,    <c, T> = kappa,        r_e = P_e (t_i - t_j)

Linearised at (T, y), with the block S_e made symmetric, a step dT and the dual y+ it leads to are

    y+_e = g_e + S_e P_e (dt_i - dt_j),    g_e = w_e r_e / rho_e
    S_e  = (w_e P_e - (y_e r_e^T + r_e y_e^T) / (2 rho_e)) / rho_e
    M dT = lambda+ c - D^T g,    <c, dT> = 0,                 M = D^T S D

S_e is positive definite across v_e, for ||y_e|| <= w_e and ||r_e|| < rho_e. With a = M^-1 c and
b = M^-1 D^T g the solution is lambda+ = <c, b> / <c, a>, dT = lambda+ a - b. Then D^T y+ = lambda+ c: the dual
stays feasible, and lambda is a bound at every iterate.

What makes it fast and safe:

- *Lifting.* M is singular along translations, and nearly so along T where the data are nearly exact. Neither
  direction occurs in dT, for it would change the centroid or <c, T>. So multiples of 1 1^T and c c^T
  are added to M: dT and lambda+ stay what they are, and the matrix is well conditioned.
- *The better of two dual steps.* y moves towards y+ as far as the ball allows, or y+ is divided by its
  excess max ||y+_e|| / w_e. Both keep the equality; the larger lambda is taken. Near the optimum y+ leaves
  the ball by a hair, and scaling costs a hair where stopping short costs half of the step.
- *Steps with an old matrix.* After a step the conditions are evaluated anew and solved again with the
  factor in hand: g_e = y_e - (rho_e y_e - w_e r_e) / rho'_e, rho' and S from the factorisation. That costs a
  few passes over the edges. It goes on while the last step gained more per unit of work than the
  cycle since the factorisation did on average, and nearly halves the number of factorisations.

Source: Andersen, Christiansen, Conn, Overton, "An efficient primal-dual interior-point method for
minimizing a sum of Euclidean norms", SIAM J. Sci. Comput. 22 (2000), for the symmetrised step.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.jit import kernel
from sfm_shapefit.laplacian.dense import FLAGS, one_blas_thread, potrf, potrs, routine_addresses, work_integers
from sfm_shapefit.solver.program import scale_functional
from sfm_shapefit.viewgraph import ViewGraph

OnIteration = Callable[[int, float, float], object]
"""Called with the number of factorisations so far, the objective and the gap."""

_MU_PER_GAP = 0.15  # smoothing relative to the gap; .05 to .25 need the same number of factorisations
_TO_BOUNDARY = 0.99  # how far towards the surface of the ball
_MARGIN = 0.01  # a scaled dual stays inside the ball by this fraction of its excess
_STEPS_PER_FACTOR = 10
_EDGE_WORK = 1500.0  # a step passes over one edge in the time of so many operations of a factorisation
_EQUALITY = 1e-3, 1e-13  # allowed violation of D^T y = lambda c, per gap and at least, per mean degree
_REFINEMENTS = 3
_HALVINGS = 20
_RIDGE = 1e-14, 1e-9  # first and last multiple of the identity added to M, per mean eigenvalue
_STALL = 6  # factorisations without progress after which more will not help
_SOLVE_WORK = 20.0  # so many operations per entry of the factor, in the same unit: memory, not arithmetic
_OPERATIONS_PER_CALL = 4e9  # about 0.1 s: how long an interrupt may have to wait


class Problem(NamedTuple):
    """The data, as the kernels take them."""

    edges: IntArray
    v: FloatArray
    w: FloatArray
    c: FloatArray
    kappa: float
    axes: tuple[int, ...]
    """(0, ..., d - 1); its length tells the compiler the dimension, so that it unrolls the loops over it."""


class Iterate(NamedTuple):
    """Where the solver stands; every step overwrites it."""

    t: FloatArray
    """(n, d) locations, <c, T> = kappa."""
    y: FloatArray
    """(m, d) feasible dual."""
    r: FloatArray
    """(m, d) residuals P_e (t_i - t_j)."""


class Model(NamedTuple):
    """The linearisation: S_e by the y, r, rho it was taken at, and the Cholesky factor of M."""

    y: FloatArray
    r: FloatArray
    rho: FloatArray
    """(m,)"""
    matrix: FloatArray
    """(nd * nd,) lower triangle in column-major order."""
    diagonal: FloatArray
    """(n, d, d) scratch: the diagonal blocks of M."""
    a: FloatArray
    """(n, d), M^-1 c."""
    routines: IntArray
    flags: Any
    integers: Any


class Step(NamedTuple):
    """A proposed step, and scratch."""

    t: FloatArray
    """(n, d), dT."""
    r: FloatArray
    """(m, d), P D dT."""
    g: FloatArray
    """(m, d)"""
    y: FloatArray
    """(m, d), y+."""
    nodes: FloatArray
    """(n, d) right-hand side, then solution."""


class Progress(NamedTuple):
    """The scalars of the iteration."""

    mu: float
    multiplier: float
    """lambda."""
    objective: float
    """R(T) / kappa."""
    gap: float
    """sum_e (w_e ||r_e|| - <y_e, r_e>) / kappa: every term is positive, so it does not cancel."""


def solve_newton_dense(
    graph: ViewGraph, tol: float, max_iterations: int, on_iteration: OnIteration | None = None
) -> tuple[FloatArray, FloatArray, int]:
    """Solve the program with a dense Cholesky factor of nd x nd; for n up to about a thousand.

    Args:
        graph: a connected, parallel-rigid view graph whose c is not 0.
        tol: the gap wanted, in units of the objective.
        max_iterations: limit of factorisations.
        on_iteration: called after every factorisation and its steps; raise in it to cancel.

    Returns:
        locations (n, d), the dual (m, d), and the number of factorisations.

    Raises:
        UnsolvableError: if the directions do not determine any locations.
    """
    problem, iterate, model, step = _allocate(graph)
    with one_blas_thread():
        if _start(problem, iterate, model) != 0:
            raise UnsolvableError("the directions do not determine the locations; check the graph's rigidity")
        progress = _first_progress(problem, iterate)
        count, stalled = 0, 0
        chunk = 1 if on_iteration else max(1, int(_OPERATIONS_PER_CALL / (problem.c.size**3 / 3)))
        while progress.gap > tol and count < max_iterations and stalled < _STALL:
            steps = min(chunk, max_iterations - count)
            done, stalled, progress = _newton(problem, iterate, model, step, progress, tol, steps, stalled)
            count += done
            if on_iteration:
                on_iteration(count, progress.objective, progress.gap)
    return iterate.t, iterate.y, count


def _allocate(graph: ViewGraph) -> tuple[Problem, Iterate, Model, Step]:
    """Return the problem as arrays, and room for the iteration."""
    n, m, d = graph.num_cameras, graph.num_edges, graph.dimension

    def nodes() -> FloatArray:
        return np.empty((n, d))

    def edges() -> FloatArray:
        return np.empty((m, d))

    problem = Problem(
        np.ascontiguousarray(graph.edges),
        np.ascontiguousarray(graph.directions),
        graph.weights,
        scale_functional(graph),
        float(graph.weights.sum()),
        tuple(range(d)),
    )
    matrix, blocks = np.empty((n * d) ** 2), np.empty((n, d, d))
    lapack = routine_addresses(np.float64), FLAGS, work_integers()
    model = Model(edges(), edges(), np.empty(m), matrix, blocks, nodes(), *lapack)
    step = Step(nodes(), edges(), edges(), edges(), nodes())
    return problem, Iterate(nodes(), edges(), edges()), model, step


@kernel(exact=True)
def _newton(
    problem: Any, iterate: Any, model: Any, step: Any, progress: Any, tol: float, limit: int, stalled: int
) -> tuple[int, int, Progress]:
    """Run up to `limit` cycles; return how many ran, for how many there was no progress, and the scalars."""
    count = 0
    while count < limit and progress.gap > tol and stalled < _STALL:
        before = progress.gap
        count += 1
        progress = _cycle(problem, iterate, model, step, progress, tol)
        stalled = 0 if progress.gap < 0.9 * before else stalled + 1
    return count, stalled, progress


@kernel(exact=True)
def _cycle(problem: Any, iterate: Any, model: Any, step: Any, progress: Any, tol: float) -> Progress:
    """Factor once, then step with that factor while it pays."""
    first, mu, multiplier = progress.gap, progress.mu, progress.multiplier
    mu = min(mu, _MU_PER_GAP * first)
    _set_residuals(problem, iterate.t, iterate.r)
    _linearise(iterate, mu, model)
    if _factorise(problem, model) != 0:
        return Progress(mu, multiplier, progress.objective, first)
    order = float(problem.c.size)
    step_work = _EDGE_WORK * len(problem.w) + _SOLVE_WORK * order**2
    work = order**3 / 3.0 + 0.5 * _EDGE_WORK * len(problem.w)
    for _ in range(_STEPS_PER_FACTOR):
        previous = progress.gap
        mu = min(mu, _MU_PER_GAP * previous)
        target = _propose(problem, iterate, model, step, mu, previous)
        multiplier = _take(problem, iterate, step, mu, multiplier, target)
        objective, bound = _objective_and_bound(problem, iterate)
        progress = Progress(mu, multiplier, objective, objective - bound)
        work += step_work
        if progress.gap <= tol:
            break
        if np.log(previous / progress.gap) * work < np.log(first / progress.gap) * step_work:
            break
    return progress


@kernel(exact=True)
def _start(problem: Any, iterate: Any, model: Any) -> int:
    """Start from the least-squares locations, whose scaled residuals are a feasible dual; 0 if that worked."""
    model.rho[:] = 1.0
    model.y[:] = 0.0
    model.r[:] = 0.0
    info = _factorise(problem, model)
    length = _dot(problem.c, model.a)
    if info != 0 or not length > 0.0:
        return 1
    iterate.t[:] = (problem.kappa / length) * model.a
    _set_residuals(problem, iterate.t, iterate.r)
    worst = 0.0
    for e in range(len(problem.w)):
        rr = 0.0
        for k in range(len(problem.axes)):
            rr += iterate.r[e, k] ** 2
        worst = max(worst, np.sqrt(rr))
    for e in range(len(problem.w)):
        scale = problem.w[e] / worst if worst > 0.0 else 0.0
        for k in range(len(problem.axes)):
            iterate.y[e, k] = scale * iterate.r[e, k]
    return 0


@kernel(exact=True)
def _first_progress(problem: Any, iterate: Any) -> Progress:
    """Return the scalars at the start; the smoothing is at most the mean length of a pair."""
    objective, bound = _objective_and_bound(problem, iterate)
    return Progress(1.0, bound, objective, objective - bound)


@kernel(exact=True)
def _factorise(problem: Any, model: Any) -> int:
    """Assemble and factor M, with more ridge if it is not positive definite; solve for a. 0 if that worked."""
    order = problem.c.size
    size = 0.0  # mean eigenvalue
    for e in range(len(problem.w)):
        size += 2.0 * (len(problem.axes) - 1) * problem.w[e] / model.rho[e] / order
    ridge, last = _RIDGE
    info = 1
    while info != 0 and ridge <= last:
        _lift(problem, model, size, ridge * size)
        _add_edge_blocks(problem, model)
        info = potrf(model.routines, model.flags, model.integers, model.matrix, 0, order, order)
        ridge *= 100.0
    model.a[:] = problem.c
    if info == 0:
        potrs(model.routines, model.flags, model.integers, model.matrix, order, model.a)
    return info


@kernel(exact=True)
def _lift(problem: Any, model: Any, size: float, ridge: float) -> None:
    """Overwrite the matrix by outer products of c and of translations, of norm `size`, plus the ridge."""
    n, d = problem.c.shape
    order = n * d
    c = problem.c.reshape(order)
    along_c = size / _dot(problem.c, problem.c)
    for q in range(order):
        column = model.matrix[q * order : (q + 1) * order]
        factor = along_c * c[q]
        for p in range(q, order):
            column[p] = factor * c[p]
        for p in range(q, order, d):
            column[p] += size / n
        column[q] += ridge


@kernel(exact=True)
def _add_edge_blocks(problem: Any, model: Any) -> None:
    """Add D^T S D to the lower triangle of the matrix."""
    edges, v, w, y, r = problem.edges, problem.v, problem.w, model.y, model.r
    matrix, diagonal = model.matrix, model.diagonal
    n, d = len(problem.c), len(problem.axes)
    order = n * d
    diagonal[:] = 0.0
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        corner = min(i, j) * d * order + max(i, j) * d
        inverse = 1.0 / model.rho[e]
        stiffness, bend = w[e] * inverse, 0.5 * inverse * inverse
        for k in range(d):
            for l in range(d):
                s = -stiffness * v[e, k] * v[e, l] - bend * (y[e, k] * r[e, l] + r[e, k] * y[e, l])
                if k == l:
                    s += stiffness
                matrix[corner + k * order + l] -= s
                if k <= l:
                    diagonal[i, k, l] += s
                    diagonal[j, k, l] += s
    for i in range(n):
        for k in range(d):
            for l in range(k, d):
                matrix[(i * d + k) * order + i * d + l] += diagonal[i, k, l]


@kernel(exact=True)
def _linearise(iterate: Any, mu: float, model: Any) -> None:
    """Keep the iterate as the point at which S is taken."""
    for e in range(len(iterate.r)):
        rr = mu * mu
        for k in range(iterate.r.shape[1]):
            rr += iterate.r[e, k] ** 2
            model.y[e, k] = iterate.y[e, k]
            model.r[e, k] = iterate.r[e, k]
        model.rho[e] = np.sqrt(rr)


@kernel(exact=True)
def _propose(problem: Any, iterate: Any, model: Any, step: Any, mu: float, gap: float) -> float:
    """Solve for the step with the factor in hand, refined until D^T y+ = lambda+ c; return lambda+."""
    c, a, nodes, order = problem.c, model.a, step.nodes, problem.c.size
    per_gap, least = _EQUALITY
    allowed = max(per_gap * gap, least) * problem.kappa / len(c)
    scale = _dot(c, a)
    _set_gradient(problem, iterate, model, mu, step)
    potrs(model.routines, model.flags, model.integers, model.matrix, order, nodes)
    multiplier = _dot(c, nodes) / scale
    step.t[:] = multiplier * a - nodes
    for _ in range(_REFINEMENTS):
        _set_dual(problem, model, step)
        nodes[:] = multiplier * c - nodes
        if np.max(np.abs(nodes)) <= allowed:
            return multiplier
        potrs(model.routines, model.flags, model.integers, model.matrix, order, nodes)
        shift = _dot(c, nodes) / scale
        multiplier -= shift
        step.t[:] += nodes - shift * a
    _set_dual(problem, model, step)
    return multiplier


@kernel(exact=True)
def _set_gradient(problem: Any, iterate: Any, model: Any, mu: float, step: Any) -> None:
    """g_e = y_e - (rho_e y_e - w_e r_e) / rho'_e, and nodes = D^T g."""
    edges, w, y, r, g, nodes = problem.edges, problem.w, iterate.y, iterate.r, step.g, step.nodes
    nodes[:] = 0.0
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        rr = mu * mu
        for k in range(len(problem.axes)):
            rr += r[e, k] ** 2
        inverse = 1.0 / model.rho[e]
        keep, pull = 1.0 - np.sqrt(rr) * inverse, w[e] * inverse
        for k in range(len(problem.axes)):
            x = keep * y[e, k] + pull * r[e, k]
            g[e, k] = x
            nodes[i, k] += x
            nodes[j, k] -= x


@kernel(exact=True)
def _set_dual(problem: Any, model: Any, step: Any) -> None:
    """P D dT, y+_e = g_e + S_e P_e (dt_i - dt_j), and nodes = D^T y+."""
    edges, v, w, dt, nodes = problem.edges, problem.v, problem.w, step.t, step.nodes
    nodes[:] = 0.0
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        s = 0.0
        for k in range(len(problem.axes)):
            s += (dt[i, k] - dt[j, k]) * v[e, k]
        yd = rd = 0.0
        for k in range(len(problem.axes)):
            x = (dt[i, k] - dt[j, k]) - s * v[e, k]
            step.r[e, k] = x
            yd += model.y[e, k] * x
            rd += model.r[e, k] * x
        inverse = 1.0 / model.rho[e]
        stiffness, bend = w[e] * inverse, 0.5 * inverse * inverse
        for k in range(len(problem.axes)):
            x = step.g[e, k] + stiffness * step.r[e, k] - bend * (rd * model.y[e, k] + yd * model.r[e, k])
            step.y[e, k] = x
            nodes[i, k] += x
            nodes[j, k] -= x


@kernel(exact=True)
def _take(problem: Any, iterate: Any, step: Any, mu: float, multiplier: float, target: float) -> float:
    """Move along the step as far as it helps; return the new multiplier."""
    alpha = 1.0
    while alpha > 0.0 and _increase(problem, iterate, step, mu, alpha) > 0.0:
        alpha = 0.5 * alpha if alpha > 0.5**_HALVINGS else 0.0
    length, excess = _dual_limits(problem, iterate, step)
    beta = min(1.0, _TO_BOUNDARY * length)
    partly = multiplier + beta * (target - multiplier)
    scale = 1.0 / (excess * (1.0 + _MARGIN * (excess - 1.0))) if excess > 1.0 else 1.0
    if excess > 1.0 and scale * target > partly:
        _move(iterate, step, alpha, 0.0, scale)
        return scale * target
    _move(iterate, step, alpha, 1.0 - beta, beta)
    return partly


@kernel(exact=True)
def _increase(problem: Any, iterate: Any, step: Any, mu: float, alpha: float) -> float:
    """Return the change of sum_e w_e rho_e from r to r + alpha dr, without cancellation."""
    r, dr = iterate.r, step.r
    total = 0.0
    for e in range(len(problem.w)):
        rr = rd = dd = 0.0
        for k in range(len(problem.axes)):
            rr += r[e, k] * r[e, k]
            rd += r[e, k] * dr[e, k]
            dd += dr[e, k] * dr[e, k]
        change = alpha * (2.0 * rd + alpha * dd)
        now = rr + mu * mu
        then = max(now + change, mu * mu)
        total += problem.w[e] * change / (np.sqrt(now) + np.sqrt(then))
    return total


@kernel(exact=True)
def _dual_limits(problem: Any, iterate: Any, step: Any) -> tuple[float, float]:
    """Return the longest step from y towards y+ inside the ball, and max_e ||y+_e|| / w_e."""
    length, excess = np.inf, 0.0
    for e in range(len(problem.w)):
        dd = yd = yy = pp = 0.0
        for k in range(len(problem.axes)):
            y, target = iterate.y[e, k], step.y[e, k]
            dd += (target - y) ** 2
            yd += (target - y) * y
            yy += y * y
            pp += target * target
        ww = problem.w[e] ** 2
        if pp > ww:
            excess = max(excess, pp / ww)
            room = max(ww - yy, 0.0)
            root = np.sqrt(yd * yd + dd * room)
            length = min(length, room / (yd + root) if yd > 0.0 else (root - yd) / dd)
    return length, np.sqrt(excess)


@kernel(exact=True)
def _move(iterate: Any, step: Any, alpha: float, keep: float, gain: float) -> None:
    """T += alpha dT, r += alpha dr, y = keep y + gain y+."""
    iterate.t[:] += alpha * step.t
    for e in range(len(iterate.r)):
        for k in range(iterate.r.shape[1]):
            iterate.r[e, k] += alpha * step.r[e, k]
            iterate.y[e, k] = keep * iterate.y[e, k] + gain * step.y[e, k]


@kernel(exact=True)
def _set_residuals(problem: Any, t: Any, r: Any) -> None:
    """r_e = P_e (t_i - t_j)."""
    edges, v = problem.edges, problem.v
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        s = 0.0
        for k in range(len(problem.axes)):
            s += (t[i, k] - t[j, k]) * v[e, k]
        for k in range(len(problem.axes)):
            r[e, k] = (t[i, k] - t[j, k]) - s * v[e, k]


@kernel(exact=True)
def _objective_and_bound(problem: Any, iterate: Any) -> tuple[float, float]:
    """Return R(T) / kappa and the dual value lambda = <y, r> / kappa."""
    objective = bound = 0.0
    for e in range(len(problem.w)):
        rr = yr = 0.0
        for k in range(len(problem.axes)):
            rr += iterate.r[e, k] * iterate.r[e, k]
            yr += iterate.r[e, k] * iterate.y[e, k]
        objective += problem.w[e] * np.sqrt(rr)
        bound += yr
    return objective / problem.kappa, bound / problem.kappa


@kernel(exact=True)
def _dot(x: Any, y: Any) -> float:
    """Return the inner product of two (n, d) arrays."""
    total = 0.0
    for i in range(x.shape[0]):
        for k in range(x.shape[1]):
            total += x[i, k] * y[i, k]
    return total
