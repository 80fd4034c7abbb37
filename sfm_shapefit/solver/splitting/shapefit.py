"""ShapeFit by the splitting of `engine`."""

from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.options import OnIteration
from sfm_shapefit.solver.program import scale_functional
from sfm_shapefit.solver.splitting.edges import EdgePasses, edge_data
from sfm_shapefit.solver.splitting.engine import Goal, Iteration, Outcome, Stop, Tuning
from sfm_shapefit.solver.splitting.linear import Resources, laplacian_factor

_TUNING = Tuning(relaxation=1.7, renewals=tuple(10 * 2**k for k in range(8)), penalty=0.5, accelerate=True)


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
