"""The linear solve inside ADMM: what it asks of a factor, and conjugate gradients where none fits.

Each ADMM step solves L delta = rhs with the weighted graph Laplacian L and moves the locations by delta
(delta form). An error of delta is then an error relative to the *step*: a float32 factor loses nothing,
and conjugate gradients that reduce their residual tenfold count as solved, since what is left enters the
next right-hand side.
"""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.solver.admm.edges import EdgePasses, edge_data
from sfm_shapefit.viewgraph import ViewGraph


class LaplacianFactor(Protocol):
    """Solves with the Laplacian L = D^T diag(weights) D of one graph, whose weights change now and then."""

    def refactor(self, weights: FloatArray) -> None:
        """Take new edge weights, (m,) in the order of the graph's edges."""
        ...

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Return x with L x = rhs, (n, d), up to a constant per column; the columns of rhs sum to 0."""
        ...


class ConjugateGradients:
    """A `LaplacianFactor` without fill: conjugate gradients from zero, preconditioned by the degrees.

    Serves expanders (random graphs), where a factor would be nearly dense and a few steps suffice. On
    ill-conditioned graphs (geometric ones, chains) the step limit bites and ADMM stalls.
    """

    reduction: float = 0.1
    max_steps: int = 30

    def __init__(self, graph: ViewGraph, threads: int = 1) -> None:
        """Keep the edges of the graph; `refactor` must come before `solve`."""
        data = edge_data(graph, -np.inf)
        self._order = data.order
        self._passes = EdgePasses(data, threads)
        self._weights = np.ones(graph.num_edges)
        self._inverse_degrees = np.ones((graph.num_cameras, 1))

    def refactor(self, weights: FloatArray) -> None:
        """Take new edge weights, (m,) in the order of the graph's edges."""
        self._weights = weights[self._order]
        ends, n = self._passes.data.ends, self._passes.data.num_nodes
        degrees = np.bincount(ends.ravel(), weights=np.repeat(self._weights, 2), minlength=n)
        self._inverse_degrees = 1.0 / degrees[:, None]

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Return x with ||rhs - L x|| at most `reduction` ||rhs|| in the preconditioned norm, (n, d)."""
        return conjugate_gradients(
            lambda x: self._passes.laplacian(x, self._weights),
            rhs,
            lambda r: self._inverse_degrees * r,
            reduction=self.reduction,
            max_steps=self.max_steps,
        )


def conjugate_gradients(
    matrix: Callable[[FloatArray], FloatArray],
    rhs: FloatArray,
    precondition: Callable[[FloatArray], FloatArray],
    *,
    reduction: float,
    max_steps: int,
) -> FloatArray:
    """Return x near the solution of matrix(x) = rhs, from x = 0, for a positive semidefinite matrix.

    Args:
        matrix: symmetric and positive semidefinite; rhs must lie in its range.
        rhs: array of any shape; all of it is one vector.
        precondition: symmetric positive definite approximation of the inverse.
        reduction: stop once the preconditioned residual norm has fallen to this fraction.
        max_steps: stop after that many products with the matrix.
    """
    x, r = np.zeros_like(rhs), rhs.copy()
    z = precondition(r)
    p, size = z.copy(), float(np.vdot(r, z))
    target = reduction**2 * size
    for _ in range(max_steps):
        if not size > target:
            break
        q = matrix(p)
        curvature = float(np.vdot(p, q))
        if curvature <= 0.0:
            break
        step = size / curvature
        x += step * p
        r -= step * q
        z = precondition(r)
        size, previous = float(np.vdot(r, z)), size
        p *= size / previous
        p += z
    return x
