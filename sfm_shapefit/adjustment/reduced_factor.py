"""The reduced system factored: dense by LAPACK, or sparse by the block Cholesky of `laplacian`.

Unknowns that no node has are left out of the dense matrix; in the sparse one they are rows of the identity,
and blocks are only as large as the largest node (3 where rotations are held).
"""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from sfm_shapefit.adjustment.layout import SLOTS, Layout
from sfm_shapefit.adjustment.options import AdjustmentOptions
from sfm_shapefit.adjustment.schur import ReducedSystem
from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.base.scipy_parts import dpotrf, dpotri, dpotrs
from sfm_shapefit.laplacian.cholesky import (
    PIVOT_TOLERANCE,
    CholeskyFactor,
    allocate_factor,
    analyze,
)
from sfm_shapefit.laplacian.selected import selected_inverse

_UNDETERMINED = "the observations do not determine all cameras; fix some, or give priors"
_DENSE_LIMIT = 3000  # unknowns: 500 free cameras


class ReducedFactor(Protocol):
    """Factors reduced systems of one structure, one after the other."""

    def refactor(self, system: ReducedSystem) -> None:
        """Factor a system; raise UnsolvableError if it is not positive definite to working precision."""

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the solutions (N, 6, r) for right-hand sides (N, 6, r); 0 for what is no unknown."""

    def inverse_blocks(self) -> FloatArray:
        """Return the diagonal blocks of the inverse, (N, 6, 6); 0 for what is no unknown."""


def choose_factor(layout: Layout, options: AdjustmentOptions) -> ReducedFactor:
    """Return an empty factor of the kind that the options ask for."""
    dense = options.linear_solver == "dense" or (
        options.linear_solver == "auto" and layout.num_unknowns <= _DENSE_LIMIT
    )
    return DenseFactor.plan(layout) if dense else SparseFactor.plan(layout, options.threads)


@dataclass(slots=True, eq=False)
class DenseFactor:
    """One dense matrix, its lower triangle."""

    rows: IntArray
    """(N, 6) row of each slot, -1 if it is no unknown."""
    pair_nodes: IntArray
    """(P, 2)"""
    matrix: FloatArray
    """(u, u) the system, then its factor; columns contiguous."""

    @classmethod
    def plan(cls, layout: Layout) -> "DenseFactor":
        """Number the unknowns."""
        rows = np.where(layout.active, np.cumsum(layout.active).reshape(layout.active.shape) - 1, -1)
        size = layout.num_unknowns
        return cls(rows, layout.pairs, np.empty((size, size), order="F"))

    def refactor(self, system: ReducedSystem) -> None:
        """Factor a system."""
        self.matrix[:] = 0.0
        _fill(self.rows, self.pair_nodes, system.diagonal, system.pairs, self.matrix.T)
        before = np.diag(self.matrix).copy()
        with one_blas_thread():
            self.matrix, info = dpotrf(self.matrix, lower=1, clean=0, overwrite_a=1)
        _refuse_singular(bool(info), np.diag(self.matrix) ** 2 / before if not info else before)

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve for right-hand sides (N, 6, r)."""
        unknown = self.rows >= 0
        out = np.zeros(right.shape)
        if unknown.any():
            with one_blas_thread():
                out[unknown], _ = dpotrs(self.matrix, right[unknown], lower=1)
        return out

    def inverse_blocks(self) -> FloatArray:
        """Invert the whole matrix and take its diagonal blocks."""
        out = np.zeros((*self.rows.shape, SLOTS))
        if not (self.rows >= 0).any():
            return out
        with one_blas_thread():
            inverse, _ = dpotri(self.matrix, lower=1)
        for node, rows in enumerate(self.rows):
            slots = np.flatnonzero(rows >= 0)
            taken = rows[slots]
            lower = np.tril(inverse[np.ix_(taken, taken)])
            out[node][np.ix_(slots, slots)] = lower + np.tril(lower, -1).T
        return out


@dataclass(slots=True, eq=False)
class SparseFactor:
    """A multifrontal factor with a block for each node and each pair."""

    factor: CholeskyFactor
    pair_nodes: IntArray
    """(P, 2)"""
    unknown: FloatArray
    """(N, 6) 1 where a slot is an unknown."""

    @classmethod
    def plan(cls, layout: Layout, threads: int) -> "SparseFactor":
        """Order the nodes and plan the factorisation."""
        block = int(layout.active.any(axis=0).sum())
        symbolic = analyze(layout.num_nodes, layout.pairs)
        return cls(
            allocate_factor(symbolic, block, threads=threads), layout.pairs, layout.active.astype(np.float64)
        )

    def refactor(self, system: ReducedSystem) -> None:
        """Factor a system."""
        b = self.factor.block
        diagonal, pairs = system.diagonal[:, :b, :b], system.pairs[:, :b, :b]
        if not self.factor.refactor_blocks(self.pair_nodes, diagonal, pairs):
            raise UnsolvableError(_UNDETERMINED)

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve for right-hand sides (N, 6, r)."""
        b = self.factor.block
        out = np.zeros(right.shape)
        out[:, :b] = self.factor.solve(np.ascontiguousarray(right[:, :b]))
        return out * self.unknown[:, :, None]

    def inverse_blocks(self) -> FloatArray:
        """Return the selected entries of the inverse."""
        b = self.factor.block
        out = np.zeros((*self.unknown.shape, SLOTS))
        out[:, :b, :b] = selected_inverse(self.factor, self.pair_nodes).nodes
        return out * self.unknown[:, :, None] * self.unknown[:, None, :]


def _refuse_singular(failed: bool, pivots: FloatArray) -> None:
    """Raise UnsolvableError if the factorisation failed or a relative pivot is rounding."""
    least = float(pivots.min(initial=1.0))
    if failed or not least > PIVOT_TOLERANCE * np.finfo(np.float64).eps:
        raise UnsolvableError(_UNDETERMINED)


@kernel
def _fill(rows: Any, pair_nodes: Any, diagonal: Any, pairs: Any, columns: Any) -> None:
    """Write the lower triangle of a matrix, given by its contiguous columns."""
    for i in range(len(rows)):
        for c in range(SLOTS):
            for a in range(c, SLOTS):
                if rows[i, a] >= 0 and rows[i, c] >= 0:
                    columns[rows[i, c], rows[i, a]] = diagonal[i, a, c]
    for k in range(len(pair_nodes)):
        i, j = pair_nodes[k, 0], pair_nodes[k, 1]
        for c in range(SLOTS):
            for a in range(SLOTS):
                if rows[i, c] >= 0 and rows[j, a] >= 0:
                    columns[rows[i, c], rows[j, a]] = pairs[k, c, a]
