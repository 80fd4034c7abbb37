"""Large graphs to a proven gap: splitting, then a certificate, then Newton steps only if it must be.

Splitting is cheap but proves nothing; the certificate costs some twenty of its iterations, and the gap proven
is hardly ever above three times the error that the splitting estimates for itself. So the splitting is asked
for a third of the gap, and its answer certified. If that misses, it goes on where it was. Where it stalls, as
on long chains, the sparse Newton solver takes over from the certified point, if its factor fits, and begins
anew where that point was of no use.
"""

import enum
from dataclasses import dataclass, replace

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.factor import LaplacianFactor
from sfm_shapefit.solver.certificate import Certificate, certify_in_place
from sfm_shapefit.solver.newton.sparse import allocate_newton, solve_newton_sparse
from sfm_shapefit.solver.newton.steps import working_dimension
from sfm_shapefit.solver.program import projected_length, scale_functional
from sfm_shapefit.solver.solver_options import OnIteration, Watch
from sfm_shapefit.solver.splitting.edges import EdgePasses, edge_data
from sfm_shapefit.solver.splitting.engine import Goal, Iteration, Outcome, Stop, Tuning
from sfm_shapefit.solver.splitting.linear import (
    ONE_THREAD,
    Prediction,
    Resources,
    laplacian_factor,
)

_TUNING = Tuning(relaxation=1.7, renewals=tuple(10 * 2**k for k in range(8)), penalty=0.5, accelerate=True)
# The splitting runs until it estimates its error below 0.3 tol; its certificate is then mostly within tol.
_FIRST_TARGET_PER_TOL = 0.3
_TARGET_SHRINKAGE = 0.1  # share of the target before; the splitting goes on to it if the certificate misses
_CERTIFICATES = 4  # certificates tried; a further target is below rounding
_NEWTON_STEPS = 30  # Newton steps, a bound; from a good start fewer are needed
_CHEAP_FLOPS = 4e9  # operations of a factorization in blocks; up to these Newton may begin twice, ...
_SPLITTING_BEFORE_NEWTON = 500  # ... and takes over after so many iterations: the splitting creeps then
# Newton steps are not taken where one factorization in blocks takes more operations: about a minute.
_NEWTON_FLOPS = 2e12


class HybridStop(enum.Enum):
    """Why the solver returned; the value is the sentence shown to the user."""

    CERTIFIED = "the certified gap is below the tolerance"
    NEWTON = (
        "the splitting stalled; Newton steps from its point brought the certified gap below the tolerance"
    )
    INACCURATE = "the certified gap stayed above the tolerance, also with Newton steps at the end"
    TOO_LARGE = (
        "the certified gap stayed above the tolerance, and the factor for Newton steps would be too large"
    )
    MAX_ITERATIONS = "the iteration limit was reached; raise max_iterations or loosen tol"
    CANCELLED = "cancelled by on_iteration"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AdmmResult:
    """Where the splitting ended. `certify` says what the dual proves."""

    locations: FloatArray
    """(n, d) centered, with L(T) = sum of the weights."""
    dual: FloatArray
    """(m, d) y_e, orthogonal to v_e and ||y_e|| <= w_e; the equality holds approximately."""
    iterations: int
    stop: Stop
    """Why the iteration ended."""


class Splitting:
    """A run of ADMM that can be continued. Close it after use."""

    def __init__(self, graph: ViewGraph, resources: Resources) -> None:
        """Set up the iteration; the factor of the resources may serve others between two runs."""
        self.graph, self.resources = graph, resources
        self._passes = EdgePasses(edge_data(graph, -np.inf), resources.threads)
        kappa, factor = float(graph.weights.sum()), laplacian_factor(graph, resources)
        self._iteration = Iteration(self._passes, factor, _TUNING, scale_functional(graph), kappa)
        self._outcome: Outcome | None = None

    def close(self) -> None:
        """End the threads."""
        self._passes.close()

    def run(self, goal: Goal, on_iteration: OnIteration | None) -> AdmmResult:
        """Iterate on until the goal is reached, whose limit is that of all iterations since the beginning.

        The callback is called after each; where it returns False, the run ends with the iterate.
        """
        outcome = self._outcome = self._iteration.run(goal, on_iteration, self._outcome)
        state = outcome.state
        dual = self._passes.in_graph_order(self._passes.dual(state.x, state.rho))
        t = state.t - state.t.mean(axis=0)
        return AdmmResult(locations=t, dual=dual, iterations=outcome.iterations, stop=outcome.stop)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HybridResult:
    """Locations and what is proven about them."""

    locations: FloatArray
    """(n, d) centered, with L(T) = sum of the weights."""
    certificate: Certificate
    """Certificate of these locations; its dual is feasible."""
    iterations: int
    """Iterations of the splitting."""
    factorizations: int
    """Factorizations of the Newton steps, 0 if there were none."""
    stop: HybridStop
    """Why the solver returned."""


def solve_hybrid(
    graph: ViewGraph,
    tol: float,
    max_iterations: int,
    resources: Resources = ONE_THREAD,
    prediction: Prediction | None = None,
    on_iteration: OnIteration | None = None,
) -> HybridResult:
    """Solve ShapeFit by splitting, certify, and finish with Newton steps if the gap needs them.

    Args:
        graph: a connected, parallel-rigid view graph whose directions do not cancel.
        tol: the certified gap wanted, in units of the objective.
        max_iterations: limit of iterations of the splitting. Newton steps follow a stall, or a few hundred
            iterations where they are cheap, not this limit.
        resources: threads, of the passes over edges and of the factor, and memory of a factor.
        prediction: prediction of the factor, if it is there already, to save a second ordering.
        on_iteration: called after each iteration and each factorization; returning False cancels. What
            has been reached is certified all the same.

    Raises:
        UnsolvableError: if the graph is not connected.
    """
    factor = laplacian_factor(graph, resources, prediction)
    resources = resources._replace(factor=factor)
    patience = max_iterations
    if _is_cheap(factor, graph.dimension):
        patience = min(max_iterations, _SPLITTING_BEFORE_NEWTON)
    splitting = Splitting(graph, resources)
    try:
        result = _split(splitting, tol, patience, on_iteration)
    finally:
        splitting.close()
    gave_up = result.stop is HybridStop.MAX_ITERATIONS and patience < max_iterations
    if not gave_up and result.stop is not HybridStop.INACCURATE:
        return result
    del splitting  # its arrays over edges make room for the factor
    return _newton(graph, resources, result, tol, on_iteration)


def _split(
    splitting: Splitting, tol: float, max_iterations: int, on_iteration: OnIteration | None
) -> HybridResult:
    """Alternate splitting and certificate until the gap is below the tolerance or one of them gives up."""
    graph, resources, target = splitting.graph, splitting.resources, _FIRST_TARGET_PER_TOL * tol
    for attempts_left in reversed(range(_CERTIFICATES)):
        step = splitting.run(Goal(0.0, target, max_iterations), on_iteration)
        hopeless = tol if step.stop is Stop.ACCURATE and attempts_left else np.inf
        certificate = certify_in_place(graph, step.locations, step.dual, tol, hopeless, resources)
        if certificate is not None:
            break
        target *= _TARGET_SHRINKAGE
    assert certificate is not None, "the last one is taken as it is"
    ends = {Stop.CANCELLED: HybridStop.CANCELLED, Stop.MAX_ITERATIONS: HybridStop.MAX_ITERATIONS}
    is_certified = certificate.gap <= tol
    return HybridResult(
        locations=step.locations,
        certificate=certificate,
        iterations=step.iterations,
        factorizations=0,
        stop=HybridStop.CERTIFIED if is_certified else ends.get(step.stop, HybridStop.INACCURATE),
    )


def _newton(
    graph: ViewGraph,
    resources: Resources,
    result: HybridResult,
    tol: float,
    on_iteration: OnIteration | None,
) -> HybridResult:
    """Go on from the best certified point by Newton steps, if their factor fits."""
    d, factor = working_dimension(graph), resources.factor
    plan = None if factor is None else factor.plan
    fits = plan is not None and plan.num_bytes(d, np.float64) <= resources.memory_bytes
    if factor is None or plan is None or not fits or plan.flops * d**3 > _NEWTON_FLOPS:
        return replace(result, stop=HybridStop.TOO_LARGE)
    watch, count = Watch(on_iteration, done=result.iterations), 0
    normal = allocate_newton(graph, plan, threads=resources.threads)
    for start in (result.locations, result.certificate.dual), None:
        if start is None and not _is_cheap(factor, d):
            break
        t, y, steps = solve_newton_sparse(graph, tol, _NEWTON_STEPS, watch, start=start, factor=normal)
        result, count = _better(graph, result, t, y, tol, resources), count + steps
        if watch.cancelled or result.certificate.gap <= tol:
            break
    stop = HybridStop.CANCELLED if watch.cancelled else HybridStop.INACCURATE
    if result.certificate.gap <= tol:
        stop = HybridStop.NEWTON
    return replace(result, factorizations=count, stop=stop)


def _is_cheap(factor: LaplacianFactor, dimension: int) -> bool:
    """Return whether a factorization in blocks takes no time to speak of."""
    return factor.plan is not None and factor.plan.flops * dimension**3 <= _CHEAP_FLOPS


def _better(
    graph: ViewGraph, result: HybridResult, t: FloatArray, y: FloatArray, tol: float, resources: Resources
) -> HybridResult:
    """Return the result with other locations and their certificate, if its gap is smaller."""
    if not (np.isfinite(t).all() and projected_length(graph, t) > 0.0):
        return result
    certificate = certify_in_place(graph, t, y, tol, np.inf, resources)
    if certificate is None or not certificate.gap < result.certificate.gap:
        return result
    return replace(result, locations=t - t.mean(axis=0), certificate=certificate)
