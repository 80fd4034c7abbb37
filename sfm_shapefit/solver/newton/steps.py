"""The parts of a Newton cycle that know nothing of the matrix: passes over the edges, in kernels.

The formulas stand in the docstring of `sfm_shapefit.solver.newton`. Residuals and dual are kept in d - 1
coordinates across v_e: with an orthonormal basis B_e of these, r_e = B_e^T (t_i - t_j), and B_e y_e is the
dual of the program.

What makes a NamedTuple of a kernel's result runs Python inside native code. An interrupt that came while the
kernel ran would be raised there, and end the process by a segmentation fault: kernels return the scalars of
`NewtonProgress` as a plain tuple, of which `NewtonProgress(*...)` makes it again.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import FloatArray, frozen
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.program import scale_functional
from sfm_shapefit.solver.solver_options import IterationInfo, OnIteration, asks_to_stop

# The smoothing relative to the gap; 0.05 to 0.3 need the same number of factorizations.
MU_PER_GAP = 0.1
_CLIPS_BELOW = 0.5  # share of the gap; a cycle that leaves more is the last one with a clipped dual
STEPS_PER_FACTOR = 10  # steps, a bound; a cycle ends once a new factor gains more than another step
# The least smoothing of S, not of the target: below it M is too ill-conditioned for refinement to converge.
LEAST_MU = 1e-8
REFINEMENTS = 3  # refinements of a step; they converge unless M is too ill-conditioned
STALL = 6  # factorizations without progress; more will not help
# A step passes over one edge, and over one entry of the factor, in the time of so many operations of a
# factorization: memory decides there, not arithmetic.
EDGE_WORK, SOLVE_WORK = 500.0, 5.0

# The allowed violation of D^T y = lambda c, per mean degree: per squared gap, and in any case.
_EQUALITY, _LEAST_EQUALITY = 1e-3, 5e-13
_TO_BOUNDARY = 0.99  # share of the way to the surface of the ball; a dual moves so far at most
_MARGIN = 0.01  # share of its excess by which a scaled dual stays inside the ball; see above
_HALVINGS = 20  # halvings of a step; a shorter one does not move double precision
_CANCEL = 1e-12  # c relative to the sum of weights; a smaller one is rounding


class Problem(NamedTuple):
    """The data, as the kernels take them."""

    edges: npt.NDArray[np.uint32]
    """(m, 2); unsigned, for an index that cannot be negative costs less."""
    v: FloatArray
    basis: FloatArray
    """(m, d, d - 1) orthonormal columns B_e, orthogonal to v_e."""
    tilt: FloatArray
    """(m,) 1 / (1 + |v_e0|), with the sign of v_e0: what a product with B_e needs besides v_e."""
    w: FloatArray
    c: FloatArray
    kappa: float
    axes: tuple[int, ...]
    """(0, ..., d - 1); its length tells the compiler the dimension, so that it unrolls the loops over it."""
    transverse: tuple[int, ...]
    """(0, ..., d - 2), for loops over the coordinates across v."""


class Iterate(NamedTuple):
    """Where the solver stands; every step overwrites it."""

    t: FloatArray
    """(n, d) locations, <c, T> = kappa."""
    y: FloatArray
    """(m, d - 1) dual in its balls, at which M is taken: the last y+ clipped, or the feasible one."""
    r: FloatArray
    """(m, d - 1) residuals B_e^T (t_i - t_j)."""
    feasible: FloatArray
    """(m, d - 1) the dual of the best bound so far; it fulfils the equality too."""


class Linearization(NamedTuple):
    """The linearization: S_e, 1 / rho_e, and a = M^-1 c."""

    s: FloatArray
    """(m, d - 1, d - 1), B_e^T S_e B_e."""
    inverse: FloatArray
    """(m,)"""
    a: FloatArray
    """(n, d)"""


class Step(NamedTuple):
    """A proposed step, and scratch."""

    t: FloatArray
    """(n, d), dT."""
    r: FloatArray
    """(m, d - 1), B^T D dT."""
    y: FloatArray
    """(m, d - 1), g and then y+."""
    nodes: FloatArray
    """(n, d) right-hand side, then solution."""
    addend: FloatArray
    """(n, d), what `extend_step` adds to dT."""
    change: FloatArray
    """(m, d - 1) scratch."""
    ratios: FloatArray
    """(m,) scratch."""
    rho: FloatArray
    """(m,) at the point where the step begins."""


class NewtonProgress(NamedTuple):
    """The scalars of the iteration."""

    mu: float
    multiplier: float
    """lambda of the feasible dual."""
    objective: float
    """R(T) / kappa."""
    gap: float
    """sum_e (w_e ||r_e|| - <y_e, r_e>) / kappa, y feasible: every term is positive, so it does not cancel."""
    clips: bool
    """Whether the next steps go on from the clipped dual."""


Scalars = tuple[float, float, float, float, bool]
"""The fields of `NewtonProgress`."""


class Work(NamedTuple):
    """The problem as arrays, and room for the iteration."""

    problem: Problem
    iterate: Iterate
    linearization: Linearization
    step: Step


def working_dimension(graph: ViewGraph) -> int:
    """Return the dimension that a graph is solved in: a plane one in space, whose kernels are there already.

    No step leaves the plane: third coordinates have equations of their own, whose right-hand sides are 0.
    """
    return max(graph.dimension, 3)


def padded(x: FloatArray, dimension: int) -> FloatArray:
    """Return vectors, one a row, with coordinates of 0 after their own."""
    missing = dimension - x.shape[1]
    return np.pad(x, ((0, 0), (0, missing))) if missing else x


def allocate(graph: ViewGraph, d: int) -> Work:
    """Return the problem as arrays in d dimensions, and room for the iteration.

    UnsolvableError if c is 0 up to rounding.
    """
    n, m = graph.num_nodes, graph.num_edges

    def at_nodes() -> FloatArray:
        return np.empty((n, d))

    def at_edges() -> FloatArray:
        return np.empty((m, d - 1))

    v, w = frozen(padded(graph.directions, d)), graph.weights
    basis, tilt = np.empty((m, d, d - 1)), np.empty(m)
    linearization = Linearization(np.empty((m, d - 1, d - 1)), np.ones(m), at_nodes())
    set_up(v, w, basis, tilt, linearization.s)
    edges, c, kappa = graph.edges.astype(np.uint32), padded(scale_functional(graph), d), float(w.sum())
    axes = range(d)
    problem = Problem(edges, v, basis, tilt, w, c, kappa, tuple(axes), tuple(axes[:-1]))
    if not np.linalg.norm(problem.c) > _CANCEL * problem.kappa:
        raise UnsolvableError("the directions cancel at every camera, so no scale can be fixed")
    step = Step(
        at_nodes(), at_edges(), at_edges(), at_nodes(), at_nodes(), at_edges(), np.empty(m), np.empty(m)
    )
    return Work(problem, Iterate(at_nodes(), at_edges(), at_edges(), at_edges()), linearization, step)


def is_cancelled(on_iteration: OnIteration | None, iteration: int, progress: NewtonProgress) -> bool:
    """Tell the callback where the solver stands; return whether it asks to stop."""
    bound = progress.objective - progress.gap
    return asks_to_stop(on_iteration, IterationInfo(iteration, progress.objective, bound))


@kernel
def set_up(v: Any, w: Any, basis: Any, tilt: Any, s: Any) -> None:
    """Write the bases B_e, by reflections of v_e to the first axis, and S_e = w_e: M is the Laplacian."""
    for e in range(len(v)):
        sign = np.copysign(1.0, v[e, 0])
        inverse = 1.0 / (1.0 + abs(v[e, 0]))
        tilt[e] = sign * inverse
        for q in range(v.shape[1] - 1):
            basis[e, 0, q] = -sign * v[e, q + 1]
            for k in range(1, v.shape[1]):
                unit = 1.0 if k == q + 1 else 0.0
                basis[e, k, q] = unit - inverse * v[e, k] * v[e, q + 1]
                s[e, k - 1, q] = unit * w[e]


@kernel
def start_from(problem: Any, a: Any, iterate: Any) -> bool:
    """Start from the least-squares locations along `a`, whose scaled residuals are a feasible dual."""
    if not dot(problem.c, a) > 0.0:
        return False
    scale_to(problem, a, iterate.t)
    set_residuals(problem, iterate.t, iterate.r)
    worst = 0.0
    for e in range(len(problem.w)):
        rr = 0.0
        for k in range(len(problem.transverse)):
            rr += iterate.r[e, k] ** 2
        worst = max(worst, np.sqrt(rr))
    for e in range(len(problem.w)):
        scale = problem.w[e] / worst if worst > 0.0 else 0.0
        for k in range(len(problem.transverse)):
            iterate.y[e, k] = iterate.feasible[e, k] = scale * iterate.r[e, k]
    return True


def answer(
    problem: Problem, iterate: Iterate, progress: NewtonProgress, tol: float, dimension: int
) -> tuple[FloatArray, FloatArray]:
    """Return locations and dual of a graph; at an objective of 0, up to the tolerance, y = 0 proves it."""
    if progress.objective <= tol:
        iterate.feasible[:] = 0.0
    dual = np.einsum("ekq,eq->ek", problem.basis, iterate.feasible)
    return np.ascontiguousarray(iterate.t[:, :dimension]), np.ascontiguousarray(dual[:, :dimension])


@kernel
def measure_gap(problem: Any, iterate: Any) -> Scalars:
    """Return the scalars at the iterate, before any smoothing."""
    objective = bound = 0.0
    for e in range(len(problem.w)):
        rr = yr = 0.0
        for k in range(len(problem.transverse)):
            rr += iterate.r[e, k] * iterate.r[e, k]
            yr += iterate.r[e, k] * iterate.feasible[e, k]
        objective += problem.w[e] * np.sqrt(rr)
        bound += yr
    kappa = problem.kappa
    return 1.0, bound / kappa, objective / kappa, (objective - bound) / kappa, True


@kernel
def smoothing(progress: Any, mu: float) -> float:
    """Return mu for the next step: it shrinks with the gap, with a clipped dual a little faster."""
    share = 1.0
    if progress.clips and progress.gap < progress.objective:
        share = np.sqrt(progress.gap / progress.objective)
    return float(min(mu, MU_PER_GAP * share * progress.gap))


@kernel
def close_cycle(iterate: Any, progress: Any, mu: float, first: float) -> Scalars:
    """Return the scalars after a cycle that began with the gap `first`; clipping ends if it gained little."""
    clips = progress.clips and progress.gap <= _CLIPS_BELOW * first
    if progress.clips and not clips:
        start_again(iterate)
        mu = MU_PER_GAP * progress.gap
    return mu, progress.multiplier, progress.objective, progress.gap, clips


@kernel
def pays(first: float, previous: float, gap: float, work: float, step_work: float) -> bool:
    """Return whether the last step gained at least as much per unit of work as the cycle did on average."""
    return bool(np.log(previous / gap) * work >= np.log(first / gap) * step_work)


@kernel
def allowed_violation(problem: Any, gap: float) -> float:
    """Return how far D^T y+ may be from lambda+ c at a camera.

    By the square of the gap, for the last step may begin at 1e-5, and its dual should need no repair.
    """
    return float(max(_EQUALITY * gap * gap, _LEAST_EQUALITY) * problem.kappa / len(problem.c))


@kernel
def linearize_program(problem: Any, iterate: Any, mu: float, linearization: Any) -> None:
    """Take S at the iterate."""
    y, r = iterate.y, iterate.r
    floor = max(mu, LEAST_MU)
    for e in range(len(problem.w)):
        rr = floor * floor
        for k in range(len(problem.transverse)):
            rr += r[e, k] * r[e, k]
        linearization.inverse[e] = 1.0 / np.sqrt(rr)
    for e in range(len(problem.w)):
        inverse = linearization.inverse[e]
        for k in range(len(problem.transverse)):
            for q in range(len(problem.transverse)):
                bend = 0.5 * inverse * (y[e, k] * r[e, q] + r[e, k] * y[e, q])
                linearization.s[e, k, q] = inverse * ((problem.w[e] if k == q else 0.0) - bend)


@kernel
def set_gradient(problem: Any, iterate: Any, linearization: Any, mu: float, step: Any) -> None:
    """Begin a step: dT = 0, y+ = g with g_e = y_e - (rho_e y_e - w_e r_e) / rho'_e, nodes = D^T g."""
    y, r = iterate.y, iterate.r
    step.t[:] = 0.0
    for e in range(len(problem.w)):
        rr = mu * mu
        for k in range(len(problem.transverse)):
            rr += r[e, k] * r[e, k]
            step.r[e, k] = 0.0
        rho, inverse = np.sqrt(rr), linearization.inverse[e]
        keep, pull = 1.0 - rho * inverse, problem.w[e] * inverse
        step.rho[e] = rho
        for k in range(len(problem.transverse)):
            step.y[e, k] = keep * y[e, k] + pull * r[e, k]
    sum_at_nodes(problem, step)


@kernel
def extend_step(problem: Any, linearization: Any, step: Any) -> None:
    """Add the addend dt to the step: dT += dt, y+_e += S_e P_e (dt_i - dt_j), nodes = D^T y+.

    A refinement adds its small dt to the dual that is there: y+ from the whole dT would carry the
    rounding of dT, multiplied by a stiffness of the order 1 / mu.
    """
    change = step.change
    combine(1.0, step.t, 1.0, step.addend, step.t)
    set_residuals(problem, step.addend, change)
    for e in range(len(problem.w)):
        for k in range(len(problem.transverse)):
            step.r[e, k] += change[e, k]
            x = step.y[e, k]
            for q in range(len(problem.transverse)):
                x += linearization.s[e, k, q] * change[e, q]
            step.y[e, k] = x
    sum_at_nodes(problem, step)


@inner_kernel
def sum_at_nodes(problem: Any, step: Any) -> None:
    """nodes = D^T B y+, by the reflections as in `set_residuals`."""
    edges, v, tilt, y, nodes = problem.edges, problem.v, problem.tilt, step.y, step.nodes
    nodes[:] = 0.0
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        along = 0.0
        for q in range(len(problem.transverse)):
            along += v[e, q + 1] * y[e, q]
        along = np.copysign(along, along * tilt[e])
        nodes[i, 0] -= along
        nodes[j, 0] += along
        along *= tilt[e]
        for q in range(len(problem.transverse)):
            x = y[e, q] - along * v[e, q + 1]
            nodes[i, q + 1] += x
            nodes[j, q + 1] -= x


@kernel
def set_residuals(problem: Any, t: Any, r: Any) -> None:
    """r_e = B_e^T (t_i - t_j), from v_e itself: reading B_e takes longer than to reflect."""
    edges, v, tilt = problem.edges, problem.v, problem.tilt
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        along = 0.0
        for k in range(1, len(problem.axes)):
            along += v[e, k] * (t[i, k] - t[j, k])
        along = tilt[e] * along + (t[i, 0] - t[j, 0])
        along = np.copysign(along, along * tilt[e])
        for q in range(len(problem.transverse)):
            r[e, q] = (t[i, q + 1] - t[j, q + 1]) - along * v[e, q + 1]


@kernel
def take_step(problem: Any, iterate: Any, step: Any, mu: float, progress: Any, target: float) -> Scalars:
    """Move along the step as far as it helps; return the scalars there."""
    alpha, multiplier = 1.0, progress.multiplier
    while alpha > 0.0 and increase(problem, iterate, step, mu, alpha) > 0.0:
        alpha = 0.5 * alpha if alpha > 0.5**_HALVINGS else 0.0
    excess = np.sqrt(largest_dual(problem, step))
    scale = 1.0 / (excess * (1.0 + _MARGIN * (excess - 1.0))) if excess > 1.0 else 1.0
    keep, gain, reached = 0.0, scale, scale * target
    if excess > 1.0 and (reached <= multiplier or not progress.clips):
        beta = min(1.0, _TO_BOUNDARY / speed_of_exit(problem, iterate, step))
        if multiplier + beta * (target - multiplier) > reached:
            keep, gain, reached = 1.0 - beta, beta, multiplier + beta * (target - multiplier)
    if progress.clips and reached <= multiplier:
        keep, gain, reached = 1.0, 0.0, multiplier
    objective, bound = move_along(problem, iterate, step, alpha, keep, gain)
    if not progress.clips:
        start_again(iterate)
    return mu, reached, objective / problem.kappa, (objective - bound) / problem.kappa, progress.clips


@inner_kernel
def increase(problem: Any, iterate: Any, step: Any, mu: float, alpha: float) -> float:
    """Return the change of sum_e w_e rho_e from r to r + alpha dr, without cancellation."""
    r, dr = iterate.r, step.r
    for e in range(len(problem.w)):
        rd = dd = 0.0
        for k in range(len(problem.transverse)):
            rd += r[e, k] * dr[e, k]
            dd += dr[e, k] * dr[e, k]
        change = alpha * (2.0 * rd + alpha * dd)
        then = max(step.rho[e] * step.rho[e] + change, mu * mu)
        step.ratios[e] = problem.w[e] * change / (step.rho[e] + np.sqrt(then))
    return add_up(step.ratios)


@inner_kernel
def largest_dual(problem: Any, step: Any) -> float:
    """Return max_e ||y+_e||^2 / w_e^2, and leave the ratios in the scratch."""
    for e in range(len(problem.w)):
        pp = 0.0
        for k in range(len(problem.transverse)):
            pp += step.y[e, k] * step.y[e, k]
        step.ratios[e] = pp / (problem.w[e] * problem.w[e])
    return largest(step.ratios)


@inner_kernel
def speed_of_exit(problem: Any, iterate: Any, step: Any) -> float:
    """Return 1 / the longest step from the feasible dual to y+ in the ball, given `largest_dual`'s ratios."""
    ratios = step.ratios
    for e in range(len(problem.w)):
        dd = yd = yy = 0.0
        for k in range(len(problem.transverse)):
            y, towards = iterate.feasible[e, k], step.y[e, k] - iterate.feasible[e, k]
            dd += towards * towards
            yd += towards * y
            yy += y * y
        room = max(problem.w[e] * problem.w[e] - yy, 0.0)
        root = np.sqrt(yd * yd + dd * room)
        speed = (yd + root if yd > 0.0 else dd) / (room if yd > 0.0 else root - yd)
        ratios[e] = speed if ratios[e] > 1.0 else 0.0
    return largest(ratios)


@inner_kernel
def largest(x: Any) -> float:
    """Return the largest of non-negative numbers; by four maxima, for one would be a chain of waits."""
    a = b = c = d = 0.0
    whole = len(x) // 4 * 4
    for e in range(0, whole, 4):
        a = max(a, x[e])
        b = max(b, x[e + 1])
        c = max(c, x[e + 2])
        d = max(d, x[e + 3])
    for e in range(whole, len(x)):
        a = max(a, x[e])
    return max(a, b, c, d)


@inner_kernel
def add_up(x: Any) -> float:
    """Return the sum of an array; by four sums, as in `largest`."""
    a = b = c = d = 0.0
    whole = len(x) // 4 * 4
    for e in range(0, whole, 4):
        a += x[e]
        b += x[e + 1]
        c += x[e + 2]
        d += x[e + 3]
    for e in range(whole, len(x)):
        a += x[e]
    return (a + b) + (c + d)


@inner_kernel
def move_along(
    problem: Any, iterate: Any, step: Any, alpha: float, keep: float, gain: float
) -> tuple[float, float]:
    """T += alpha dT, r += alpha dr, y = y+ clipped to its balls, feasible = keep feasible + gain y+.

    Returns sum_e w_e ||r_e|| and sum_e <y_e, r_e> with the feasible y.
    """
    combine(1.0, iterate.t, alpha, step.t, iterate.t)
    for e in range(len(problem.w)):
        rr = yr = pp = 0.0
        for k in range(len(problem.transverse)):
            r, towards = iterate.r[e, k] + alpha * step.r[e, k], step.y[e, k]
            y = keep * iterate.feasible[e, k] + gain * towards
            iterate.r[e, k] = r
            iterate.feasible[e, k] = y
            rr += r * r
            yr += y * r
            pp += towards * towards
        inside = problem.w[e] / max(np.sqrt(pp), problem.w[e])
        for k in range(len(problem.transverse)):
            iterate.y[e, k] = inside * step.y[e, k]
        step.ratios[e] = problem.w[e] * np.sqrt(rr)
        step.rho[e] = yr
    return add_up(step.ratios), add_up(step.rho)


@kernel
def dot(x: Any, y: Any) -> float:
    """Return the inner product of two (n, d) arrays."""
    total = 0.0
    for i in range(x.shape[0]):
        for k in range(x.shape[1]):
            total += x[i, k] * y[i, k]
    return total


@inner_kernel
def combine(a: float, x: Any, b: float, y: Any, out: Any) -> None:
    """out = a x + b y, for (n, d) arrays."""
    for i in range(x.shape[0]):
        for k in range(x.shape[1]):
            out[i, k] = a * x[i, k] + b * y[i, k]


@inner_kernel
def scale_to(problem: Any, a: Any, t: Any) -> None:
    """t = a, scaled so that <c, T> = kappa."""
    scale = problem.kappa / dot(problem.c, a)
    for i in range(len(a)):
        for k in range(len(problem.axes)):
            t[i, k] = scale * a[i, k]


@inner_kernel
def is_within(x: Any, bound: float) -> bool:
    """Return whether no entry of an (n, d) array exceeds the bound in size; false if one is not a number."""
    for i in range(x.shape[0]):
        for k in range(x.shape[1]):
            if not abs(x[i, k]) <= bound:
                return False
    return True


@inner_kernel
def start_again(iterate: Any) -> None:
    """y = feasible."""
    for e in range(len(iterate.y)):
        for k in range(iterate.y.shape[1]):
            iterate.y[e, k] = iterate.feasible[e, k]
