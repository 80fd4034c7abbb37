"""Any iterate to a rigorous bound: how far locations can be from the optimum of the ShapeFit program.

An approximate dual y is made feasible in two steps. It is moved by the smallest transverse change, in a
metric of its own for every edge, that restores D^T y = lambda c,

    y' = y - S D h,    (D^T S D) h = D^T y - lambda c,    lambda = <y, D T> / <c, T>,

and divided by max(1, max_e ||y'_e|| / w_e), which keeps the equality since both constraints are homogeneous.
Then no locations have an objective below lambda / max(...). The choice of lambda makes the right-hand side
orthogonal to T, the one direction in which D^T S D is nearly singular when the data are nearly exact.

The division is what costs: one pair that is moved out of its ball by 1 % lowers the bound by 1 %. So

- *The metric* S_e = H_e (P_e - 0.97 u_e u_e^T) moves a pair that is on the surface of its ball, in direction
  u_e, mostly along the surface, and hardly at all where its residual is long: H_e = w_e / max(||r_e||, r).
  That is the Hessian of w ||r|| tamed so far that the scalar Laplacian of the weights H remains a good
  preconditioner. It asks nothing of the solver: r_e are the residuals of the given locations.
- *Rounds.* What leaves its ball is clipped, and the equality is restored again, a few times, by crude solves;
  one to rounding comes last. From a dual of the splitting the bound is then 100 to 1000 times closer than
  from one repair with S = P.

The systems are solved by conjugate gradients with that Laplacian, factored or, where it would fill in,
factored approximately, as preconditioner. A dual that satisfies the equality already, as that of a Newton
method does, is taken as it is.

Uniqueness. An optimal T' has w_e ||r'_e|| = <y_e, r'_e> for every pair and every optimal dual: r'_e = 0
where ||y_e|| < w_e, and r'_e points along y_e where ||y_e|| = w_e. If translations and T are all that
satisfies these linear conditions, there is no other optimum. (It suffices, but is not needed, that the
pairs with ||y_e|| < w_e are parallel rigid.) The conditions are the null space of a Laplacian with blocks

    w_e P_e  where ||y_e|| < (1 - margin) w_e,      w_e (P_e - y_e y_e^T / ||y_e||^2)  elsewhere,

and w_e v_e v_e^T is added for one pair, which excludes T: then Cholesky tells whether it is regular.

Groups. Where t = A x places rigid groups (`solver.reduction`), the infimum of the Lagrangian is over x, and
A^T D^T y = lambda A^T c takes the place of the equality: the balance at every camera summed over its group,
and one equation for the scale of each unit. All else stays, with A^T D^T S D A in place of D^T S D. Fewer
locations are admitted than without groups, so the bound is at least as high. A pair inside a group says
nothing of x; it would only shift the objective by a multiple of s. Such pairs take no part, and have dual 0.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, frozen
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.jit import array_address, kernel
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.approximate import Preconditioner, conjugate_gradients
from sfm_shapefit.laplacian.dense import blas_of, potrf
from sfm_shapefit.laplacian.factor import allocate_factor, analyze
from sfm_shapefit.laplacian.operators import Workers
from sfm_shapefit.solver.factor_choice import prefers_dense_factor
from sfm_shapefit.solver.program import adjoint, along, differences, objective
from sfm_shapefit.solver.reduction import Reduction
from sfm_shapefit.solver.splitting.linear import Resources, laplacian_factor, preconditioner

# Rounds of clipping: three do mostly, but on loose communities the sixth still gained half of the gap.
_ROUNDS = 8
# A round shrinks the equality residual to this share; exact solves would gain no round.
_ROUND_REDUCTION = 0.1
# Share of the gap; the rounds end when the excess costs less. The second share holds where the gap misses the
# tolerance whatever the rounds do.
_NEGLIGIBLE, _NEGLIGIBLE_MISSED = 0.03, 0.3
# Least residual that the metric takes seriously, relative to the mean one; exact pairs have none.
_RESIDUAL_FLOOR = 0.1
_ALONG_SURFACE = 0.97  # share of the metric across the surface of a ball that is taken away; see above
_ON_SURFACE = 0.99  # ||y_e|| / w_e; from here on a pair counts as on the surface of its ball
_REPAIRS = 4  # repairs; each shrinks the equality residual to the rounding of the previous one
_CG_STEPS = 500  # conjugate gradient steps; 10 to 60 are needed on all but long chains
_LARGE, _EDGE_BLOCKS = 200_000, 4  # pairs, and blocks; passes over more pairs run in parallel blocks
_EXACT_PER_GAP = 1e-5  # equality residual per gap; it needs no repair, for the bound moves by 100 times it
_LEAST_EXACT, _LARGEST_EXACT = 1e-12, 5e-10  # limits of that residual; rounding, and what a bound may rest on
# The rounds end where the gap is expected below this share of the one asked for. The exact repair is expected
# to multiply the present excess by the second number: by 4 on boxes, by 1 to 2 on communities.
_ENOUGH, _EXCESS_GROWTH = 0.8, 5.0
_UNREPAIRED = 1e-9  # equality residual relative to the largest degree; no bound may rest on a larger one
# Relative distance of ||y_e|| from w_e; a pair that is farther inside its ball counts as held by its fit.
_STRICT = 1e-3
_REGULAR = 1e-9  # least pivot of a regular matrix, relative to its diagonal entry; far above rounding
_REGULAR_SINGLE = 1e-3  # likewise in single precision; far above the rounding of the factor, n d eps
_SINGLE_FROM = 450  # unknowns; from here on a float32 factor is tried first, which is faster
# Pairs and operations; beyond, uniqueness is not examined: the ordering of more pairs alone takes seconds.
_UNIQUENESS_EDGES, _UNIQUENESS_FLOPS = 500_000, 1e11
_OFF_GROUPS = 1e-9  # share of the extent; locations off their rigid groups by less are off by rounding


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Certificate:
    """A feasible dual point and what it proves about locations."""

    objective: float
    """R(T) / L(T) at the locations."""
    dual_bound: float
    """No locations have an objective below this."""
    dual: FloatArray
    """(m, d) the feasible dual point that proves it."""
    equality_residual: float
    """Largest violation of D^T y = dual_bound * c at a camera, relative to the largest weighted degree; with
    groups, of A^T D^T y at a group, or in the equation for a scale with offsets of root mean square 1."""
    unique: bool | None = None
    """True: the dual proves that no other locations are optimal (up to translation and scale, and up to
    the gap). False: it does not prove that. None: not examined."""

    @property
    def gap(self) -> float:
        """How far the objective may be above the optimum."""
        return self.objective - self.dual_bound


def certify(
    graph: ViewGraph,
    locations: FloatArray,
    dual: FloatArray,
    *,
    groups: RigidGroups | None = None,
    tol: float = 0.0,
    uniqueness: bool = False,
) -> Certificate:
    """Return the bound that `dual`, made feasible, proves for `locations`. It trusts no solver.

    Args:
        graph: a connected view graph.
        locations: (n, d) camera centers, in any scale, with L(T) > 0; with groups, those of rigid groups.
        dual: (m, d) approximate dual; any finite array gives a valid, perhaps useless, bound.
        groups: groups of the nodes, if they do not move one by one.
        tol: a gap that is small enough: where a better bound takes time, none is looked for. 0: the best one.
        uniqueness: also examine whether the optimum is unique; costs one sparse factorization.

    Raises:
        InputError: if an array has the wrong shape, is not finite, or the locations have L(T) <= 0, or
            are not those of the groups.
        UnsolvableError: if the dual must be repaired and the graph or its groups are not connected.
    """
    return certify_as_asked(graph, locations, dual, groups, Asked(tol, uniqueness))


class Asked(NamedTuple):
    """What a certificate is to say; see `certify`."""

    tol: float
    uniqueness: bool
    threads: int = 1
    """They share the work; the certificate does not depend on them."""


@one_blas_thread()  # more would round the sums over all cameras differently
def certify_as_asked(
    graph: ViewGraph, locations: FloatArray, dual: FloatArray, groups: RigidGroups | None, asked: Asked
) -> Certificate:
    """Return what `certify` does, by several threads."""
    _refuse_arrays(graph, locations, dual)
    y = np.array(dual, dtype=np.float64, order="C")
    if groups is None:
        return _certify(graph, locations, y, None, asked)
    outer = groups.joins(graph.edges)
    _refuse_groups(groups, locations, outer)
    between, every = graph.subset(outer), np.zeros_like(y)
    reduction = Reduction.over(between.edges, groups.normalize())
    found = _certify(between, locations, y[outer], reduction, asked)
    every[outer] = found.dual
    return replace(found, dual=frozen(every))


def _certify(
    graph: ViewGraph, locations: FloatArray, y: FloatArray, reduction: Reduction | None, asked: Asked
) -> Certificate:
    """Return the certificate of y, made feasible in place, for locations of nodes, or of a reduction."""
    resources = Resources(asked.threads, factor=reduction)
    found = certify_in_place(graph, locations, y, asked.tol, np.inf, resources)
    assert found is not None, "no gap is above infinity"
    if not asked.uniqueness:
        return found
    t = locations - locations.mean(axis=0)
    return replace(found, unique=_is_unique(graph, t, found.dual, resources))


def _refuse_arrays(graph: ViewGraph, locations: FloatArray, dual: FloatArray) -> None:
    shapes = (graph.num_nodes, graph.dimension), graph.directions.shape
    if locations.shape != shapes[0] or dual.shape != shapes[1]:
        raise InputError(
            f"locations and dual have shapes {locations.shape} and {dual.shape}; this graph needs "
            f"{shapes[0]} and {shapes[1]}"
        )
    if not (np.isfinite(locations).all() and np.isfinite(dual).all()):
        raise InputError("locations and dual must be finite to be certified")


def _refuse_groups(groups: RigidGroups, locations: FloatArray, outer: BoolArray) -> None:
    """Raise InputError for groups that the locations (n, d) do not have, or that no pair joins."""
    if groups.offsets.shape != locations.shape:
        raise InputError(f"offsets have shapes {groups.offsets.shape}, and locations {locations.shape}")
    if not outer.any():
        raise InputError("no pair joins two groups, so there is nothing to certify")
    apart = groups.fit(locations)[1]
    if apart > _OFF_GROUPS * float(np.abs(locations).max()):
        raise InputError(f"the locations are not those of rigid groups: a node is {apart:.1e} off its group")


@one_blas_thread()
def certify_in_place(
    graph: ViewGraph, locations: FloatArray, y: FloatArray, tol: float, hopeless: float, resources: Resources
) -> Certificate | None:
    """Return what `certify` does, with y itself made feasible; None if the gap is above `hopeless`.

    A factor among the resources is a preconditioner, and cannot make the bound wrong; a `Reduction` says over
    which unknowns it is, and each pair then joins two of its groups. A hopeless gap shows early: on loosely
    joined communities, where a proof takes as long as hundreds of iterations of a solver, that saves more
    than half of it.
    """
    t = np.ascontiguousarray(locations - locations.mean(axis=0))
    value = objective(graph, t)
    if not value < np.inf:
        raise InputError("the locations point against the directions (L(T) <= 0); negate them or solve again")
    n, d, w = graph.num_nodes, graph.dimension, graph.weights
    c, total, degrees = np.zeros((n, d)), np.zeros((n, d)), np.zeros(n)
    worst = _project(graph.edges, graph.directions, w, y, c, total, degrees)
    x, groups = t, resources.factor.groups if isinstance(resources.factor, Reduction) else None
    if groups is not None:
        x, c, total = groups.fit(t)[0], groups.reduce(c), groups.reduce(total)
        degrees = np.asarray(np.bincount(groups.group_of, degrees))
    degree = float(degrees.max())
    multiplier = _multiplier(total, c, x)
    if _unbalanced(total, c, multiplier) > degree * _exact(value - multiplier / max(1.0, worst)):
        repair = _repair(graph, t, y, resources)
        gap = _clip_in_rounds(repair, c, x, value, tol, hopeless)
        if gap > hopeless:
            return None
        allowed = 0.5 * _exact(gap) if tol > 0.0 else _LEAST_EXACT
        worst = _restore_exactly(repair, c, x, degree * allowed)
        total = repair.total()
    scale = 1.0 / max(1.0, worst)
    if scale < 1.0:
        with np.errstate(invalid="ignore"):  # sums that overflowed prove nothing below
            y *= scale
            total *= scale
    bound = float(np.vdot(total, c) / np.vdot(c, c))
    violation = _unbalanced(total, c, bound)
    # y = 0 is feasible and proves at least 0; a dual that could not be repaired proves nothing.
    if not (bound > 0.0 and violation <= _UNREPAIRED * degree):
        y, bound, violation = np.zeros_like(y), 0.0, 0.0
    if not value - bound <= hopeless:
        return None
    return Certificate(
        objective=value, dual_bound=bound, dual=frozen(y), equality_residual=violation / degree
    )


def _multiplier(total: FloatArray, c: FloatArray, x: FloatArray) -> float:
    """Return lambda = <y, D A x> / <A^T c, x> from total = A^T D^T y, c being reduced too."""
    return float(np.vdot(total, x) / np.vdot(c, x))


@kernel
def _unbalanced(total: Any, c: Any, multiplier: float) -> float:
    """Return the largest norm of a row of total - multiplier c: the violation at a camera."""
    worst = 0.0
    for i in range(len(c)):
        square = 0.0
        for k in range(c.shape[1]):
            square += (total[i, k] - multiplier * c[i, k]) ** 2
        if not square < np.inf:  # also NaN, which a maximum may lose: nothing may be proved by it
            return np.inf
        worst = max(worst, square)
    return float(np.sqrt(worst))


def _exact(gap: float) -> float:
    """Return the equality residual that does not count beside a gap, per largest weighted degree."""
    return min(max(_EXACT_PER_GAP * gap, _LEAST_EXACT), _LARGEST_EXACT)


class _Metric(NamedTuple):
    """The change of the dual that a repair makes, S D h, as the kernels take it."""

    edges: IntArray
    v: FloatArray
    w: FloatArray
    stiffness: npt.NDArray[np.float32]
    """(m,) H_e; single precision saves memory, and the bound does not rest on a metric."""
    y: FloatArray
    """(m, d) the dual that is repaired, in place."""
    normal: npt.NDArray[np.float32]
    """(m,) sqrt(_ALONG_SURFACE) / ||y_e|| on the surface of a ball, else 0: what makes u_e of y_e."""
    axes: tuple[int, ...]
    """(0, ..., d - 1); its length tells the compiler the dimension, so that it unrolls the loops over it."""


class _Repair(NamedTuple):
    """A metric, the preconditioner of its Laplacian, and what the products with it need."""

    metric: _Metric
    precondition: Preconditioner
    workers: Workers
    parts: FloatArray
    """(blocks, n, d) scratch: the sums of each block of pairs."""
    groups: RigidGroups | None

    def product(self, x: FloatArray) -> FloatArray:
        """Return A^T D^T S D A x; the blocks, and so the sums, are the same for any number of threads."""
        blocks, t = len(self.parts), x if self.groups is None else self.groups.expand(x)
        cuts = [len(self.metric.w) * k // blocks for k in range(blocks + 1)]

        def job(k: int) -> Callable[[], object]:
            return lambda: _apply(self.metric, cuts[k], cuts[k + 1], t, self.parts[k])

        self.workers.run([job(k) for k in range(blocks)])
        return self.reduce(np.asarray(self.parts.sum(axis=0)))

    def reduce(self, g: FloatArray) -> FloatArray:
        """Return A^T g, for g (n, d)."""
        return g if self.groups is None else self.groups.reduce(g)

    def total(self) -> FloatArray:
        """Return A^T D^T y."""
        return self.reduce(adjoint(self.metric.y, self.metric.edges, self.parts.shape[1]))


def _repair(graph: ViewGraph, t: FloatArray, y: FloatArray, resources: Resources) -> _Repair:
    """Return the metric of the residuals at t, with no pair on the surface of its ball so far."""
    edges, v = np.ascontiguousarray(graph.edges), np.ascontiguousarray(graph.directions)
    stiffness = _stiffness(graph, t).astype(np.float32)
    normal, axes = np.zeros(graph.num_edges, np.float32), tuple(range(graph.dimension))
    metric = _Metric(edges, v, graph.weights, stiffness, y, normal, axes)
    blocks = _EDGE_BLOCKS if graph.num_edges >= _LARGE else 1
    precondition, workers = _preconditioner(graph, stiffness, resources), Workers(resources.threads)
    groups = resources.factor.groups if isinstance(resources.factor, Reduction) else None
    return _Repair(metric, precondition, workers, np.empty((blocks, *t.shape)), groups)


def _clip_in_rounds(
    repair: _Repair, c: FloatArray, x: FloatArray, value: float, tol: float, hopeless: float
) -> float:
    """Clip y and restore the equality roughly, in turns; return about the gap that the dual proves.

    The rounds end when the excess costs little of the gap to `value`, the objective at x; somewhat below the
    gap `tol` in any case; and above `hopeless`, for from the second clipping on lambda hardly rises again.
    """
    gap = value
    for k in range(_ROUNDS):
        _clip(repair.metric)
        multiplier, violation = _violation(repair, c, x)
        if k > 0 and value - multiplier > hopeless:
            return value - multiplier
        worst = _restore(repair, violation, _ROUND_REDUCTION)
        multiplier = _violation(repair, c, x)[0]
        gap = value - multiplier / max(1.0, worst)
        expected = value - multiplier / max(1.0, 1.0 + _EXCESS_GROWTH * (worst - 1.0))
        share = _NEGLIGIBLE_MISSED if 0.0 < tol < value - multiplier else _NEGLIGIBLE
        if expected <= _ENOUGH * tol or (worst - 1.0) * multiplier <= share * (value - multiplier):
            break
    return gap


def _restore_exactly(repair: _Repair, c: FloatArray, x: FloatArray, allowed: float) -> float:
    """Move y to D^T y = lambda c up to `allowed` at a camera; return max_e ||y_e|| / w_e.

    The metric is H_e P_e here, with which the conjugate gradients need half of the steps.
    """
    repair.metric.normal[:] = 0.0
    fine = 0.1 * allowed * float(np.sqrt(len(c)))  # no camera is much worse than the mean one
    worst = 1.0
    for _ in range(_REPAIRS):
        violation = _violation(repair, c, x)[1]
        reduction = fine / max(float(np.linalg.norm(violation)), fine)
        worst = _restore(repair, violation, reduction)
        if _unbalanced(_violation(repair, c, x)[1], c, 0.0) <= allowed:
            break
    return worst


def _violation(repair: _Repair, c: FloatArray, x: FloatArray) -> tuple[float, FloatArray]:
    """Return lambda and A^T D^T y - lambda A^T c, in the shape of x; c is reduced."""
    total = repair.total()
    multiplier = _multiplier(total, c, x)
    return multiplier, total - multiplier * c


def _restore(repair: _Repair, violation: FloatArray, tol: float) -> float:
    """Move y by S D h so that `violation` shrinks to `tol` times itself; return max_e ||y_e|| / w_e."""
    product, precondition, tol = repair.product, repair.precondition, min(tol, 0.5)
    count = len(violation) if repair.groups is None else repair.groups.num_groups
    found = conjugate_gradients(
        product, precondition, violation, tol=tol, max_iterations=_CG_STEPS, coupled_nodes=count
    )
    h = found.x if repair.groups is None else repair.groups.expand(found.x)
    return float(_move(repair.metric, h))


def _stiffness(graph: ViewGraph, t: FloatArray) -> FloatArray:
    """Return H_e = w_e / max(||r_e||, floor), in units of the mean residual, (m,)."""
    residuals = np.empty(graph.num_edges)
    _residuals(graph.edges, graph.directions, t, residuals)
    mean = float(np.vdot(graph.weights, residuals) / graph.weights.sum())
    if not mean > 0.0:
        return graph.weights
    np.maximum(residuals, _RESIDUAL_FLOOR * mean, out=residuals)
    np.divide(graph.weights, residuals, out=residuals)  # in place: on large graphs memory is short here
    residuals *= mean
    return residuals


def _preconditioner(graph: ViewGraph, stiffness: npt.NDArray[Any], resources: Resources) -> Preconditioner:
    """Return an approximate inverse of the Laplacian of `stiffness`."""
    if resources.factor is None:  # who has one has looked, and on large graphs the look takes much memory
        components = int(graph.components().max()) + 1
        if components > 1:
            raise UnsolvableError(
                f"the graph falls into {components} connected components; certify each one separately"
            )
    factor = laplacian_factor(graph, resources)
    if not isinstance(factor, Reduction):
        return preconditioner(graph, factor, stiffness)
    try:
        factor.refactor(stiffness)
    except UnsolvableError as error:
        message = "the dual cannot be repaired: the pairs do not determine the groups"
        raise UnsolvableError(message) from error
    return _OverGroups(factor)


class _OverGroups(NamedTuple):
    """A preconditioner of equations for x."""

    reduction: Reduction

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Return the x of a reduced right-hand side."""
        return self.reduction.solve_reduced(rhs)


@kernel
def _residuals(edges: Any, v: Any, t: Any, out: Any) -> None:
    """Write ||r_e||."""
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        s = 0.0
        for k in range(v.shape[1]):
            s += (t[i, k] - t[j, k]) * v[e, k]
        square = 0.0
        for k in range(v.shape[1]):
            square += ((t[i, k] - t[j, k]) - s * v[e, k]) ** 2
        out[e] = np.sqrt(square)


@kernel
def _project(edges: Any, v: Any, w: Any, y: Any, c: Any, total: Any, degrees: Any) -> float:
    """Remove the part of y along v; add D^T (w v), D^T y and the sums of w; return max_e ||y_e|| / w_e."""
    worst = 0.0
    for e in range(len(w)):
        i, j = edges[e, 0], edges[e, 1]
        s = square = 0.0
        for k in range(v.shape[1]):
            s += y[e, k] * v[e, k]
        for k in range(v.shape[1]):
            y[e, k] -= s * v[e, k]
            square += y[e, k] ** 2
            c[i, k] += w[e] * v[e, k]
            c[j, k] -= w[e] * v[e, k]
            total[i, k] += y[e, k]
            total[j, k] -= y[e, k]
        degrees[i] += w[e]
        degrees[j] += w[e]
        worst = max(worst, np.sqrt(square) / w[e])
    return worst


@kernel
def _clip(metric: Any) -> None:
    """Shorten y_e to its ball, and write what makes u_e of it where it is on the surface."""
    w, y = metric.w, metric.y
    share = np.sqrt(_ALONG_SURFACE)
    for e in range(len(w)):
        square = 0.0
        for k in range(len(metric.axes)):
            square += y[e, k] ** 2
        norm = np.sqrt(square)
        keep = w[e] / norm if norm > w[e] else 1.0
        metric.normal[e] = share / (keep * norm) if norm > _ON_SURFACE * w[e] else 0.0
        for k in range(len(metric.axes)):
            y[e, k] *= keep


@kernel
def _apply(metric: Any, first: int, last: int, x: Any, out: Any) -> None:
    """Write D^T S D x of the pairs from `first` to `last` into `out`."""
    edges, v, y, stiffness = metric.edges, metric.v, metric.y, metric.stiffness
    out[:] = 0.0
    for e in range(first, last):
        i, j = edges[e, 0], edges[e, 1]
        s = q = 0.0
        for k in range(len(metric.axes)):
            difference = x[i, k] - x[j, k]
            s += difference * v[e, k]
            q += difference * y[e, k]  # y is orthogonal to v
        q *= metric.normal[e] ** 2
        for k in range(len(metric.axes)):
            z = stiffness[e] * ((x[i, k] - x[j, k]) - s * v[e, k] - q * y[e, k])
            out[i, k] += z
            out[j, k] -= z


@kernel
def _move(metric: Any, h: Any) -> float:
    """Replace y by y - S D h, orthogonal to v to rounding; return max_e ||y_e|| / w_e."""
    edges, v, y, stiffness = metric.edges, metric.v, metric.y, metric.stiffness
    worst = 0.0
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        s = q = yv = square = 0.0
        for k in range(len(metric.axes)):
            difference = h[i, k] - h[j, k]
            s += difference * v[e, k]
            q += difference * y[e, k]
        q *= metric.normal[e] ** 2
        for k in range(len(metric.axes)):
            y[e, k] -= stiffness[e] * ((h[i, k] - h[j, k]) - s * v[e, k] - q * y[e, k])
            yv += y[e, k] * v[e, k]
        for k in range(len(metric.axes)):
            y[e, k] -= yv * v[e, k]
            square += y[e, k] ** 2
        worst = max(worst, np.sqrt(square) / metric.w[e])
    return worst


def _is_unique(graph: ViewGraph, t: FloatArray, y: FloatArray, resources: Resources) -> bool | None:
    """Return whether the feasible dual excludes other optima; None if the factor would be too large."""
    reduction = resources.factor if isinstance(resources.factor, Reduction) else None
    if graph.num_edges > _UNIQUENESS_EDGES:
        return None
    n, d, v = graph.num_nodes, graph.dimension, graph.directions

    def flops() -> float:
        return graph.elimination_tree().flops * d**3

    is_dense = reduction is None and prefers_dense_factor(graph, flops)
    if reduction is None and not is_dense and flops() > _UNIQUENESS_FLOPS:
        return None
    longest = int(np.argmax(along(differences(t, graph.edges), v)))
    blocks = np.empty((graph.num_edges, d, d))
    _set_conditions(v, graph.weights, y, longest, blocks)
    if is_dense:
        return _is_regular_dense(graph, blocks)
    if reduction is None:
        plan = analyze(n, graph.edges, graph.elimination_tree())
        reduction = Reduction(allocate_factor(plan, d, threads=resources.threads))
    try:
        reduction.refactor(blocks)
    except UnsolvableError:
        return False
    return reduction.smallest_pivot > _REGULAR


def _is_regular_dense(graph: ViewGraph, blocks: FloatArray) -> bool:
    """Return whether the Laplacian of the blocks is regular, by a dense factor of it."""
    n, d = graph.num_nodes, graph.dimension
    diagonal = np.zeros((n, d, d))
    for dtype, regular in ((np.float32, _REGULAR_SINGLE), (np.float64, _REGULAR)):
        if n * d >= _SINGLE_FROM or dtype is np.float64:
            matrix = np.zeros((n * d) ** 2, dtype)
            if _least_pivot(graph.edges, blocks, diagonal, matrix, blas_of(dtype)) > regular:
                return True
    return False


@kernel
def _set_conditions(v: Any, w: Any, y: Any, longest: int, blocks: Any) -> None:
    """Write the block of each pair in the matrix whose null space is what the dual leaves open, (m, d, d)."""
    d = v.shape[1]
    for e in range(len(w)):
        square = 0.0
        for k in range(d):
            square += y[e, k] ** 2
        bend = w[e] / square if np.sqrt(square) >= (1.0 - _STRICT) * w[e] else 0.0
        for k in range(d):
            for q in range(d):
                x = w[e] if k == q else 0.0
                blocks[e, k, q] = x - w[e] * v[e, k] * v[e, q] - bend * y[e, k] * y[e, q]
    for k in range(d):
        for q in range(d):
            blocks[longest, k, q] += w[longest] * v[longest, k] * v[longest, q]


@kernel
def _least_pivot(edges: Any, blocks: Any, diagonal: Any, matrix: Any, blas: Any) -> float:
    """Factor the Laplacian of the blocks, its last node grounded; return the least pivot per diagonal entry.

    0 if a pivot is not positive. `matrix` is zero, column-major, and `diagonal` is scratch (n, d, d).
    """
    n, d = diagonal.shape[0], diagonal.shape[1]
    order = n * d
    diagonal[:] = 0.0
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        corner = min(i, j) * d * order + max(i, j) * d
        for k in range(d):
            for q in range(d):
                x = blocks[e, k, q]
                matrix[corner + k * order + q] -= x
                diagonal[i, k, q] += x
                diagonal[j, k, q] += x
    ground = 0.0
    for i in range(n):
        for k in range(d):
            ground += diagonal[i, k, k] / order
    for k in range(d):
        diagonal[n - 1, k, k] += ground
    for i in range(n):
        for k in range(d):
            for q in range(k, d):
                matrix[(i * d + k) * order + i * d + q] = diagonal[i, k, q]
    if potrf(blas, (array_address(matrix), order), order) != 0:
        return 0.0
    least = np.inf
    for i in range(n):
        for k in range(d):
            least = min(least, matrix[(i * d + k) * (order + 1)] ** 2 / diagonal[i, k, k])
    return least
