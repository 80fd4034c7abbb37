"""The normal equations of the angular refinement on large graphs: conjugate gradients without a factor.

A step need not be exact. The preconditioner is an approximate Cholesky factor of the scalar Laplacian whose
weights are the mean eigenvalues of the blocks.
"""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.approximate import Preconditioner, approximate_cholesky, conjugate_gradients
from sfm_shapefit.laplacian.operators import adjacency
from sfm_shapefit.solver.program import adjoint, differences

_REDUCTION = 1e-2  # share of the residual that a solve may leave; damped steps need no more
_MAX_STEPS = 80  # conjugate gradient steps, a bound; a solve that ends there is used as it is
_SEED = 1  # seed of the approximate factor; same input, same answer


class GraphShape(NamedTuple):
    """What the normal equations need to know of a `ViewGraph`."""

    num_nodes: int
    edges: IntArray
    """(m, 2)"""
    dimension: int


class IterativeNormal:
    """What `angular.refine_angles` takes in place of a factor's plan; memory is linear in the edges."""

    def __init__(self, graph: ViewGraph | GraphShape) -> None:
        self._edges = graph.edges
        self._neighbors = adjacency(graph.num_nodes, graph.edges)
        self._blocks: FloatArray = np.zeros((0, graph.dimension, graph.dimension))
        self._preconditioner: Preconditioner | None = None

    def refactor(self, weights: FloatArray, /) -> None:
        """Take the matrix of edge blocks (m, d, d)."""
        self._blocks = weights
        mean = np.trace(weights, axis1=1, axis2=2) / weights.shape[1]
        self._preconditioner = approximate_cholesky(self._neighbors, mean, _SEED)

    def solve(self, rhs: FloatArray, /) -> FloatArray:
        """Return the step of the locations, (n, d), to a hundredth of the residual."""
        assert self._preconditioner is not None
        return conjugate_gradients(
            self._apply, self._preconditioner, rhs, tol=_REDUCTION, max_iterations=_MAX_STEPS, coupled=True
        ).x

    def _apply(self, x: FloatArray) -> FloatArray:
        pulled = (self._blocks @ differences(np.ascontiguousarray(x), self._edges)[:, :, None])[:, :, 0]
        return np.asarray(adjoint(pulled, self._edges, len(x)))
