"""The linear solve inside ADMM: a Cholesky factor where it fits, conjugate gradients elsewhere.

Each ADMM step solves L delta = rhs with the weighted graph Laplacian L and moves the locations by delta. An
error of delta is relative to the *step* and enters the next right-hand side: a float32 factor loses nothing,
and halves the time and memory of many cameras; conjugate gradients that reduce their residual tenfold count
as solved.
"""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.approximate import (
    JacobiPreconditioner,
    Preconditioner,
    approximate_cholesky,
    conjugate_gradients,
    diagonal_suffices,
)
from sfm_shapefit.laplacian.factor import DEFAULT_FACTOR_BYTES, LaplacianFactor, allocate_factor, analyze
from sfm_shapefit.laplacian.operators import Adjacency, LaplacianOperator, Workers, adjacency
from sfm_shapefit.laplacian.ordering import widest_level
from sfm_shapefit.laplacian.symbolic import EliminationTree
from sfm_shapefit.solver.solver_options import SolverOptions

# A solve by approximate Cholesky costs about 9 us per edge in all (5 set-ups, 40 x 3 steps), five float32
# factorizations at 80 Gflop/s as much from 150,000 operations per edge on. Geometric and community graphs of
# 1e5 cameras have 40,000, random graphs 300,000 at 3e3 cameras and millions at 1e4.
_FLOPS_PER_EDGE = 150_000
# A solve shrinks the residual to this share; 0.03 and 0.01 save no ADMM iteration, 0.3 costs some.
_REDUCTION = 0.1
_MAX_STEPS = 60  # steps, a bound; approximate Cholesky needs 2 to 5 for that reduction on every family tried
_JACOBI_STEPS = 8  # steps; if Jacobi solves a probe to 1e-2 in so few, the graph is an expander
# Ordering so many cameras takes a minute; a rough prediction of the work must do there first.
_HUGE = 400_000
_LARGE = 5_000  # cameras of an expander; its factor takes longer than it saves
# The factor of fewer cameras is small in any type. It is of float64, as those of other solves are, so that
# the kernels for float32, 2 s of compiling, are no part of a first run.
_FEW = 500
_SEED = 1  # seed of the approximate factor; same input, same answer


class Resources(NamedTuple):
    """What a solve may use; its answer does not depend on the threads."""

    threads: int = 1
    memory_bytes: int = DEFAULT_FACTOR_BYTES
    """What one factor may take, predicted before it is allocated."""
    factor: LaplacianFactor | None = None
    """A solver for the graph's Laplacian that may be overwritten, where there is one already."""

    @classmethod
    def of(cls, options: SolverOptions) -> "Resources":
        """Return what options allow."""
        return cls(options.num_threads(), options.factor_bytes)


ONE_THREAD = Resources()
"""What a solve uses where nothing else is said."""


class IterativeSolver:
    """A `LaplacianFactor` without fill: conjugate gradients from zero, to a tenth of the residual.

    The preconditioner is the diagonal on expanders (random graphs), else an approximate Cholesky factor.
    """

    plan = None

    def __init__(self, graph: Adjacency, threads: int = 1) -> None:
        """Keep the graph; `refactor` must come before `solve`. The answers do not depend on `threads`."""
        self._graph = graph
        self._operator = LaplacianOperator(graph, np.ones(len(graph.edge_of) // 2), Workers(threads))

    def refactor(self, weights: FloatArray) -> None:
        """Take new edge weights, (m,), and choose the preconditioner by a probe."""
        self._operator.reweigh(weights)
        # A fixed linear map, as `solve` is not.
        self.preconditioner: Preconditioner = JacobiPreconditioner(self._operator.diagonal())
        if not diagonal_suffices(self._operator, _JACOBI_STEPS):
            self.preconditioner = approximate_cholesky(self._graph, weights, _SEED)

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Return x with ||rhs - L x|| at most a tenth of ||rhs||, column by column, (n, d)."""
        return conjugate_gradients(
            self._operator, self.preconditioner, rhs, tol=_REDUCTION, max_iterations=_MAX_STEPS
        ).x


class Prediction(NamedTuple):
    """What is known of a graph's factor before any number: the order of elimination, if one is of use."""

    tree: EliminationTree | None
    """Elimination tree of the order with the least work; None where no order would help enough."""

    @property
    def flops(self) -> float:
        """Operations of the scalar factorization, infinite where no order was looked for."""
        return np.inf if self.tree is None else self.tree.flops


def predict_factor(graph: ViewGraph) -> Prediction:
    """Return the order of elimination that `laplacian_factor` would use.

    A graph on which the diagonal is a good preconditioner has a large spectral gap, so no small separators
    (Lipton, Rose, Tarjan 1979): its factor fills in whatever the order, so none is looked for. Nor is it on
    huge graphs whose levels are so wide that the factor would take longer than it saves; if some of them have
    better separators than their levels, approximate Cholesky serves them as well.
    """
    neighbors = adjacency(graph.num_nodes, np.ascontiguousarray(graph.edges))
    if graph.num_nodes >= _LARGE:
        operator = LaplacianOperator(neighbors, graph.weights, Workers(1))
        if diagonal_suffices(operator, _JACOBI_STEPS):
            return Prediction(None)
    if graph.num_nodes >= _HUGE:
        rough_flops = 4.0 * (0.75 * widest_level(neighbors)) ** 3  # as on boxes of 1e4 and 1e5 cameras
        if rough_flops > 2.0 * _FLOPS_PER_EDGE * graph.num_edges:
            return Prediction(None)
    return Prediction(graph.elimination_tree())


def laplacian_factor(
    graph: ViewGraph, resources: Resources = ONE_THREAD, prediction: Prediction | None = None
) -> LaplacianFactor:
    """Return the factor of the resources; if None, a Cholesky factor of the connected graph's Laplacian.

    Or an iterative solver where that factor would not fit, or would take longer than it saves. `prediction`
    is that of `predict_factor` on the same graph, if it is there already.
    """
    if resources.factor is not None:
        return resources.factor
    tree = (predict_factor(graph) if prediction is None else prediction).tree
    neighbors = adjacency(graph.num_nodes, np.ascontiguousarray(graph.edges))
    if tree is None or tree.flops > _FLOPS_PER_EDGE * graph.num_edges:
        return IterativeSolver(neighbors, resources.threads)
    dtype = np.float64 if graph.num_nodes < _FEW else np.float32
    if tree.num_nonzeros * np.dtype(dtype).itemsize > resources.memory_bytes:
        return IterativeSolver(neighbors, resources.threads)
    plan = analyze(graph.num_nodes, graph.edges, tree)
    if plan.num_bytes(1, dtype) > resources.memory_bytes:
        return IterativeSolver(neighbors, resources.threads)
    return allocate_factor(plan, 1, dtype, threads=resources.threads)


def preconditioner(graph: ViewGraph, factor: LaplacianFactor, weights: FloatArray) -> Preconditioner:
    """Return an approximate inverse, a linear map, of the Laplacian of `weights`, (m,), from its factor."""
    try:
        factor.refactor(weights)
    except UnsolvableError:  # connected, but too long for the precision of the factor
        return approximate_cholesky(adjacency(graph.num_nodes, graph.edges), weights, _SEED)
    return factor.preconditioner if isinstance(factor, IterativeSolver) else factor
