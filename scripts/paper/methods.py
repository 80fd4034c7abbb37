"""The methods that the figures compare, by name: each takes a graph and returns locations."""

from collections.abc import Callable

import numpy as np

from harness import ours
from paper.baselines import locate_least_squares, locate_lud
from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.program import differences
from sfm_shapefit.synthetic.graphs import GraphProblem

# Exact recovery means an error below 1e-9.
_TOL = 1e-12


def _refine(graph: ViewGraph, _problem: GraphProblem) -> FloatArray:
    """ShapeFit and LUD, both refined in angles, the better kept: what `locate` does."""
    placement = ours.place(graph, tol=_TOL, uniqueness=False)
    if len(placement.cameras) < graph.num_nodes:
        raise UnsolvableError("the graph is not parallel rigid")
    return placement.locations


def _oracle(graph: ViewGraph, problem: GraphProblem) -> FloatArray:
    """Least squares of the pairs that are not corrupted: no method can be told more.

    Reweighted, they are of sines, which is best for small noise; under large noise that collapses, for a sine
    is small near 180 degrees too, and the first answer is kept: whichever fits the directions better.
    """
    clean, cameras = graph.restricted_to(np.flatnonzero(~problem.corrupted))
    if len(cameras) < graph.num_nodes:
        return np.full((graph.num_nodes, graph.dimension), np.nan)
    answers = [locate_least_squares(clean, reweightings=count) for count in (0, 10)]

    def misfit(locations: FloatArray) -> float:
        return float(np.sum((normalized(differences(locations, clean.edges)) - clean.directions) ** 2))

    return min(answers, key=misfit)


METHODS: dict[str, Callable[[ViewGraph, GraphProblem], FloatArray]] = {
    "ShapeFit": lambda graph, _: ours.solve(graph, tol=_TOL).locations,
    "ShapeFit, conic": lambda graph, _: ours.solve(graph, solver="conic", tol=1e-9).locations,
    "refined": _refine,
    "LUD": lambda graph, _: locate_lud(graph),
    "least squares": lambda graph, _: locate_least_squares(graph),
    "oracle": _oracle,
}
