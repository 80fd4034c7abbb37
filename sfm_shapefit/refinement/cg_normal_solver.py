"""The normal equations of the angular refinement on large graphs: conjugate gradients without their factor.

A step need not be exact. The preconditioner is what the solver has for the scalar Laplacian, here that whose
weights are the mean eigenvalues of the blocks: a float32 factor, which has 27 times less operations than that
of the blocks in three dimensions, or where it fills in the diagonal, or an approximate factor.
"""

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.approximate import Preconditioner, conjugate_gradients
from sfm_shapefit.laplacian.factor import LaplacianFactor
from sfm_shapefit.laplacian.operators import apply_blocks
from sfm_shapefit.solver.splitting.linear import preconditioner

_REDUCTION = 0.1  # share of the residual that a solve may leave; damped steps need no more
_STALE = 0.2  # mean change of the scalar weights, over their mean; after a smaller one a factor still does
_MAX_STEPS = 80  # conjugate gradient steps, a bound; a solve that ends there is used as it is


class IterativeNormal:
    """What `angular.refine_angles` takes in place of a factor's plan; memory is linear in the edges."""

    plan = None

    def __init__(self, graph: ViewGraph, scalar: LaplacianFactor) -> None:
        """Take the graph, and a factor of its scalar Laplacians, which is overwritten."""
        self._graph, self._edges, self._scalar = graph, np.ascontiguousarray(graph.edges), scalar
        self._blocks: FloatArray = np.zeros((0, 1, 1))
        self._factored: FloatArray = np.zeros(len(self._edges))
        self._preconditioner: Preconditioner | None = None

    def refactor(self, weights: FloatArray, /) -> None:
        """Take the matrix of edge blocks (m, d, d)."""
        self._blocks = weights
        mean = np.einsum("eaa->e", weights)
        mean /= mean.mean()
        if np.abs(mean - self._factored).mean() > _STALE:
            self._factored, self._preconditioner = mean, preconditioner(self._graph, self._scalar, mean)

    def solve(self, rhs: FloatArray, /) -> FloatArray:
        """Return the step of the locations, (n, d), to a tenth of the residual."""
        factor, count = self._preconditioner, len(rhs)
        assert factor is not None
        return conjugate_gradients(
            self._apply, factor, rhs, tol=_REDUCTION, max_iterations=_MAX_STEPS, coupled_nodes=count
        ).x

    def _apply(self, x: FloatArray) -> FloatArray:
        out = np.zeros_like(x, order="C")
        apply_blocks(self._edges, self._blocks, np.ascontiguousarray(x), tuple(range(x.shape[1])), out)
        return out
