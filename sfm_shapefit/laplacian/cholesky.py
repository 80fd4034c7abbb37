"""Sparse Cholesky factorization of graph Laplacians, scalar (n x n) and in b x b blocks (nb x nb).

The factorization is multifrontal (Duff, Reid 1983; Liu 1992, "The multifrontal method for sparse matrix
solution"). For each supernode, children first:

    assemble   its panel from the edges' slots and from the children's update matrices
    factor     the square part, L_JJ = chol, and the rows below, L_RJ = A_RJ L_JJ^-T
    update     U = -L_RJ L_RJ^T + what the children leave for later fronts, kept on a stack

What depends on the graph alone is planned once (`analyze`); `refactor` takes new edge weights and does not
sort. Disjoint subtrees are tasks for several threads, in the factorization and in both substitutions. A front
above them is another task, as soon as its children are done. The large ones come last, and are factored by
strips of columns. Threads share many right-hand sides instead of the tree. What is summed, and in which
order, depends on the graph alone, and so does every bit of the answer.

A Laplacian is singular: constants are its null space. The mean weight is added to the last pivot instead of
removing a row. For right-hand sides orthogonal to the constants the answer is exact, the one that is 0 at
the last node.

Cholesky does not fail on a singular matrix: rounding makes the zero pivot a tiny number of either sign and
the answer garbage. Each pivot is therefore compared with the diagonal entry it came from; their smallest
ratio, `smallest_pivot`, is of the order of the rounding unit where the graph is disconnected or not rigid.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import BoolArray, FloatArray, Int32Array, IntArray, frozen
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.jit import array_address, inner_kernel, kernel, multiply_in_lanes
from sfm_shapefit.laplacian.dense import PIVOT_TOLERANCE, Blas, Block, blas_of, gemm, potrf, syrk, trsm
from sfm_shapefit.laplacian.front_memory import FrontMemory
from sfm_shapefit.laplacian.operators import Workers
from sfm_shapefit.laplacian.selected import SelectedInverse, selected_inverse
from sfm_shapefit.laplacian.symbolic import SymbolicFactor

_LARGE_FRONT = 768  # rows of a front above the tasks; smaller ones give threads too little to share
_STRIP = 256  # columns; of fewer, products are slower
_COLUMNS = 8  # right-hand sides of one pass over the factor; of more, what is at work leaves the cache
# Operations of a factorization, and products of a substitution, that take a third of a millisecond or more on
# each of two threads; with fewer, handing out the work costs more than it saves.
_FACTOR_WORTH_THREADS, _SOLVE_WORTH_THREADS = 1e8, 2e6

# What is done with a front, one after the other.
_ASSEMBLE, _FACTOR, _PASS_ON = range(3)


class _Tree(NamedTuple):
    """Where the numbers of a factor belong, as the kernels take it: read-only arrays of the plan."""

    b: int
    first: IntArray
    row_pointers: IntArray
    rows: Int32Array
    panel_pointers: IntArray
    relative: Int32Array
    child_pointers: IntArray
    children: IntArray

    @classmethod
    def of(cls, plan: SymbolicFactor, b: int) -> "_Tree":
        """Return that of a plan for b x b blocks."""
        return cls(
            b, plan.first, plan.row_pointers, plan.rows, plan.panel_pointers, plan.relative,
            plan.child_pointers, plan.children,
        )  # fmt: skip


class _Input(NamedTuple):
    """What fronts are assembled from, of one type in either precision; arrays but offsets are read-only."""

    tree: _Tree
    update_offsets: IntArray
    edge_pointers: IntArray
    edge_index: Int32Array
    edge_row: Int32Array
    edge_column: Int32Array
    is_turned: BoolArray
    sign: float
    """1 if the entries beside the diagonal are minus the weights, which are symmetric; -1 if they are these,
    to be transposed where an edge is turned."""
    weights: FloatArray
    """(m, b^2)"""
    diagonal: FloatArray
    """(n, b^2) in elimination order."""


@dataclass(slots=True, eq=False)
class CholeskyFactor:
    """Numeric factor of one Laplacian: memory that `refactor` overwrites and `solve` reads."""

    plan: SymbolicFactor
    block: int
    """Size b of the blocks; 1 for the scalar graph Laplacian."""
    panels: npt.NDArray[Any]
    """All panels of L, float32 or float64."""
    smallest_pivot: float = 0.0
    """Least ratio of a pivot to its diagonal entry, in (0, 1]; near the rounding unit if singular."""
    weakest_node: int = -1
    """The node of that pivot."""
    workers: Workers = field(repr=False, default_factory=lambda: Workers(1))
    """The threads of `refactor` and `solve`."""
    _diagonal: FloatArray = field(repr=False, default_factory=lambda: np.empty(0))
    _fronts: "_Fronts | None" = field(repr=False, default=None)
    """How they are factored; None before the first time."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Precision of the factor."""
        return self.panels.dtype

    def refactor(self, weights: FloatArray, ground: float | None = None) -> None:
        """Factor the Laplacian with new edge weights, in place.

        Args:
            weights: (m,) for block 1, else (m, b, b) symmetric positive semidefinite blocks.
            ground: added to the last pivot (times the identity); the mean diagonal weight if None.

        Raises:
            UnsolvableError: if a pivot is not positive to working precision: the graph is disconnected, or (b
                > 1) not rigid under these weights, or a weight is negative or not finite. The factor is
                unusable then.
        """
        plan, b = self.plan, self.block
        shape = (plan.num_edges,) if b == 1 else (plan.num_edges, b, b)
        if np.shape(weights) != shape:
            raise ValueError(f"weights have shape {np.shape(weights)}, this factor takes {shape}")
        given = self._input(np.ascontiguousarray(weights, dtype=np.float64))
        _sum_at_nodes(given)
        traces = self._diagonal[:, :: b + 1]
        traces[-1] += float(traces.mean()) if ground is None else ground
        if not self._factor(given):
            raise UnsolvableError(
                f"the Laplacian is singular at node {self.weakest_node} (relative pivot "
                f"{self.smallest_pivot:.1e}); the graph is disconnected or not rigid there, or its weights "
                "are not positive"
            )

    def refactor_blocks(self, diagonal: FloatArray, off_diagonal: FloatArray) -> bool:
        """Factor a symmetric matrix with blocks of its own at the nodes and edges, in place.

        Returns whether it is positive definite to working precision; the factor is unusable if not.

        Args:
            diagonal: (n, b, b) symmetric blocks of the nodes.
            off_diagonal: (m, b, b) blocks (i, j) of the edges (i, j) that the factor was planned for.
        """
        return self._factor_with(diagonal, off_diagonal, -1.0)

    def refactor_alike(self, diagonal: FloatArray, weights: FloatArray) -> bool:
        """Factor the Laplacian of symmetric weights (m, b, b) with other blocks (n, b, b) at the nodes.

        Returns what `refactor_blocks` does.
        """
        return self._factor_with(diagonal, weights, 1.0)

    def _factor_with(self, diagonal: FloatArray, weights: FloatArray, sign: float) -> bool:
        self._diagonal[:] = diagonal[self.plan.permutation].reshape(self._diagonal.shape)
        return self._factor(self._input(np.ascontiguousarray(weights), sign))

    def _input(self, weights: FloatArray, sign: float = 1.0) -> _Input:
        plan, b = self.plan, self.block
        return _Input(
            _Tree.of(plan, b), plan.update_offsets, plan.edge_pointers, plan.edge_index, plan.edge_row,
            plan.edge_column, plan.is_turned, sign, frozen(weights.reshape(plan.num_edges, b * b)),
            self._diagonal,
        )  # fmt: skip

    def _factor(self, given: _Input) -> bool:
        """Factor what is given; return whether all pivots are positive to working precision."""
        if self._fronts is None:
            self._fronts = _Fronts.of(self)
        with one_blas_thread():
            failed, pivot = _factor_all(self, given, self._fronts)
        self.smallest_pivot = float(pivot[0])
        self.weakest_node = int(self.plan.permutation[int(pivot[1]) // self.block])
        return not failed and bool(pivot[0] > PIVOT_TOLERANCE * np.finfo(self.dtype).eps)

    def log_determinant(self) -> float:
        """Return the logarithm of the determinant of the factored matrix, its grounding included."""
        plan, b, total = self.plan, self.block, 0.0
        widths = np.diff(plan.first) * b
        heights = np.diff(plan.row_pointers) * b
        for s, (width, below) in enumerate(zip(widths.tolist(), heights.tolist(), strict=True)):
            panel = self.panels[int(plan.panel_pointers[s]) * b * b :][: width * (width + below)]
            total += float(np.log(panel[:: width + below + 1][:width]).sum())
        return 2.0 * total

    def selected_inverse(self) -> SelectedInverse:
        """Return the blocks of the inverse at nodes and edges; see `laplacian.selected`."""
        return selected_inverse(self.plan, self.block, self.panels, self._useful_workers())

    def _useful_workers(self) -> Workers:
        """Return the threads, or one where handing them work on fronts costs more than it saves."""
        worthwhile = self.plan.flops * self.block**3 >= _FACTOR_WORTH_THREADS
        return self.workers if worthwhile else Workers(1)

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Return x with L x = rhs, with x = 0 at the grounded node, in float64.

        `rhs` is (n,) or (n, k) for block 1, else (n, b) or (n, b, k). Each right-hand side must be orthogonal
        to the constants (of each of the b components).
        """
        plan, b = self.plan, self.block
        n = plan.num_nodes
        lead = (n,) if b == 1 else (n, b)
        if np.shape(rhs)[: len(lead)] != lead or np.ndim(rhs) > len(lead) + 1:
            raise ValueError(f"rhs has shape {np.shape(rhs)}, this factor takes {lead} or {(*lead, 'k')}")
        given = np.asarray(rhs, dtype=np.float64).reshape(n, b, -1)
        out, count = np.empty_like(given), given.shape[2]
        parts = max(-(-count // _COLUMNS), 1)

        def solve(part: int) -> None:
            columns = slice(count * part // parts, count * (part + 1) // parts)
            x = np.ascontiguousarray(given[plan.permutation, :, columns].reshape(n * b, -1).T, self.dtype)
            _substitute(self, x, shares=parts == 1)
            out[plan.permutation, :, columns] = x.T.reshape(n, b, -1)

        self.workers.run([partial(solve, part) for part in range(parts)])
        return out.reshape(np.shape(rhs))


class _Fronts(NamedTuple):
    """Who factors which fronts, and where their updates lie."""

    memory: FrontMemory
    is_large: BoolArray  # (S,) fronts that are factored by strips
    own: list[int]  # units that one thread does each, ascending
    needs: list[list[int]]  # for each of them the places among them of those that it waits for
    shared: list[int]  # units that have a large front, or wait for one: all threads do these at the end

    @classmethod
    def of(cls, factor: CholeskyFactor) -> "_Fronts":
        """Return those of a factor."""
        plan, memory = factor.plan, FrontMemory(factor.plan, factor._useful_workers().threads)
        is_large = (np.diff(plan.first) + np.diff(plan.row_pointers)) * factor.block >= _LARGE_FRONT
        for begin, end in plan.tasks:
            is_large[begin:end] = False
        is_shared = np.zeros(len(plan.needs), np.bool_)
        is_shared[plan.unit_of[is_large]] = True
        for unit, below in enumerate(plan.needs):
            is_shared[unit] |= is_shared[list(below)].any()
        own, place = np.flatnonzero(~is_shared).tolist(), np.cumsum(~is_shared) - 1
        needs = [place[list(plan.needs[unit])].tolist() for unit in own]
        return cls(memory, is_large, own, needs, np.flatnonzero(is_shared).tolist())


def _factor_all(factor: CholeskyFactor, given: _Input, fronts: _Fronts) -> tuple[bool, FloatArray]:
    """Factor all supernodes; return whether a pivot was not positive, and the least pivot and its row."""
    plan, memory = factor.plan, fronts.memory
    memory.begin()
    units, given = memory.units, given._replace(update_offsets=memory.offsets)
    stack = np.empty(memory.size * factor.block**2, dtype=factor.dtype)  # holds update matrices
    if memory.num_arenas == 1:
        whole, pivot = (0, plan.num_supernodes), np.full(2, np.inf)
        return _factor_unit(factor, given, stack, whole, fronts.is_large, pivot), pivot
    pivots, failed = np.full((len(units), 2), np.inf), np.zeros(len(units), np.bool_)

    def factor_unit(unit: int) -> None:
        if any(failed[below] for below in plan.needs[unit]):
            failed[unit] = True
            return
        with memory.room(unit, memory.leaving[unit], memory.entering[unit]):
            run = units[unit].tolist()
            failed[unit] = _factor_unit(factor, given, stack, run, fronts.is_large, pivots[unit])

    factor.workers.run_after([partial(factor_unit, unit) for unit in fronts.own], fronts.needs)
    for unit in fronts.shared:
        factor_unit(unit)
    return bool(failed.any()), pivots[np.argmin(pivots[:, 0])]


def _factor_unit(
    factor: CholeskyFactor, given: _Input, stack: npt.NDArray[Any], unit: Sequence[int], is_large: BoolArray,
    pivot: Any,
) -> bool:  # fmt: skip
    """Factor supernodes begin..end-1, the large ones by strips; return whether a pivot was not positive."""

    def run(first: int, last: int, from_step: int, to_step: int) -> bool:
        blas = blas_of(factor.dtype)
        return _factorize(first, last, from_step, to_step, given, factor.panels, stack, pivot, blas)

    at, end = unit
    for s in [*(np.flatnonzero(is_large[at:end]) + at).tolist(), end]:
        if at < s and run(at, s, _ASSEMBLE, _PASS_ON):
            return True
        if s < end:
            run(s, s + 1, _ASSEMBLE, _ASSEMBLE)
            if _factor_large(factor, given, stack, s, pivot):
                return True
            run(s, s + 1, _PASS_ON, _PASS_ON)
        at = s + 1
    return False


def _factor_large(factor: CholeskyFactor, given: _Input, stack: npt.NDArray[Any], s: int, pivot: Any) -> bool:
    """Factor one assembled front by strips of columns, and write its update, in parallel jobs."""
    plan, b, workers, dtype = factor.plan, factor.block, factor.workers, factor.dtype
    width = int(plan.first[s + 1] - plan.first[s]) * b
    height = width + int(plan.row_pointers[s + 1] - plan.row_pointers[s]) * b
    below, size = height - width, factor.panels.itemsize
    panel = factor.panels.ctypes.data + int(plan.panel_pointers[s]) * b * b * size
    update = stack.ctypes.data + int(given.update_offsets[s]) * b * b * size
    info = factor_by_strips((panel, height), width, dtype, workers)
    if info != 0:
        pivot[:] = 0.0, plan.first[s] * b + info - 1
        return True

    def waiting(row: int, column: int) -> Block:
        return update + (column * below + row) * size, below

    def leave(row: int) -> Callable[[], object]:
        rows = row, min(row + _STRIP, below), below
        return lambda: _subtract_strip(
            blas_of(dtype), lambda i: (panel + (width + i) * size, height), width, waiting, rows, False
        )

    workers.run([leave(row) for row in range(0, below, _STRIP)])
    return False


def factor_by_strips(panel: Block, width: int, dtype: np.dtype[Any], workers: Workers) -> int:
    """Factor the first `width` columns of a panel, its square part on top, in place.

    Returns 0, or k if the leading minor of order k is not positive. Strips of columns are factored one after
    the other, each one's update of the rest as parallel jobs. The caller holds BLAS to one thread.
    """
    (address, height), size = panel, dtype.itemsize

    def block(row: int, column: int) -> Block:
        return address + (column * height + row) * size, height

    def divide(j: int, end: int, row: int) -> Callable[[], object]:
        rows = min(_STRIP, height - row)
        return lambda: trsm(blas_of(dtype), block(j, j), block(row, j), rows, end - j)

    def subtract(j: int, end: int, row: int) -> Callable[[], object]:
        rows = row, min(row + _STRIP, width), height
        return lambda: _subtract_strip(blas_of(dtype), lambda i: block(i, j), end - j, block, rows, True)

    for j in range(0, width, _STRIP):
        end = min(j + _STRIP, width)
        info = potrf(blas_of(dtype), block(j, j), end - j)
        if info != 0:
            return j + info
        workers.run([divide(j, end, row) for row in range(end, height, _STRIP)])
        workers.run([subtract(j, end, row) for row in range(end, width, _STRIP)])
    return 0


def _subtract_strip(
    blas: Blas,
    left: Callable[[int], Block],
    depth: int,
    target: Callable[[int, int], Block],
    rows: tuple[int, int, int],
    accumulate: bool,
) -> None:
    """Subtract a strip of columns of a a^T from the lower triangle of a matrix, or store it negated.

    Args:
        blas: addresses of BLAS.
        left: `a` from a row on; it has `depth` columns.
        depth: see `left`.
        target: the matrix from a row and a column on.
        rows: where the strip's columns, and so its rows, begin; where the columns end; where the rows end.
        accumulate: whether what the strip holds counts.
    """
    row, last, bottom = rows
    syrk(blas, left(row), last - row, depth, target(row, row), accumulate)
    if last < bottom:
        shape = bottom - last, last - row, depth
        gemm(blas, left(last), left(row), shape, target(last, row), accumulate)


@kernel
def _sum_at_nodes(given: Any) -> None:
    """Write the diagonal blocks of the Laplacian, in elimination order: sums over incident edges."""
    first, row_pointers, rows = given.tree.first, given.tree.row_pointers, given.tree.rows
    begin, index, row, column = given.edge_pointers, given.edge_index, given.edge_row, given.edge_column
    weights, diagonal = given.weights, given.diagonal
    diagonal[:] = 0.0
    for s in range(len(first) - 1):
        start, width = first[s], first[s + 1] - first[s]
        for k in range(begin[s], begin[s + 1]):
            i = start + column[k]
            j = start + row[k] if row[k] < width else rows[row_pointers[s] + row[k] - width]
            e = index[k]
            for a in range(weights.shape[1]):
                w = weights[e, a]
                diagonal[i, a] += w
                diagonal[j, a] += w


@kernel
def _factorize(
    begin: int, end: int, from_step: int, to_step: int, given: Any, panels: Any, stack: Any, pivot: Any,
    blas: Any,
) -> bool:  # fmt: skip
    """Take the supernodes begin..end-1 through some steps; return True if a pivot was not positive.

    `pivot` is lowered to the least ratio of a squared pivot to its diagonal entry and the row it stands in.
    """
    tree, diagonal, weights = given.tree, given.diagonal, given.weights
    b, first, row_pointers = tree.b, tree.first, tree.row_pointers
    index, row, column = given.edge_index, given.edge_row, given.edge_column
    size = panels.itemsize
    for s in range(begin, end):
        start, width = first[s] * b, (first[s + 1] - first[s]) * b
        below = (row_pointers[s + 1] - row_pointers[s]) * b
        height = width + below
        offset = tree.panel_pointers[s] * b * b
        panel = panels[offset : offset + width * height]
        update = given.update_offsets[s] * b * b
        for step in range(from_step, to_step + 1):
            if step == _FACTOR:
                square = array_address(panels) + offset * size, height
                info = potrf(blas, square, width)
                if info != 0:
                    pivot[0] = 0.0
                    pivot[1] = start + info - 1
                    return True
                rest = square[0] + width * size, height
                trsm(blas, square, rest, below, width)
                mine = array_address(stack) + update * size, max(below, 1)
                syrk(blas, rest, below, width, mine, False)
                continue
            if step == _ASSEMBLE:
                panel[:] = 0.0
                for k in range(given.edge_pointers[s], given.edge_pointers[s + 1]):
                    e = index[k]
                    by_column, by_row = (1, b) if given.sign < 0.0 and given.is_turned[e] else (b, 1)
                    for c in range(b):
                        at = (column[k] * b + c) * height + row[k] * b
                        for a in range(b):
                            panel[at + a] -= given.sign * weights[e, c * by_column + a * by_row]
                for i in range(width * b):
                    q = i // b
                    node = q // b
                    panel[q * height + node * b + i - q * b] += diagonal[first[s] + node, i - node * b * b]
                target, leading, lowest, highest = panel, height, 0, width // b
            else:
                for q in range(width):
                    root, node = panel[q * height + q], q // b
                    ratio = root * root / diagonal[first[s] + node, (q - node * b) * (b + 1)]
                    if not ratio >= pivot[0]:
                        pivot[0] = ratio
                        pivot[1] = start + q
                target, leading = stack[update : update + below * below], below
                lowest, highest = width // b, height // b
            _add_children(s, given, stack, lowest, highest, target, leading)
    return False


@inner_kernel
def _add_children(
    s: int, given: Any, stack: Any, lowest: int, highest: int, target: Any, leading: int
) -> None:
    """Add the columns of the children's updates that go to the columns lowest..highest-1 of a front.

    `target` starts at row and column `lowest`. Consecutive rows mostly stay consecutive and are added as
    vectors.
    """
    tree, b = given.tree, given.tree.b
    for k in range(tree.child_pointers[s], tree.child_pointers[s + 1]):
        child = tree.children[k]
        # Where the child's rows are in this front.
        there = tree.relative[tree.row_pointers[child] : tree.row_pointers[child + 1]]
        size = len(there)
        run_end = np.empty(size, np.int64)
        for i in range(size - 1, -1, -1):
            joined = i + 1 < size and there[i + 1] == there[i] + 1
            run_end[i] = run_end[i + 1] if joined else i + 1
        for j in range(size):
            if there[j] < lowest or there[j] >= highest:
                continue
            for c in range(b):
                source = given.update_offsets[child] * b * b + (j * b + c) * size * b
                into = ((there[j] - lowest) * b + c) * leading
                i = j
                skip = c  # the part of the diagonal block above the diagonal was never written
                while i < size:
                    at = into + (there[i] - lowest) * b
                    sums = target[at + skip : at + (run_end[i] - i) * b]
                    values = stack[source + i * b + skip : source + run_end[i] * b]
                    for p in range(len(sums)):
                        sums[p] += values[p]
                    i = run_end[i]
                    skip = 0


def _substitute(factor: CholeskyFactor, x: npt.NDArray[Any], *, shares: bool) -> None:
    """Solve L L^T y = x in place for right-hand sides, the rows of x; threads may share the tree."""
    plan, b = factor.plan, factor.block
    updates = np.empty((len(x), len(plan.rows) * b), x.dtype)
    tree = _Tree.of(plan, b)

    def descend(begin: int, end: int) -> None:
        _descend(begin, end, tree, factor.panels, x, updates)

    def ascend(begin: int, end: int) -> None:
        _ascend(begin, end, tree, factor.panels, x)

    if not shares or plan.num_entries * b * b * len(x) < _SOLVE_WORTH_THREADS or factor.workers.threads == 1:
        descend(0, plan.num_supernodes)
        ascend(0, plan.num_supernodes)
        return
    units = plan.units.tolist()
    factor.workers.run_after([partial(descend, *unit) for unit in units], plan.needs)
    factor.workers.run_after([partial(ascend, *unit) for unit in units[::-1]], plan.needs_back())


@inner_kernel
def _tallest(begin: int, end: int, tree: Any) -> int:
    """Return the most rows of a panel of the supernodes begin..end-1."""
    columns, rows, most = tree.first, tree.row_pointers, 0
    for s in range(begin, end):
        most = max(most, columns[s + 1] - columns[s] + rows[s + 1] - rows[s])
    return most * int(tree.b)


@inner_kernel
def _copy(source: Any, begin: int, target: Any, start: int, count: int) -> None:
    """Copy so many numbers of each row of an array to another."""
    for k in range(len(source)):
        for i in range(count):
            target[k, start + i] = source[k, begin + i]


@kernel
def _descend(begin: int, end: int, tree: Any, panels: Any, x: Any, updates: Any) -> None:
    """Solve with the panels of the supernodes begin..end-1, for each row of x.

    What a supernode takes from rows above it waits in `updates` until its parent adds it. The rows below a
    block of four columns take all four at once. The last block may overlap the one before, whose columns then
    count 0.
    """
    b, first, row_pointers = tree.b, tree.first, tree.row_pointers
    work, zero = np.empty((len(x), _tallest(begin, end, tree)), x.dtype), x.dtype.type(0)
    for s in range(begin, end):
        start, width = first[s] * b, (first[s + 1] - first[s]) * b
        height = width + (row_pointers[s + 1] - row_pointers[s]) * b
        offset = tree.panel_pointers[s] * b * b
        _copy(x, start, work, 0, width)
        work[:, width:height] = zero
        _add_updates(s, tree, updates, work)
        for j in range(0, width, 4):
            stop = min(j + 4, width)
            last = stop if width >= 4 else height
            for q in range(j, stop):
                column = offset + q * height
                for k in range(len(x)):
                    value = work[k, q] / panels[column + q]
                    work[k, q] = value
                    for i in range(q + 1, last):
                        work[k, i] -= panels[column + i] * value
            if width < 4:
                break
            q, column, below = stop - 4, offset + (stop - 4) * height, height - stop
            l0 = panels[column + stop : column + height]
            l1 = panels[column + height + stop : column + 2 * height]
            l2 = panels[column + 2 * height + stop : column + 3 * height]
            l3 = panels[column + 3 * height + stop : column + 4 * height]
            for k in range(len(x)):
                a0 = work[k, q] if q >= j else zero
                a1 = work[k, q + 1] if q + 1 >= j else zero
                a2 = work[k, q + 2] if q + 2 >= j else zero
                a3 = work[k, q + 3]
                u = work[k, stop:height]
                for i in range(below):
                    u[i] -= l0[i] * a0 + l1[i] * a1 + l2[i] * a2 + l3[i] * a3
        _copy(work, 0, x, start, width)
        _copy(work, width, updates, row_pointers[s] * b, height - width)


@inner_kernel
def _add_updates(s: int, tree: Any, updates: Any, work: Any) -> None:
    """Add what the children of a supernode take from its rows."""
    b = tree.b
    for p in range(tree.child_pointers[s], tree.child_pointers[s + 1]):
        child = tree.children[p]
        for r in range(tree.row_pointers[child], tree.row_pointers[child + 1]):
            at = np.int64(tree.relative[r]) * b
            for k in range(len(work)):
                for c in range(b):
                    work[k, at + c] += updates[k, r * b + c]


@kernel
def _ascend(begin: int, end: int, tree: Any, panels: Any, x: Any) -> None:
    """Solve with the transposed panels of the supernodes end-1..begin, in the blocks of `_descend`."""
    b, first, row_pointers = tree.b, tree.first, tree.row_pointers
    work, sums = np.empty((len(x), _tallest(begin, end, tree)), x.dtype), np.empty(4, x.dtype)
    for s in range(end - 1, begin - 1, -1):
        start, width = first[s] * b, (first[s + 1] - first[s]) * b
        height = width + (row_pointers[s + 1] - row_pointers[s]) * b
        offset = tree.panel_pointers[s] * b * b
        _copy(x, start, work, 0, width)
        for r in range(row_pointers[s], row_pointers[s + 1]):
            row, at = np.int64(tree.rows[r]) * b, width + (r - row_pointers[s]) * b
            for k in range(len(x)):
                for c in range(b):
                    work[k, at + c] = x[k, row + c]
        for j in range((width - 1) // 4 * 4, -1, -4):
            stop = min(j + 4, width)
            last = stop if width >= 4 else height
            for k in range(len(x)):
                if width >= 4:
                    four = offset + (stop - 4) * height + stop
                    multiply_in_lanes(panels, four, height, work[k], stop, height - stop, sums)
                    for q in range(j, stop):
                        work[k, q] -= sums[q - stop + 4]
                for q in range(stop - 1, j - 1, -1):
                    column = offset + q * height
                    total = work[k, q]
                    for i in range(q + 1, last):
                        total -= panels[column + i] * work[k, i]
                    work[k, q] = total / panels[column + q]
        _copy(work, 0, x, start, width)
