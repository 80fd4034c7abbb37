"""The methods that the figures compare, by name: each takes a graph and returns locations."""

from collections.abc import Callable

import numpy as np

from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.baselines import locate_least_squares, locate_lud
from sfm_shapefit.geometry import normalized
from sfm_shapefit.refinement.options import PlacementOptions
from sfm_shapefit.refinement.starts import finish
from sfm_shapefit.solver.options import SolverOptions
from sfm_shapefit.solver.program import differences
from sfm_shapefit.solver.solve import solve
from sfm_shapefit.synthetic.graphs import GraphProblem
from sfm_shapefit.viewgraph import ViewGraph

_TIGHT = SolverOptions(tol=1e-12, uniqueness=False)  # exact recovery means an error below 1e-9


def _shapefit(graph: ViewGraph, _problem: GraphProblem) -> FloatArray:
    return solve(graph, _TIGHT).locations


def _conic(graph: ViewGraph, _problem: GraphProblem) -> FloatArray:
    return solve(graph, SolverOptions(solver="conic", tol=1e-9, uniqueness=False)).locations


def _refined(graph: ViewGraph, _problem: GraphProblem) -> FloatArray:
    """ShapeFit and LUD, both refined in angles, the better kept: what `locate` does."""
    return finish(graph, solve(graph, _TIGHT), PlacementOptions()).locations


def _lud(graph: ViewGraph, _problem: GraphProblem) -> FloatArray:
    return locate_lud(graph)


def _least_squares(graph: ViewGraph, _problem: GraphProblem) -> FloatArray:
    return locate_least_squares(graph)


def _oracle(graph: ViewGraph, problem: GraphProblem) -> FloatArray:
    """Least squares of the pairs that are not corrupted: no method can be told more.

    Reweighted, they are of sines, which is best for small noise; under large noise that collapses, for a sine
    is small near 180 degrees too, and the first answer is kept: whichever fits the directions better.
    """
    clean, cameras = graph.restricted_to(np.flatnonzero(~problem.corrupted))
    if len(cameras) < graph.num_nodes:
        return np.full((graph.num_nodes, graph.dimension), np.nan)
    answers = [locate_least_squares(clean, reweightings=count) for count in (0, 10)]
    return min(answers, key=lambda t: _misfit(clean, t))


def _misfit(graph: ViewGraph, locations: FloatArray) -> float:
    """Return the sum of squared distances between directions as measured and as located."""
    return float(np.sum((normalized(differences(locations, graph.edges)) - graph.directions) ** 2))


METHODS: dict[str, Callable[[ViewGraph, GraphProblem], FloatArray]] = {
    "ShapeFit": _shapefit,
    "ShapeFit, conic": _conic,
    "refined": _refined,
    "LUD": _lud,
    "least squares": _least_squares,
    "oracle": _oracle,
}
