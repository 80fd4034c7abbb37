"""ShapeFit by the splitting of `engine`."""

from dataclasses import dataclass

import numpy as np

from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.solver.admm.edges import EdgePasses, edge_data
from sfm_shapefit.solver.admm.engine import Iteration, Settings, Stop
from sfm_shapefit.solver.admm.linear import LaplacianFactor, laplacian_factor
from sfm_shapefit.solver.options import OnIteration
from sfm_shapefit.solver.program import scale_functional
from sfm_shapefit.viewgraph import ViewGraph

_RENEWALS = tuple(10 * 2**k for k in range(8))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AdmmResult:
    """Where the splitting ended. `certify` says what the dual proves."""

    locations: FloatArray
    """(n, d) centred, with L(T) = sum of the weights."""
    dual: FloatArray
    """(m, d) y_e, orthogonal to v_e and ||y_e|| <= w_e; the equality holds approximately."""
    iterations: int
    stop: Stop
    """Why the iteration ended."""


def solve_admm(
    graph: ViewGraph,
    tol: float,
    max_iterations: int,
    factor: LaplacianFactor | None = None,
    *,
    threads: int = 1,
    on_iteration: OnIteration | None = None,
) -> AdmmResult:
    """Solve ShapeFit by ADMM with the scalar graph Laplacian.

    Args:
        graph: a connected, parallel-rigid view graph whose directions do not cancel.
        tol: relative error of the objective at which to stop, estimated; not certified.
        max_iterations: hard limit, reported in `stop`.
        factor: solver for the graph's Laplacian, overwritten; by default what `laplacian_factor` picks.
        threads: of the passes over edges; the result does not depend on it.
        on_iteration: called after each iteration; returning False cancels and returns the iterate.

    Raises:
        UnsolvableError: if the factor finds the Laplacian singular: the graph is not connected.
    """
    settings = Settings(
        tol=tol,
        max_iterations=max_iterations,
        relaxation=1.7,
        renewals=_RENEWALS,
        penalty=0.5,
        accelerate=True,
    )
    factor = laplacian_factor(graph) if factor is None else factor
    passes = EdgePasses(edge_data(graph, -np.inf), threads)
    try:
        run = Iteration(passes, factor, settings, scale_functional(graph), float(graph.weights.sum()))
        outcome = run.run(on_iteration)
        dual = np.empty_like(graph.directions)
        dual[passes.data.order] = passes.dual(outcome.state.x, outcome.state.rho)
    finally:
        passes.close()
    t = outcome.state.t - outcome.state.t.mean(axis=0)
    return AdmmResult(locations=t, dual=dual, iterations=outcome.iterations, stop=outcome.stop)
