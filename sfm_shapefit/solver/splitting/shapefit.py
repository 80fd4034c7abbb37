"""ShapeFit by the splitting of `engine`."""

from dataclasses import dataclass, replace

import numpy as np

from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.solver.options import OnIteration
from sfm_shapefit.solver.program import scale_functional
from sfm_shapefit.solver.splitting.edges import EdgePasses, edge_data
from sfm_shapefit.solver.splitting.engine import Iteration, Outcome, Settings, Stop
from sfm_shapefit.solver.splitting.linear import LaplacianFactor, laplacian_factor
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


class Splitting:
    """A run of ADMM that can be continued. Close it after use."""

    def __init__(self, graph: ViewGraph, factor: LaplacianFactor, threads: int) -> None:
        """Set up the iteration; the factor may serve others between two runs."""
        settings = Settings(
            tol=0.0,
            absolute_tol=0.0,
            max_iterations=0,
            relaxation=1.7,
            renewals=_RENEWALS,
            penalty=0.5,
            accelerate=True,
        )
        self._passes = EdgePasses(edge_data(graph, -np.inf), threads)
        kappa = float(graph.weights.sum())
        self._iteration = Iteration(self._passes, factor, settings, scale_functional(graph), kappa)
        self._outcome: Outcome | None = None

    def close(self) -> None:
        """End the threads."""
        self._passes.close()

    def run(
        self, tol: float, absolute_tol: float, max_iterations: int, on_iteration: OnIteration | None
    ) -> AdmmResult:
        """Iterate on until the error of the objective is estimated below `tol`, relative, or `absolute_tol`.

        Args:
            tol: relative error.
            absolute_tol: error in units of the objective R / L.
            max_iterations: limit of all iterations since the beginning.
            on_iteration: called after each iteration; returning False cancels and returns the iterate.
        """
        iteration = self._iteration
        iteration.settings = replace(
            iteration.settings, tol=tol, absolute_tol=absolute_tol, max_iterations=max_iterations
        )
        outcome = self._outcome = iteration.run(on_iteration, self._outcome)
        state = outcome.state
        dual = self._passes.in_graph_order(self._passes.dual(state.x, state.rho))
        t = state.t - state.t.mean(axis=0)
        return AdmmResult(locations=t, dual=dual, iterations=outcome.iterations, stop=outcome.stop)


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
    splitting = Splitting(graph, laplacian_factor(graph) if factor is None else factor, threads)
    try:
        return splitting.run(tol, 0.0, max_iterations, on_iteration)
    finally:
        splitting.close()
