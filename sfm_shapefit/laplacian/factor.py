"""The door to factors: what the rooms above ask of one, and what makes it.

Another library's Cholesky factorization is a module beside `cholesky`, and is put in here.
"""

from typing import Protocol

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.laplacian.approximate import Preconditioner
from sfm_shapefit.laplacian.cholesky import CholeskyFactor
from sfm_shapefit.laplacian.operators import Workers, adjacency, check_edges
from sfm_shapefit.laplacian.ordering import Ordering, best_order
from sfm_shapefit.laplacian.selected import SelectedInverse
from sfm_shapefit.laplacian.symbolic import (
    EliminationTree,
    SymbolicFactor,
    elimination_tree,
    plan_factorization,
)

DEFAULT_FACTOR_BYTES = 2_000_000_000
"""Bytes of one factor, unless the caller says otherwise; that of a dense matrix of 16,000 unknowns."""

FactorPlan = SymbolicFactor
"""What is known of a factor before any number: `flops`, `num_nonzeros`, `num_entries`, `num_bytes`."""


class LaplacianFactor(Preconditioner, Protocol):
    """Solves with the Laplacian L = D^T diag(weights) D of one graph, whose weights change now and then."""

    @property
    def plan(self) -> FactorPlan | None:
        """What it was planned by; None for what has no fill, or is over other unknowns than the nodes."""

    def refactor(self, weights: FloatArray) -> None:
        """Take new edge weights, (m,) or blocks (m, b, b), in the order of the graph's edges."""


class Factor(LaplacianFactor, Protocol):
    """A direct factor of symmetric matrices in b x b blocks; see `CholeskyFactor` for what each does."""

    @property
    def plan(self) -> FactorPlan:
        """What it was planned by."""

    @property
    def block(self) -> int:
        """Size b of the blocks."""

    @property
    def smallest_pivot(self) -> float:
        """Least ratio of a pivot to its diagonal entry; near the rounding unit if singular."""

    def refactor(self, weights: FloatArray, ground: float | None = None) -> None:
        """Factor the Laplacian of edge weights; UnsolvableError if it is singular."""

    def refactor_blocks(self, diagonal: FloatArray, off_diagonal: FloatArray) -> bool:
        """Factor a matrix with blocks of its own; return whether it is positive definite."""
        ...

    def refactor_alike(self, diagonal: FloatArray, weights: FloatArray) -> bool:
        """Factor a Laplacian with blocks of its own at the nodes; return whether it is positive definite."""
        ...

    def selected_inverse(self) -> SelectedInverse:
        """Return the blocks of the inverse at the nodes and edges."""
        ...

    def log_determinant(self) -> float:
        """Return the logarithm of the determinant of what is factored."""
        ...


def analyze(
    num_nodes: int, edges: npt.ArrayLike, ordering: Ordering | IntArray | EliminationTree = "auto"
) -> FactorPlan:
    """Plan the factorization of matrices over a graph, whatever their numbers, block size and precision.

    The plan says what a factorization would cost; still earlier, and cheaper, the elimination tree of
    `best_order` does.

    Args:
        num_nodes: n >= 1.
        edges: (m, 2) node indices; repeated edges add up. InputError for an index out of range or a
            self-loop.
        ordering: a method of `best_order`, an order of elimination (n,), or its tree.
    """
    pairs = check_edges(num_nodes, edges)
    graph = adjacency(num_nodes, pairs)
    if isinstance(ordering, str):
        ordering = best_order(graph, ordering)
    tree = ordering if isinstance(ordering, EliminationTree) else elimination_tree(graph, ordering)
    return plan_factorization(graph, pairs, tree)


def allocate_factor(
    plan: FactorPlan, block: int = 1, dtype: npt.DTypeLike = np.float64, *, threads: int = 1
) -> Factor:
    """Allocate the memory of a factor, `plan.num_bytes(block, dtype, threads)` while it is computed.

    Its numbers and answers do not depend on `threads`.
    """
    area = block * block
    return CholeskyFactor(
        plan=plan,
        block=block,
        panels=np.empty(plan.num_entries * area, dtype=dtype),
        workers=Workers(threads),
        _diagonal=np.empty((plan.num_nodes, area)),
    )


def factorize(
    plan: FactorPlan,
    weights: FloatArray,
    dtype: npt.DTypeLike = np.float64,
    ground: float | None = None,
    *,
    threads: int = 1,
) -> Factor:
    """Allocate a factor and compute it; see `CholeskyFactor.refactor`."""
    block = 1 if np.ndim(weights) == 1 else np.shape(weights)[1]
    factor = allocate_factor(plan, block, dtype, threads=threads)
    factor.refactor(weights, ground)
    return factor
