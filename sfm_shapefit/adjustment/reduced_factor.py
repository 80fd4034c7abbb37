"""The reduced system factored: as one dense matrix, or sparse by the block Cholesky of `laplacian`.

Steps may be solved without a factor of the whole, see `iterative_factor`.

Unknowns that no node has are left out of the dense matrix; in the sparse one they are rows of the identity,
and blocks are only as large as the largest node (3 where rotations are held).

For steps the sparse factor has 32 bits, and conjugate gradients by the system itself lead from there to the
answer of 64: half the memory, the largest of an adjustment, and two thirds of the time, for 9 to 14 products
on 10,000 images. Where that does not lead there, the factor gets 64 bits, and keeps them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.layout import SLOTS, Layout
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.adjustment.schur import UNDETERMINED, ReducedSystem
from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.base.scipy_parts import dpotrs
from sfm_shapefit.laplacian.approximate import conjugate_gradients
from sfm_shapefit.laplacian.cholesky import factor_by_strips
from sfm_shapefit.laplacian.dense import PIVOT_TOLERANCE, blas_of, trsm
from sfm_shapefit.laplacian.factor import Factor, FactorPlan, allocate_factor, analyze
from sfm_shapefit.laplacian.operators import Workers

_DENSE_LIMIT = 3000  # unknowns: 500 free cameras
_NODES_AT_ONCE = 32  # nodes whose columns of the inverse are one job; BLAS is slow on fewer columns
# Residual of a solve, relative to its right-hand side, and products that may lead there; a factor of 64 bits
# takes as long as 25 to 40 of them.
_RESIDUAL, _MOST_PRODUCTS = 1e-11, 40
# Share of the diagonal that a factor of 32 bits is given more: of motions that nothing holds but the damping,
# rounding would leave nothing.
_RIDGE = 1e-7


class ReducedFactor(Protocol):
    """Factors reduced systems of one structure, one after the other."""

    def refactor(self, system: ReducedSystem) -> None:
        """Take a system; raise UnsolvableError if it is not positive definite to working precision."""

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the solutions (N, 6, r) for right-hand sides (N, 6, r); 0 for what is no unknown."""
        ...

    def give_back(self) -> None:
        """Give up what is large, until the next system."""


class InvertedFactor(ReducedFactor, Protocol):
    """One that knows entries of the inverse."""

    def inverse_blocks(self) -> FloatArray:
        """Return the diagonal blocks of the inverse, (N, 6, 6); 0 for what is no unknown."""
        ...


def choose_factor(layout: Layout, options: AdjustmentOptions) -> InvertedFactor:
    """Return an empty factor as the options ask, dense without unknowns; sparse where steps are iterative."""
    is_dense = _is_dense(layout, options)
    return (
        DenseFactor.plan(layout, options.threads)
        if is_dense
        else SparseFactor.of(layout, options.threads, np.float64)
    )


def choose_solver(
    problem: AdjustmentProblem,
    layout: Layout,
    options: AdjustmentOptions,
    workers: Workers,
    *,
    is_divided: bool = False,
) -> ReducedFactor:
    """Return what the systems of steps are solved with, as the options ask; iterative where divided."""
    if _is_dense(layout, options):
        return DenseFactor.plan(layout, options.threads)
    if options.linear_solver == "iterative" or (is_divided and options.linear_solver == "auto"):
        from sfm_shapefit.adjustment.iterative_factor import IterativeFactor  # here: few ask for it

        return IterativeFactor(problem, layout, workers)
    return SparseFactor.of(layout, options.threads, np.float32)


def _is_dense(layout: Layout, options: AdjustmentOptions) -> bool:
    most = {"auto": _DENSE_LIMIT, "dense": np.inf}.get(options.linear_solver, 0)
    return layout.num_unknowns <= most


@dataclass(slots=True, eq=False)
class DenseFactor:
    """One dense matrix, its lower triangle."""

    rows: IntArray
    """(N, 6) row of each slot, -1 if it is no unknown."""
    pair_nodes: IntArray
    """(P, 2)"""
    matrix: FloatArray
    """(u, u) the system, then its factor; columns contiguous."""
    workers: Workers

    @classmethod
    def plan(cls, layout: Layout, threads: int) -> "DenseFactor":
        """Number the unknowns."""
        rows = np.where(layout.active, np.cumsum(layout.active).reshape(layout.active.shape) - 1, -1)
        size = layout.num_unknowns
        return cls(rows, layout.pairs, np.empty((size, size), order="F"), Workers(threads))

    def refactor(self, system: ReducedSystem) -> None:
        """Factor a system; raise UnsolvableError if it is not positive definite to working precision."""
        self.matrix[:] = 0.0
        _fill(self.rows, self.pair_nodes, system.diagonal, system.pairs, self.matrix.T)
        before = np.diag(self.matrix).copy()
        with one_blas_thread():
            size, matrix = len(self.matrix), self.matrix
            info = factor_by_strips((matrix.ctypes.data, size), size, matrix.dtype, self.workers)
        _refuse_singular(bool(info), np.diag(self.matrix) ** 2 / before if not info else before)

    def solve(self, right: FloatArray) -> FloatArray:
        """Return the solutions (N, 6, r) for right-hand sides (N, 6, r); 0 for what is no unknown."""
        unknown = self.rows >= 0
        out = np.zeros(right.shape)
        if unknown.any():
            with one_blas_thread():
                out[unknown], _ = dpotrs(self.matrix, right[unknown], lower=1)
        return out

    def inverse_blocks(self) -> FloatArray:
        """Return the diagonal blocks of the inverse, (N, 6, 6); 0 for what is no unknown."""
        out = np.zeros((*self.rows.shape, SLOTS))

        def job(begin: int, end: int) -> Callable[[], object]:
            return lambda: self._write_inverse(begin, end, out)

        count = len(self.rows)
        with one_blas_thread():
            begins = range(0, count, _NODES_AT_ONCE)
            self.workers.run([job(begin, min(begin + _NODES_AT_ONCE, count)) for begin in begins])
        return out

    def _write_inverse(self, begin: int, end: int, out: FloatArray) -> None:
        """Write the blocks of the nodes begin..end-1: products of columns of L^-1, zero above these nodes."""
        size, slots = len(self.matrix), int((self.rows >= 0).any(axis=0).sum())
        own = self.rows[begin:end, :slots].ravel()
        unknown = np.flatnonzero(own >= 0)
        if not len(unknown):
            return
        first = int(own[unknown[0]])
        columns = np.zeros((size - first, len(own)))  # columns of L^-1 without the rows above, which are zero
        columns[own[unknown] - first, unknown] = 1.0
        triangle = self.matrix.ctypes.data + first * (size + 1) * self.matrix.itemsize, size
        shape = len(own), size - first
        trsm(blas_of(np.float64), triangle, (columns.ctypes.data, len(own)), *shape)
        by_node = columns.reshape(size - first, end - begin, slots)
        blocks = by_node.transpose(1, 2, 0) @ by_node.transpose(1, 0, 2)
        out[begin:end, :slots, :slots] = 0.5 * (blocks + blocks.transpose(0, 2, 1))

    def give_back(self) -> None:
        """Keep the matrix, which is small."""


@dataclass(slots=True, eq=False)
class SparseFactor:
    """A multifrontal factor with a block for each node and each pair."""

    plan: FactorPlan
    block: int
    """Slots of the largest node."""
    dtype: npt.DTypeLike
    """That of the factor, until 32 bits do not suffice."""
    threads: int
    pair_nodes: IntArray
    """(P, 2)"""
    unknown: FloatArray
    """(N, 6) 1 where a slot is an unknown."""
    factor: Factor | None = None
    system: ReducedSystem | None = None
    """What is factored, while the factor has 32 bits."""

    @classmethod
    def of(cls, layout: Layout, threads: int, dtype: npt.DTypeLike) -> "SparseFactor":
        """Order the nodes and plan the factorisation."""
        plan, block = analyze(layout.num_nodes, layout.pairs), int(layout.active.any(axis=0).sum())
        return cls(plan, block, dtype, threads, layout.pairs, layout.active.astype(np.float64))

    def refactor(self, system: ReducedSystem) -> None:
        """Factor a system."""
        if self.factor is None:
            self.factor = allocate_factor(self.plan, self.block, self.dtype, threads=self.threads)
        b, is_full = self.block, self.dtype == np.float64
        self.system, diagonal = None if is_full else system, system.diagonal[:, :b, :b].copy()
        np.einsum("naa->na", diagonal)[:] *= 1.0 if is_full else 1.0 + _RIDGE
        if self.factor.refactor_blocks(diagonal, system.pairs[:, :b, :b]):
            return
        if is_full:
            raise UnsolvableError(UNDETERMINED)
        self._refactor_in_full(system)

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve for right-hand sides (N, 6, r)."""
        b, out = self.block, np.zeros(right.shape)
        assert self.factor is not None
        if self.system is None:
            out[:, :b] = self.factor.solve(np.ascontiguousarray(right[:, :b]))
            return out * self.unknown[:, :, None]
        for k in range(right.shape[2]):
            found = conjugate_gradients(
                self._apply, self.factor, right[:, :b, k],
                tol=_RESIDUAL, max_iterations=_MOST_PRODUCTS, coupled_nodes=0,
            )  # fmt: skip
            if not found.converged:
                self._refactor_in_full(self.system)
                return self.solve(right)
            out[:, :b, k] = found.x
        return out * self.unknown[:, :, None]

    def _refactor_in_full(self, system: ReducedSystem) -> None:
        """Factor a system with 64 bits, as all that follow."""
        self.factor, self.dtype = None, np.float64  # the memory goes before the next comes
        self.refactor(system)

    def give_back(self) -> None:
        """Give up the factor and the system."""
        self.factor = self.system = None

    def _apply(self, x: FloatArray) -> FloatArray:
        """Return the product of the system with x (N, b)."""
        assert self.system is not None
        return self.system.times(self.pair_nodes, x)

    def inverse_blocks(self) -> FloatArray:
        """Return the selected entries of the inverse."""
        b, out = self.block, np.zeros((*self.unknown.shape, SLOTS))
        assert self.factor is not None
        out[:, :b, :b] = self.factor.selected_inverse().nodes
        return out * self.unknown[:, :, None] * self.unknown[:, None, :]


def _refuse_singular(failed: bool, pivots: FloatArray) -> None:
    """Raise UnsolvableError if the factorisation failed or a relative pivot is rounding."""
    least = float(pivots.min(initial=1.0))
    if failed or not least > PIVOT_TOLERANCE * np.finfo(np.float64).eps:
        raise UnsolvableError(UNDETERMINED)


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
