"""The linear systems of rotation averaging: factored where the factor is small, else conjugate gradients.

Both are L + ridge I with a Laplacian L of pairs: of scalar weights with three right-hand sides, or of 3 x 3
blocks. The ridge is a tiny share of the mean diagonal. It leaves a camera in place whose pairs are all left
out, and it does not move the mean, because the right-hand sides sum to zero.

Orders of elimination are planned once; a round factors new numbers. Without a factor, a preconditioner serves
as long as it is good: weights change little from round to round.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.executors import in_slices
from sfm_shapefit.laplacian.approximate import (
    JacobiPreconditioner,
    Preconditioner,
    approximate_cholesky,
    conjugate_gradients,
    diagonal_suffices,
)
from sfm_shapefit.laplacian.factor import Factor, FactorPlan, allocate_factor, analyze
from sfm_shapefit.laplacian.operators import Adjacency, LaplacianOperator, Workers, adjacency, apply_blocks
from sfm_shapefit.laplacian.ordering import best_order, widest_level
from sfm_shapefit.rotations.averaging_kernels import add_at_ends

RIDGE = 1e-9
"""Share of the mean diagonal that is added to it; holds cameras whose pairs are all left out."""

# Operations of a factorization per pair; at 10 Gflop/s as long as two solves by conjugate gradients, about a
# microsecond per pair each.
_FLOPS_PER_PAIR = 20_000.0
_FEW_FLOPS = 1e9  # operations; a factor of so few takes a tenth of a second, and is worth it for any pairs
_BLOCK_FLOPS = 27.0  # operations per scalar one; those of 3 x 3 blocks
_MANY_NODES = 3_000  # nodes; more are worth ordering only if a diagonal is no good preconditioner
_JACOBI_STEPS = 12  # steps; a graph that a diagonal solves in so few is an expander
_STALE_STEPS = 25  # steps; a preconditioner that takes more is made anew for the next system
_MAX_STEPS = 300  # conjugate gradient steps; a bound
_SLICE = 5_000  # pairs that one thread takes; Python can be interrupted between slices
_SEED = 1  # seed of the preconditioner; same input, same answer


@dataclass(slots=True, eq=False)
class AveragingSystem:
    """Solves the systems of one set of pairs, one after the other."""

    num_nodes: int
    pairs: IntArray
    """(k, 2)"""
    plan: FactorPlan | None
    """Plan of the factors; None where no factor is small enough."""
    factors_blocks: bool
    """Whether the factor of blocks is small enough too."""
    is_expander: bool
    """Whether the diagonal is a good preconditioner of a large graph; it has no small separators then."""
    threads: int
    graph: Adjacency
    """The pairs of each camera."""
    _factors: dict[int, Factor] = field(default_factory=dict)
    """By the size of their blocks."""
    _operator: LaplacianOperator | None = None
    _preconditioner: Preconditioner | None = None

    def over_pairs(self, work: Callable[..., object], *given: object) -> None:
        """Call `work(begin, end, *given)` for slices of the pairs, each of which it fills, in threads."""
        in_slices(self.threads, len(self.pairs), _SLICE, work, *given)

    def gradient_of(self, pulls: FloatArray) -> FloatArray:
        """Return D^T of what pulls at the pairs, (k, 3), at their cameras, (n, 3)."""
        gradient = np.zeros((self.num_nodes, 3))
        add_at_ends(self.pairs, pulls, -1.0, gradient, gradient)
        return gradient

    def solve_scalar(self, weights: FloatArray, right: FloatArray, tol: float) -> FloatArray:
        """Return the solution (n, 3) for weights (k,), without factor to `tol` of the right side."""
        if self.plan is not None:
            self._refactor(weights[:, None, None])
            return self._factors[1].solve(right)
        operator = self._scalar_operator(weights)
        ridge = RIDGE * float(operator.diagonal().mean())

        def apply(x: FloatArray) -> FloatArray:
            return operator(np.ascontiguousarray(x)) + ridge * x

        return self._iterate(apply, weights, right, tol, coupled_nodes=None)

    def solve_blocks(self, blocks: FloatArray, right: FloatArray, tol: float) -> FloatArray:
        """Return the solution (n, 3) for blocks (k, 3, 3)."""
        if self.factors_blocks:
            self._refactor(blocks)
            return self._factors[3].solve(right)
        means = mean_eigenvalues(blocks)
        return self._iterate(self.block_operator(blocks), means, right, tol, coupled_nodes=len(right))

    def block_operator(self, blocks: FloatArray) -> Callable[[FloatArray], FloatArray]:
        """Return what multiplies (n, 3) with the matrix of blocks."""
        ridge = RIDGE * 2.0 * float(mean_eigenvalues(blocks).sum()) / self.num_nodes

        def apply(x: FloatArray) -> FloatArray:
            out = ridge * np.ascontiguousarray(x)
            apply_blocks(self.pairs, blocks, np.ascontiguousarray(x), (0, 1, 2), out)
            return out

        return apply

    def sum_at_nodes(self, blocks: FloatArray) -> FloatArray:
        """Return the sums (n, b, b) of the blocks (k, b, b) of the pairs at their two nodes."""
        rows = blocks.reshape(len(blocks), -1)
        sums = np.zeros((2, self.num_nodes, rows.shape[1]))
        add_at_ends(self.pairs, rows, 1.0, *sums)
        return np.asarray(sums[0] + sums[1]).reshape(-1, *blocks.shape[1:])

    def ground_blocks(self, blocks: FloatArray) -> Factor:
        """Return the factor of the Laplacian of blocks without ridge, grounded at its last node."""
        factor = self._factor_of(3)
        factor.refactor(blocks)
        return factor

    def is_definite(self, diagonal: FloatArray, blocks: FloatArray) -> bool:
        """Return whether blocks (n, 3, 3), and (k, 3, 3) at (i, j) of pairs, make a definite matrix."""
        return self._factor_of(3).refactor_blocks(diagonal, blocks)

    def _factor_of(self, block: int) -> Factor:
        assert self.plan is not None
        if block not in self._factors:
            self._factors[block] = allocate_factor(self.plan, block, threads=self.threads)
        return self._factors[block]

    def _refactor(self, blocks: FloatArray) -> None:
        """Factor the matrix of blocks (k, b, b); UnsolvableError if it is not positive definite."""
        b = blocks.shape[1]
        factor, diagonal = self._factor_of(b), self.sum_at_nodes(blocks)
        entries = diagonal.reshape(-1, b * b)[:, :: b + 1]
        entries += RIDGE * np.ascontiguousarray(entries.T).mean()
        if not factor.refactor_alike(diagonal, blocks):
            raise UnsolvableError("the pairs do not determine the rotations to working precision")

    def _scalar_operator(self, weights: FloatArray) -> LaplacianOperator:
        if self._operator is None:
            self._operator = LaplacianOperator(self.graph, weights, Workers(self.threads))
        self._operator.reweigh(weights)
        return self._operator

    def _iterate(
        self,
        apply: Callable[[FloatArray], FloatArray],
        weights: FloatArray,
        right: FloatArray,
        tol: float,
        *,
        coupled_nodes: int | None,
    ) -> FloatArray:
        """Solve by conjugate gradients, with a preconditioner for the Laplacian of scalar weights."""
        if self.is_expander:
            self._preconditioner = JacobiPreconditioner(self._scalar_operator(weights).diagonal())
        elif self._preconditioner is None:
            if self.plan is not None:
                self._refactor(weights[:, None, None])
                self._preconditioner = self._factors[1]
            else:
                self._preconditioner = approximate_cholesky(self.graph, weights, _SEED)
        solution = conjugate_gradients(
            apply,
            self._preconditioner,
            right,
            tol=tol,
            max_iterations=_MAX_STEPS,
            coupled_nodes=coupled_nodes,
        )
        if solution.iterations > _STALE_STEPS:
            self._preconditioner = None
        return solution.x


def plan_system(num_nodes: int, pairs: IntArray, weights: FloatArray, threads: int) -> AveragingSystem:
    """Choose how the systems of a connected graph are solved.

    A graph on which the diagonal is a good preconditioner has no small separators, so its factor would fill:
    no order of elimination is looked for where the graph is large.
    """
    graph = adjacency(num_nodes, pairs)
    most = max(_FEW_FLOPS, _FLOPS_PER_PAIR * len(pairs))
    plan, jacobi = None, False
    if num_nodes > _MANY_NODES:
        jacobi = diagonal_suffices(LaplacianOperator(graph, weights, Workers(threads)), _JACOBI_STEPS)
        # As on boxes of 1e4 and 1e5 cameras.
        hopeless = jacobi or 4.0 * (0.75 * widest_level(graph)) ** 3 > 10.0 * most
    else:
        hopeless = False
    if not hopeless:
        tree = best_order(graph)
        if tree.flops <= most:
            plan = analyze(num_nodes, pairs, tree)
    factors_blocks = plan is not None and _BLOCK_FLOPS * plan.flops <= most
    return AveragingSystem(num_nodes, pairs, plan, factors_blocks, jacobi, threads, graph)


def mean_eigenvalues(blocks: FloatArray) -> FloatArray:
    """Return a third of the trace of each block (k, 3, 3), (k,)."""
    return np.ascontiguousarray(blocks[:, 0, 0] + blocks[:, 1, 1] + blocks[:, 2, 2]) / 3.0
