"""The parts of a Newton cycle that know nothing of the matrix: passes over the edges, in kernels.

The formulas stand in the docstring of `sfm_shapefit.solver.newton`. All kernels are `exact`: they call
each other, and results must not depend on which copy runs (`sfm_shapefit.jit`).
"""

from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.jit import kernel
from sfm_shapefit.solver.options import IterationInfo, OnIteration
from sfm_shapefit.solver.program import scale_functional
from sfm_shapefit.viewgraph import ViewGraph

MU_PER_GAP = 0.1  # smoothing relative to the gap; .07 to .3 need the same number of factorisations
STEPS_PER_FACTOR = 10
_LEAST_MU = 1e-8  # of S, not of the target: below it M is too ill-conditioned for refinement to converge
REFINEMENTS = 3
STALL = 6  # factorisations without progress after which more will not help
EDGE_WORK = 1500.0  # a step passes over one edge in the time of so many operations of a factorisation
SOLVE_WORK = 20.0  # so many operations per entry of the factor, in the same unit: memory, not arithmetic

_EQUALITY = 1e-5, 1e-13  # allowed violation of D^T y = lambda c, per gap and at least, per mean degree
_TO_BOUNDARY = 0.99  # how far towards the surface of the ball
_MARGIN = 0.01  # a scaled dual stays inside the ball by this fraction of its excess
_HALVINGS = 20
_CANCEL = 1e-12  # size of c, relative to the sum of weights, that is rounding


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
    """The linearisation: S_e by the y, r, rho it was taken at, and a = M^-1 c."""

    y: FloatArray
    r: FloatArray
    rho: FloatArray
    """(m,)"""
    a: FloatArray
    """(n, d)"""


class Step(NamedTuple):
    """A proposed step, and scratch."""

    t: FloatArray
    """(n, d), dT."""
    r: FloatArray
    """(m, d), P D dT."""
    y: FloatArray
    """(m, d), g and then y+."""
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


def allocate(graph: ViewGraph) -> tuple[Problem, Iterate, Model, Step]:
    """Return the problem as arrays, and room for the iteration.

    Raises:
        UnsolvableError: if c is 0 up to rounding.
    """
    n, m, d = graph.num_cameras, graph.num_edges, graph.dimension

    def nodes() -> FloatArray:
        return np.empty((n, d))

    def edges() -> FloatArray:
        return np.empty((m, d))

    problem = Problem(
        np.ascontiguousarray(graph.edges),
        np.ascontiguousarray(graph.directions),
        np.ascontiguousarray(graph.weights),
        scale_functional(graph),
        float(graph.weights.sum()),
        tuple(range(d)),
    )
    if not np.linalg.norm(problem.c) > _CANCEL * problem.kappa:
        raise UnsolvableError("the directions cancel at every camera, so no scale can be fixed")
    model = Model(np.zeros((m, d)), np.zeros((m, d)), np.ones(m), nodes())
    step = Step(nodes(), edges(), edges(), nodes())
    return problem, Iterate(nodes(), edges(), edges()), model, step


def is_cancelled(on_iteration: OnIteration | None, iteration: int, progress: Progress) -> bool:
    """Tell the callback where the solver stands; return whether it asks to stop."""
    if on_iteration is None:
        return False
    bound = progress.objective - progress.gap
    return on_iteration(IterationInfo(iteration, progress.objective, bound)) is False


@kernel(exact=True)
def start_from(problem: Any, a: Any, iterate: Any) -> bool:
    """Start from the least-squares locations along `a`, whose scaled residuals are a feasible dual."""
    length = dot(problem.c, a)
    if not length > 0.0:
        return False
    iterate.t[:] = (problem.kappa / length) * a
    set_residuals(problem, iterate.t, iterate.r)
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
    return True


def answer(iterate: Iterate, progress: Progress, tol: float) -> tuple[FloatArray, FloatArray]:
    """Return locations and dual. Where the objective is 0 up to the tolerance, y = 0 proves it best."""
    if progress.objective <= tol:
        iterate.y[:] = 0.0
    return iterate.t, iterate.y


@kernel(exact=True)
def measure(problem: Any, iterate: Any, mu: float, multiplier: float) -> Progress:
    """Return the scalars at the iterate."""
    objective, bound = objective_and_bound(problem, iterate)
    return Progress(mu, multiplier, objective, objective - bound)


@kernel(exact=True)
def pays(first: float, previous: float, gap: float, work: float, step_work: float) -> bool:
    """Return whether the last step gained at least as much per unit of work as the cycle did on average."""
    return bool(np.log(previous / gap) * work >= np.log(first / gap) * step_work)


@kernel(exact=True)
def allowed_violation(problem: Any, gap: float) -> float:
    """Return how far D^T y+ may be from lambda+ c at a camera."""
    per_gap, least = _EQUALITY
    return float(max(per_gap * gap, least) * problem.kappa / len(problem.c))


@kernel(exact=True)
def linearise(iterate: Any, mu: float, model: Any) -> None:
    """Keep the iterate as the point at which S is taken."""
    floor = max(mu, _LEAST_MU)
    for e in range(len(iterate.r)):
        rr = floor * floor
        for k in range(iterate.r.shape[1]):
            rr += iterate.r[e, k] ** 2
            model.y[e, k] = iterate.y[e, k]
            model.r[e, k] = iterate.r[e, k]
        model.rho[e] = np.sqrt(rr)


@kernel(exact=True)
def set_gradient(problem: Any, iterate: Any, model: Any, mu: float, step: Any) -> None:
    """Begin a step: dT = 0, y+ = g with g_e = y_e - (rho_e y_e - w_e r_e) / rho'_e, nodes = D^T g."""
    edges, w, y, r, nodes = problem.edges, problem.w, iterate.y, iterate.r, step.nodes
    step.t[:] = 0.0
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
            step.r[e, k] = 0.0
            step.y[e, k] = x
            nodes[i, k] += x
            nodes[j, k] -= x


@kernel(exact=True)
def extend_step(problem: Any, model: Any, dt: Any, step: Any) -> None:
    """Add dt to the step: dT += dt, y+_e += S_e P_e (dt_i - dt_j), nodes = D^T y+.

    A refinement adds its small dt to the dual that is there: y+ from the whole dT would carry the
    rounding of dT, multiplied by a stiffness of the order 1 / mu.
    """
    edges, v, w, y, nodes = problem.edges, problem.v, problem.w, step.y, step.nodes
    step.t[:] += dt
    nodes[:] = 0.0
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        s = 0.0
        for k in range(len(problem.axes)):
            s += (dt[i, k] - dt[j, k]) * v[e, k]
        yd = rd = 0.0
        for k in range(len(problem.axes)):
            x = (dt[i, k] - dt[j, k]) - s * v[e, k]
            step.r[e, k] += x
            yd += model.y[e, k] * x
            rd += model.r[e, k] * x
        inverse = 1.0 / model.rho[e]
        stiffness, bend = w[e] * inverse, 0.5 * inverse * inverse
        yv = 0.0
        for k in range(len(problem.axes)):
            x = (dt[i, k] - dt[j, k]) - s * v[e, k]
            y[e, k] += stiffness * x - bend * (rd * model.y[e, k] + yd * model.r[e, k])
            yv += y[e, k] * v[e, k]
        for k in range(len(problem.axes)):
            y[e, k] -= yv * v[e, k]
            nodes[i, k] += y[e, k]
            nodes[j, k] -= y[e, k]


@kernel(exact=True)
def take(problem: Any, iterate: Any, step: Any, mu: float, multiplier: float, target: float) -> float:
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
def set_residuals(problem: Any, t: Any, r: Any) -> None:
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
def objective_and_bound(problem: Any, iterate: Any) -> tuple[float, float]:
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
def dot(x: Any, y: Any) -> float:
    """Return the inner product of two (n, d) arrays."""
    total = 0.0
    for i in range(x.shape[0]):
        for k in range(x.shape[1]):
            total += x[i, k] * y[i, k]
    return total
