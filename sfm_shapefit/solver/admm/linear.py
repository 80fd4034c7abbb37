"""The linear solve inside ADMM: a float32 Cholesky factor where it fits, conjugate gradients elsewhere.

Each ADMM step solves L delta = rhs with the weighted graph Laplacian L and moves the locations by delta
(delta form). An error of delta is then an error relative to the *step*: a float32 factor loses nothing,
and conjugate gradients that reduce their residual tenfold count as solved, since what is left enters the
next right-hand side.
"""

from typing import Protocol

import numpy as np

from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.laplacian.approximate import (
    Preconditioner,
    approximate_cholesky,
    conjugate_gradients,
    jacobi,
)
from sfm_shapefit.laplacian.cholesky import allocate_factor
from sfm_shapefit.laplacian.operators import Adjacency, adjacency, apply_laplacian
from sfm_shapefit.laplacian.ordering import best_order
from sfm_shapefit.laplacian.symbolic import plan_factorisation
from sfm_shapefit.viewgraph import ViewGraph

DEFAULT_MEMORY_BYTES = 2_000_000_000
"""What the factor may take if the caller says nothing."""

# A solve by approximate Cholesky costs about 9 us per edge in all (5 set-ups, 40 x 3 steps), five float32
# factorisations at 80 Gflop/s as much from 150,000 operations per edge on. Geometric and community graphs of
# 1e5 cameras have 40,000, random graphs 300,000 at 3e3 cameras and millions at 1e4.
_FLOPS_PER_EDGE = 150_000
_REDUCTION = 0.1  # of the residual per solve; 0.03 and 0.01 save no ADMM iteration, 0.3 costs some
_MAX_STEPS = 60  # approximate Cholesky needs 2-5 for that reduction on every family tried
_JACOBI_STEPS = 8  # if Jacobi solves a probe to 1e-2 in so many, the graph is an expander
_SEED = 1


class LaplacianFactor(Protocol):
    """Solves with the Laplacian L = D^T diag(weights) D of one graph, whose weights change now and then.

    `sfm_shapefit.laplacian.cholesky.CholeskyFactor` is one.
    """

    def refactor(self, weights: FloatArray) -> None:
        """Take new edge weights, (m,) in the order of the graph's edges."""
        ...

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Return x with L x = rhs, (n, d), up to a constant per column; the columns of rhs sum to 0."""
        ...


class IterativeSolver:
    """A `LaplacianFactor` without fill: conjugate gradients from zero, to a tenth of the residual.

    The preconditioner is the diagonal on expanders (random graphs), else an approximate Cholesky factor.
    """

    def __init__(self, graph: Adjacency) -> None:
        """Keep the graph; `refactor` must come before `solve`."""
        self._graph = graph
        self._weights = np.ones(len(graph.edge_of) // 2)
        self._preconditioner: Preconditioner = jacobi(graph, self._weights)

    def refactor(self, weights: FloatArray) -> None:
        """Take new edge weights, (m,), and choose the preconditioner by a probe."""
        self._weights = np.ascontiguousarray(weights)
        self._preconditioner = jacobi(self._graph, self._weights)
        probe = np.random.default_rng(_SEED).normal(size=(self._graph.num_nodes, 1))
        if not self._solve(probe, 1e-2, _JACOBI_STEPS)[1]:
            self._preconditioner = approximate_cholesky(self._graph, self._weights, _SEED)

    @property
    def preconditioner(self) -> Preconditioner:
        """The preconditioner of the last weights: a fixed linear map, as `solve` is not."""
        return self._preconditioner

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Return x with ||rhs - L x|| at most a tenth of ||rhs||, column by column, (n, d)."""
        return self._solve(rhs, _REDUCTION, _MAX_STEPS)[0]

    def _solve(self, rhs: FloatArray, tol: float, max_steps: int) -> tuple[FloatArray, bool]:
        """Return the solution and whether it is as accurate as asked."""
        result = conjugate_gradients(
            lambda x: apply_laplacian(self._graph, self._weights, x, np.empty_like(x)),
            self._preconditioner,
            rhs,
            tol=tol,
            max_iterations=max_steps,
        )
        return result.x, result.converged


def laplacian_factor(
    graph: ViewGraph, memory_bytes: int = DEFAULT_MEMORY_BYTES, coordinates: FloatArray | None = None
) -> LaplacianFactor:
    """Return a float32 Cholesky factor of the graph's Laplacian, or an iterative solver where that is better.

    It is better where the factor would not fit, or would take longer than it saves.

    Args:
        graph: a connected view graph.
        memory_bytes: what the factor may take; predicted before anything is allocated.
        coordinates: (n, k) rough positions that may help to order the nodes.
    """
    neighbours = adjacency(graph.num_cameras, np.ascontiguousarray(graph.edges))
    tree = best_order(neighbours, "auto", coordinates)
    too_big = tree.num_nonzeros * np.dtype(np.float32).itemsize > memory_bytes
    if too_big or tree.flops > _FLOPS_PER_EDGE * graph.num_edges:
        return IterativeSolver(neighbours)
    plan = plan_factorisation(neighbours, np.ascontiguousarray(graph.edges), tree)
    if plan.num_bytes(1, np.float32) > memory_bytes:
        return IterativeSolver(neighbours)
    return allocate_factor(plan, 1, np.float32)
