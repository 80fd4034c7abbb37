"""Sparse Cholesky factorization of graph Laplacians, scalar (n x n) and in b x b blocks (nb x nb).

The factorization is multifrontal (Duff, Reid 1983; Liu 1992, "The multifrontal method for sparse matrix
solution"). For each supernode, children first:

    assemble   its panel from the edges' slots and from the children's update matrices
    factor     the square part, L_JJ = chol, and the rows below, L_RJ = A_RJ L_JJ^-T
    update     U = -L_RJ L_RJ^T + what the children leave for later fronts, kept on a stack

What depends on the graph alone is planned once (`analyze`); `refactor` takes new edge weights and does not
sort. Disjoint subtrees are tasks for several threads, in the factorization and in both substitutions; the
large fronts above them are factored by strips of columns. Tasks and strips are the same for any number of
threads, and so is every bit of the answer.

A Laplacian is singular: constants are its null space. The mean weight is added to the last pivot instead of
removing a row. For right-hand sides orthogonal to the constants the answer is exact, the one that is 0 at
the last node.

Cholesky does not fail on a singular matrix: rounding makes the zero pivot a tiny number of either sign and
the answer garbage. Each pivot is therefore compared with the diagonal entry it came from; their smallest
ratio, `smallest_pivot`, is of the order of the rounding unit where the graph is disconnected or not rigid.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.jit import array_address, call_address, carray, inner_kernel, kernel, leaf_address
from sfm_shapefit.laplacian.dense import blas_of, gemm, one_blas_thread, potrf, syrk, trsm
from sfm_shapefit.laplacian.operators import Int32Array, Workers, adjacency, check_edges
from sfm_shapefit.laplacian.ordering import Ordering, best_order
from sfm_shapefit.laplacian.symbolic import SymbolicFactor, elimination_tree, plan_factorization

PIVOT_TOLERANCE = 64.0
"""Pivots below this many rounding units of their diagonal entry count as zero."""

# A front above the tasks of so many rows or more is factored by strips of so many columns.
_LARGE_FRONT, _STRIP = 768, 256


class _Panels(NamedTuple):
    """The panels as the kernels take them: the parts of the plan that say where each is, and the numbers."""

    b: int
    first: IntArray
    row_pointers: IntArray
    rows: Int32Array
    pointers: IntArray
    entries: npt.NDArray[Any]


class _Parts(NamedTuple):
    """What fronts are assembled from: children's updates by the plan, edges by their slots, the diagonal."""

    relative: Int32Array
    child_pointers: IntArray
    children: IntArray
    update_offsets: IntArray
    edge_pointers: IntArray
    edge_index: Int32Array
    edge_row: Int32Array
    edge_column: Int32Array
    weights: FloatArray
    """(m, b^2)"""
    diagonal: FloatArray
    """(n, b^2) in elimination order."""
    stack: npt.NDArray[Any]
    """Update matrices that wait for their parents, arenas behind them."""


@dataclass(slots=True, eq=False)
class CholeskyFactor:
    """Numeric factor of one Laplacian: memory that `refactor` overwrites and `solve` reads."""

    symbolic: SymbolicFactor
    """The plan."""
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
            UnsolvableError: if a pivot is not positive to working precision: the graph is disconnected,
                or (b > 1) not rigid under these weights, or a weight is negative or not finite. Use
                nothing of the factor then.
        """
        plan, b = self.symbolic, self.block
        shape = (plan.num_edges,) if b == 1 else (plan.num_edges, b, b)
        if np.shape(weights) != shape:
            raise ValueError(f"weights have shape {np.shape(weights)}, this factor takes {shape}")
        panels, parts = self._storage(np.ascontiguousarray(weights, dtype=np.float64))
        _sum_at_nodes(panels, parts)
        traces = self._diagonal[:, :: b + 1]
        traces[-1] += float(traces.mean()) if ground is None else ground
        if not self._factor(panels, parts):
            raise UnsolvableError(
                f"the Laplacian is singular at node {self.weakest_node} (relative pivot "
                f"{self.smallest_pivot:.1e}); the graph is disconnected or not rigid there, or its weights "
                "are not positive"
            )

    def refactor_blocks(self, edges: IntArray, diagonal: FloatArray, off_diagonal: FloatArray) -> bool:
        """Factor a symmetric matrix with blocks of its own at the nodes and edges, in place.

        Args:
            edges: (m, 2) those that the factor was planned for.
            diagonal: (n, b, b) symmetric blocks of the nodes.
            off_diagonal: (m, b, b) blocks (i, j) of the edges (i, j).

        Returns:
            Whether it is positive definite to working precision; use nothing of the factor if not.
        """
        plan, b = self.symbolic, self.block
        self._diagonal[:] = diagonal[plan.permutation].reshape(-1, b * b)
        # Weights are subtracted, with the node that is eliminated first as the column.
        weights = -off_diagonal
        i, j = plan.inverse[edges].T
        weights[i > j] = weights[i > j].transpose(0, 2, 1)
        return self._factor(*self._storage(np.ascontiguousarray(weights)))

    def _storage(self, weights: FloatArray) -> tuple[_Panels, _Parts]:
        """Return the panels, and what fronts are assembled from."""
        plan, b = self.symbolic, self.block
        panels = _Panels(b, plan.first, plan.row_pointers, plan.rows, plan.panel_pointers, self.panels)
        stack_size = (plan.stack_size + self._num_arenas * plan.arena_size) * b * b
        parts = _Parts(
            plan.relative, plan.child_pointers, plan.children, plan.update_offsets, plan.edge_pointers,
            plan.edge_index, plan.edge_row, plan.edge_column, weights.reshape(plan.num_edges, b * b),
            self._diagonal, np.empty(stack_size, dtype=self.dtype),
        )  # fmt: skip
        return panels, parts

    @property
    def _num_arenas(self) -> int:
        return min(self.workers.threads, len(self.symbolic.tasks))

    def _factor(self, panels: _Panels, parts: _Parts) -> bool:
        """Factor what was assembled; return whether all pivots are positive to working precision."""
        with one_blas_thread():
            failed, pivot = _factor_all(self, panels, parts, self._num_arenas)
        self.smallest_pivot = float(pivot[0])
        self.weakest_node = int(self.symbolic.permutation[int(pivot[1]) // self.block])
        return not failed and bool(pivot[0] > PIVOT_TOLERANCE * np.finfo(self.dtype).eps)

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Return x with L x = rhs, with x = 0 at the grounded node.

        Args:
            rhs: (n,) or (n, k) for block 1, else (n, b) or (n, b, k). Each right-hand side must be
                orthogonal to the constants (of each of the b components).

        Returns:
            Float64 of the shape of `rhs`, accurate to the precision of the factor.
        """
        plan, b = self.symbolic, self.block
        n = plan.num_nodes
        lead = (n,) if b == 1 else (n, b)
        if np.shape(rhs)[: len(lead)] != lead or np.ndim(rhs) > len(lead) + 1:
            raise ValueError(f"rhs has shape {np.shape(rhs)}, this factor takes {lead} or {(*lead, 'k')}")
        given = np.asarray(rhs, dtype=np.float64).reshape(n, b, -1)
        out = np.empty_like(given)
        for k in range(0, given.shape[2], 3):
            width = min(given.shape[2] - k, 3)
            x = np.zeros((n, b, 3), dtype=self.dtype)
            x[:, :, :width] = given[plan.permutation, :, k : k + 3]
            _substitute(self, x.reshape(n * b, 3))
            out[plan.permutation, :, k : k + 3] = x[:, :, :width]
        return out.reshape(np.shape(rhs))


def analyze(num_nodes: int, edges: npt.ArrayLike, ordering: Ordering | IntArray = "auto") -> SymbolicFactor:
    """Plan the factorization of the Laplacians of a graph, whatever their weights, block size and precision.

    Args:
        num_nodes: n >= 1.
        edges: (m, 2) node indices; repeated edges add up.
        ordering: a method of `ordering.best_order`, or an order of elimination (n,) itself.

    Returns:
        The plan. `num_nonzeros`, `flops` and `num_bytes` tell what a factorization would cost. To know that
        still earlier, and cheaper, ask `best_order` for the elimination tree alone.

    Raises:
        InputError: if an edge leaves [0, num_nodes) or joins a node with itself.
    """
    pairs = check_edges(num_nodes, edges)
    graph = adjacency(num_nodes, pairs)
    tree = best_order(graph, ordering) if isinstance(ordering, str) else elimination_tree(graph, ordering)
    return plan_factorization(graph, pairs, tree)


def allocate_factor(
    symbolic: SymbolicFactor, block: int = 1, dtype: npt.DTypeLike = np.float64, *, threads: int = 1
) -> CholeskyFactor:
    """Allocate the memory of a factor, `symbolic.num_bytes(block, dtype, threads)` while it is computed.

    Its numbers and answers do not depend on `threads`.
    """
    area = block * block
    return CholeskyFactor(
        symbolic=symbolic,
        block=block,
        panels=np.empty(int(symbolic.panel_pointers[-1]) * area, dtype=dtype),
        workers=Workers(threads),
        _diagonal=np.empty((symbolic.num_nodes, area)),
    )


def factorize(
    symbolic: SymbolicFactor,
    weights: FloatArray,
    dtype: npt.DTypeLike = np.float64,
    ground: float | None = None,
) -> CholeskyFactor:
    """Allocate a factor and compute it; see `CholeskyFactor.refactor`."""
    block = 1 if np.ndim(weights) == 1 else np.shape(weights)[1]
    factor = allocate_factor(symbolic, block, dtype)
    factor.refactor(weights, ground)
    return factor


def _factor_all(
    factor: CholeskyFactor, panels: _Panels, parts: _Parts, arenas: int
) -> tuple[bool, FloatArray]:
    """Factor all supernodes; return whether a pivot was not positive, and the least pivot and its row."""
    plan = factor.symbolic
    free = SimpleQueue[int]()
    for k in range(arenas):
        free.put(plan.stack_size + k * plan.arena_size)
    pivots = np.full((len(plan.tasks) + 1, 2), np.inf)
    failed = np.zeros(len(pivots), np.bool_)

    def task(k: int) -> Callable[[], object]:
        def run() -> None:
            begin, end = plan.tasks[k]
            arena = free.get()
            try:
                failed[k] = _factorize(begin, end, panels, parts, arena, pivots[k], blas_of(factor.dtype))
            finally:
                free.put(arena)

        return run

    done = 0
    for begin, end in [*plan.above.tolist(), [plan.num_supernodes] * 2]:
        ready = int(np.searchsorted(plan.tasks[:, 0], begin))
        factor.workers.run([task(k) for k in range(done, ready)])
        done = ready
        failed[-1] = failed.any() or _factor_above(factor, panels, parts, begin, end, pivots[-1])
        if failed[-1]:
            break
    return bool(failed.any()), pivots[np.argmin(pivots[:, 0])]


def _factor_above(
    factor: CholeskyFactor, panels: _Panels, parts: _Parts, begin: int, end: int, pivot: Any
) -> bool:
    """Factor a run of supernodes above the tasks: the large ones by strips, the others as in a task."""
    plan = factor.symbolic
    heights = np.diff(plan.first)[begin:end] + np.diff(plan.row_pointers)[begin:end]
    large = np.flatnonzero(heights * factor.block >= _LARGE_FRONT) + begin
    at = begin
    for s in [*large.tolist(), end]:
        if at < s and _factorize(at, s, panels, parts, 0, pivot, blas_of(factor.dtype)):
            return True
        if s < end and _factor_large(factor, panels, parts, s, pivot):
            return True
        at = s + 1
    return False


def _factor_large(factor: CholeskyFactor, panels: _Panels, parts: _Parts, s: int, pivot: Any) -> bool:
    """Factor one front by strips of columns, each strip's update of the rest as parallel jobs."""
    plan, b, workers = factor.symbolic, factor.block, factor.workers
    width = int(plan.first[s + 1] - plan.first[s]) * b
    height = width + int(plan.row_pointers[s + 1] - plan.row_pointers[s]) * b
    offset, update = int(plan.panel_pointers[s]) * b * b, int(plan.update_offsets[s]) * b * b
    below = height - width
    _assemble_front(s, panels, parts, 0)

    def block(row: int, column: int) -> tuple[Any, int, int]:
        return factor.panels, offset + column * height + row, height

    def divide(j: int, end: int, row: int) -> Callable[[], object]:
        rows = min(_STRIP, height - row)
        return lambda: trsm(blas_of(factor.dtype), block(j, j), block(row, j), rows, end - j)

    def subtract(j: int, end: int, row: int, last: int) -> Callable[[], object]:
        shape = height - row, last - row, end - j
        return lambda: _subtract_strip(blas_of(factor.dtype), block(row, j), shape, block(row, row), True)

    def leave(row: int) -> Callable[[], object]:
        shape = below - row, min(_STRIP, below - row), width
        target = parts.stack, update + row * (below + 1), below
        return lambda: _subtract_strip(blas_of(factor.dtype), block(width + row, 0), shape, target, False)

    for j in range(0, width, _STRIP):
        end = min(j + _STRIP, width)
        info = potrf(blas_of(factor.dtype), block(j, j), end - j)
        if info != 0:
            pivot[:] = 0.0, plan.first[s] * b + j + info - 1
            return True
        workers.run([divide(j, end, row) for row in range(end, height, _STRIP)])
        rows = range(end, width, _STRIP)
        workers.run([subtract(j, end, row, min(row + _STRIP, width)) for row in rows])
    _check_pivots(s, panels, parts, pivot)
    workers.run([leave(row) for row in range(0, below, _STRIP)])
    _pass_on(s, panels, parts, 0, update)
    return False


@kernel
def _sum_at_nodes(panels: Any, parts: Any) -> None:
    """Write the diagonal blocks of the Laplacian, in elimination order: sums over incident edges."""
    first, row_pointers, rows = panels.first, panels.row_pointers, panels.rows
    begin, index, row, column = parts.edge_pointers, parts.edge_index, parts.edge_row, parts.edge_column
    weights, diagonal = parts.weights, parts.diagonal
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
def _factorize(begin: int, end: int, panels: Any, parts: Any, arena: int, pivot: Any, blas: Any) -> bool:
    """Factor the supernodes begin..end-1; return True if a pivot was not positive.

    A task has its updates in its arena, all but the root's; above the tasks, `arena` is 0. `pivot` is lowered
    to the least relative pivot and the row it stands in.
    """
    b = panels.b
    for s in range(begin, end):
        width = (panels.first[s + 1] - panels.first[s]) * b
        below = (panels.row_pointers[s + 1] - panels.row_pointers[s]) * b
        height = width + below
        offset = panels.pointers[s] * b * b
        _assemble_front(s, panels, parts, arena)
        square = (panels.entries, offset, height)
        info = potrf(blas, square, width)
        if info != 0:
            pivot[0] = 0.0
            pivot[1] = panels.first[s] * b + info - 1
            return True
        _check_pivots(s, panels, parts, pivot)
        if below == 0:
            continue
        rest = (panels.entries, offset + width, height)
        trsm(blas, square, rest, below, width)
        update = (parts.update_offsets[s] + (arena if s < end - 1 else 0)) * b * b
        syrk(blas, rest, below, width, (parts.stack, update, below), False)
        _pass_on(s, panels, parts, arena, update)
    return False


@kernel
def _assemble_front(s: int, panels: Any, parts: Any, arena: int) -> None:
    """Write the panel of a supernode before it is factored: edges, diagonal, children's updates."""
    b, row_pointers = panels.b, panels.row_pointers
    width = (panels.first[s + 1] - panels.first[s]) * b
    height = width + (row_pointers[s + 1] - row_pointers[s]) * b
    offset = panels.pointers[s] * b * b
    panel = panels.entries[offset : offset + width * height]
    panel[:] = 0.0
    _assemble_edges(panel, height, b, s, parts)
    _assemble_diagonal(panel, height, b, panels.first[s], panels.first[s + 1], parts.diagonal)
    _add_children(s, panels, parts, arena, 0, width // b, panel, height)


@kernel
def _pass_on(s: int, panels: Any, parts: Any, arena: int, update: int) -> None:
    """Add what the children leave for later fronts to the update of s, which starts at `update`."""
    width = panels.first[s + 1] - panels.first[s]
    below = panels.row_pointers[s + 1] - panels.row_pointers[s]
    leading = below * panels.b
    mine = parts.stack[update : update + leading**2]
    _add_children(s, panels, parts, arena, width, width + below, mine, leading)


@inner_kernel
def _add_children(
    s: int, panels: Any, parts: Any, arena: int, lowest: int, highest: int, target: Any, leading: int
) -> None:
    """Add the columns of the children's updates that go to the columns lowest..highest-1 of a front."""
    b, row_pointers, stack = panels.b, panels.row_pointers, parts.stack
    for c in range(parts.child_pointers[s], parts.child_pointers[s + 1]):
        child = parts.children[c]
        there = parts.relative[row_pointers[child] : row_pointers[child + 1]]
        update = stack[(parts.update_offsets[child] + arena) * b * b :][: (len(there) * b) ** 2]
        _add_update(update, there, b, lowest, highest, target, leading)


@kernel
def _subtract_strip(blas: Any, a: Any, shape: Any, c: Any, accumulate: bool) -> None:
    """Subtract a a^T from the first columns of the lower triangle of the block c, or store -a a^T there.

    `shape` holds the rows of `a`, how many of them, the first, belong to these columns of c, and its columns.
    """
    rows, strip, columns = shape
    syrk(blas, a, strip, columns, c, accumulate)
    if rows > strip:
        lower = (a[0], a[1] + strip, a[2])
        gemm(blas, lower, a, (rows - strip, strip, columns), (c[0], c[1] + strip, c[2]), accumulate)


@inner_kernel
def _assemble_edges(panel: Any, height: int, b: int, s: int, parts: Any) -> None:
    """Subtract the edges' weights from the panel of a supernode at their slots."""
    index, row, column, weights = parts.edge_index, parts.edge_row, parts.edge_column, parts.weights
    for k in range(parts.edge_pointers[s], parts.edge_pointers[s + 1]):
        e = index[k]
        for c in range(b):
            at = (column[k] * b + c) * height + row[k] * b
            for a in range(b):
                panel[at + a] -= weights[e, c * b + a]


@inner_kernel
def _assemble_diagonal(panel: Any, height: int, b: int, start: int, stop: int, diagonal: Any) -> None:
    """Add the diagonal blocks of the nodes start..stop-1 to a panel."""
    for q in range(stop - start):
        for c in range(b):
            at = (q * b + c) * height + q * b
            for a in range(b):
                panel[at + a] += diagonal[start + q, c * b + a]


@kernel
def _check_pivots(s: int, panels: Any, parts: Any, pivot: Any) -> None:
    """Lower pivot[0] to the least ratio of a squared pivot to its diagonal entry, and note its row."""
    b, start = panels.b, panels.first[s]
    width = (panels.first[s + 1] - start) * b
    height = width + (panels.row_pointers[s + 1] - panels.row_pointers[s]) * b
    panel, diagonal = panels.entries[panels.pointers[s] * b * b :], parts.diagonal
    for k in range(width):
        root = panel[k * height + k]
        ratio = root * root / diagonal[start + k // b, (k % b) * (b + 1)]
        if not ratio >= pivot[0]:
            pivot[0] = ratio
            pivot[1] = start * b + k


@inner_kernel
def _add_update(
    update: Any, there: Any, b: int, lowest: int, highest: int, target: Any, leading: int
) -> None:
    """Add the columns of a child's update that go to the columns lowest..highest-1 of its parent's front.

    `there` maps the child's rows to the parent's; `target` starts at row and column `lowest` if that is
    not 0. Consecutive rows mostly stay consecutive and are added as vectors.
    """
    size = len(there)
    run_end = np.empty(size, np.int64)
    for i in range(size - 1, -1, -1):
        joined = i + 1 < size and there[i + 1] == there[i] + 1
        run_end[i] = run_end[i + 1] if joined else i + 1
    for j in range(size):
        if there[j] < lowest or there[j] >= highest:
            continue
        for c in range(b):
            source = (j * b + c) * size * b
            into = ((there[j] - lowest) * b + c) * leading
            i = j
            skip = c  # the part of the diagonal block above the diagonal was never written
            while i < size:
                count = (run_end[i] - i) * b
                at = into + (there[i] - lowest) * b
                _add(target[at + skip : at + count], update[source + i * b + skip : source + i * b + count])
                i = run_end[i]
                skip = 0


@inner_kernel
def _add(target: Any, values: Any) -> None:
    """Add one contiguous vector to another."""
    for i in range(len(target)):
        target[i] += values[i]


def _substitute(factor: CholeskyFactor, x: npt.NDArray[Any]) -> None:
    """Solve L L^T y = x in place for three right-hand sides: the tasks, what is above them, and back."""
    plan, b = factor.symbolic, factor.block
    outer = np.zeros((len(plan.tasks), *x.shape), dtype=x.dtype)  # what each task leaves for rows above it
    addresses = [leaf_address(leaf, factor.dtype, 3) for leaf in (_subtract_four, _multiply_four)]
    leaves = np.array(addresses, dtype=np.int64)

    def job(kernel: Any, begin: int, end: int, *rest: Any) -> Callable[[], object]:
        return lambda: kernel(
            begin, end, b, plan.first, plan.row_pointers, plan.rows, plan.panel_pointers, factor.panels, x,
            np.empty((3, plan.largest_front * b), x.dtype), leaves, np.empty(3, np.int64),
            np.empty(12, x.dtype), *rest,
        )  # fmt: skip

    factor.workers.run([job(_descend, *task, outer[k]) for k, task in enumerate(plan.tasks)])
    nodes = (plan.num_nodes, b, 3)
    for k, (_, end) in enumerate(plan.tasks):
        rows = plan.rows[plan.row_pointers[end - 1] : plan.row_pointers[end]]
        x.reshape(nodes)[rows] += outer[k].reshape(nodes)[rows]
    for run in plan.above:
        job(_descend, *run, x)()
    for run in plan.above[::-1]:
        job(_ascend, *run)()
    factor.workers.run([job(_ascend, *task) for task in plan.tasks])


@kernel
def _descend(
    begin: int, end: int, b: int, first: Any, row_pointers: Any, rows: Any, panel_pointers: Any, panels: Any,
    x: Any, work: Any, leaves: Any, sizes: Any, numbers: Any, outer: Any,
) -> None:  # fmt: skip
    """Solve with the panels of the supernodes begin..end-1; later rows than theirs are kept in `outer`."""
    for s in range(begin, end):
        height = _load_front(b, s, first, row_pointers, rows, x, work, False)
        width = (first[s + 1] - first[s]) * b
        _forward(panels, panel_pointers[s] * b * b, height, width, work, leaves, sizes, numbers)
        _store_front(b, s, first, x, work)
        _add_below(b, s, first, row_pointers, rows, first[end], x, outer, work)


@kernel
def _ascend(
    begin: int, end: int, b: int, first: Any, row_pointers: Any, rows: Any, panel_pointers: Any, panels: Any,
    x: Any, work: Any, leaves: Any, sizes: Any, numbers: Any,
) -> None:  # fmt: skip
    """Solve with the transposed panels of the supernodes end-1..begin."""
    for s in range(end - 1, begin - 1, -1):
        height = _load_front(b, s, first, row_pointers, rows, x, work, True)
        width = (first[s + 1] - first[s]) * b
        _backward(panels, panel_pointers[s] * b * b, height, width, work, leaves, sizes, numbers)
        _store_front(b, s, first, x, work)


@inner_kernel
def _load_front(
    b: int, s: int, first: Any, row_pointers: Any, rows: Any, x: Any, work: Any, with_below: bool
) -> Any:
    """Copy the unknowns of a front to `work`, 0 for the rows below if not `with_below`; return its height."""
    start, width = first[s] * b, (first[s + 1] - first[s]) * b
    for i in range(width):
        for k in range(3):
            work[k, i] = x[start + i, k]
    at = width
    for p in range(row_pointers[s], row_pointers[s + 1]):
        row = np.int64(rows[p]) * b
        for a in range(b):
            for k in range(3):
                work[k, at + a] = x[row + a, k] if with_below else 0.0
        at += b
    return at


@inner_kernel
def _store_front(b: int, s: int, first: Any, x: Any, work: Any) -> None:
    """Copy a front's own unknowns back to `x`."""
    start, width = first[s] * b, (first[s + 1] - first[s]) * b
    for i in range(width):
        for k in range(3):
            x[start + i, k] = work[k, i]


@inner_kernel
def _add_below(
    b: int, s: int, first: Any, row_pointers: Any, rows: Any, limit: int, x: Any, outer: Any, work: Any
) -> None:
    """Add what a front leaves to the rows below: to `x` if they are before `limit`, else to `outer`."""
    at = (first[s + 1] - first[s]) * b
    for p in range(row_pointers[s], row_pointers[s + 1]):
        row = np.int64(rows[p])
        target = x if row < limit else outer
        for a in range(b):
            for k in range(3):
                target[row * b + a, k] += work[k, at + a]
        at += b


@inner_kernel
def _forward(
    panels: Any, offset: int, height: int, width: int, work: Any, leaves: Any, sizes: Any, numbers: Any
) -> None:
    """Divide by the square part of a panel and subtract its rows below, four columns at a time."""
    j = 0
    while j + 4 <= width:
        for q in range(j, j + 4):
            _eliminate(panels[offset + q * height :][:height], q, j + 4, work)
            for k in range(3):
                numbers[4 * k + q - j] = work[k, q]
        _call_leaf(leaves[0], panels, offset, height, j, work, sizes, numbers)
        j += 4
    end = width if width >= 4 else height
    for q in range(j, width):
        _eliminate(panels[offset + q * height :][:height], q, end, work)
    if j < width and width >= 4:  # the rows below take the last four columns, those done before times 0
        for k in range(3):
            for q in range(width - 4, width):
                numbers[4 * k + q - width + 4] = work[k, q] if q >= j else 0
        _call_leaf(leaves[0], panels, offset, height, width - 4, work, sizes, numbers)


@inner_kernel
def _backward(
    panels: Any, offset: int, height: int, width: int, work: Any, leaves: Any, sizes: Any, numbers: Any
) -> None:
    """Solve with the transposed panel for its own unknowns, four columns at a time from the last."""
    j = width - width % 4
    end = width if width >= 4 else height
    if j < width and width >= 4:
        _call_leaf(leaves[1], panels, offset, height, width - 4, work, sizes, numbers)
        for k in range(3):
            for q in range(j, width):
                work[k, q] -= numbers[4 * k + q - width + 4]
    for q in range(width - 1, j - 1, -1):
        _finish(panels[offset + q * height :][:height], q, end, work)
    while j > 0:
        j -= 4
        _call_leaf(leaves[1], panels, offset, height, j, work, sizes, numbers)
        for q in range(j + 3, j - 1, -1):
            for k in range(3):
                work[k, q] -= numbers[4 * k + q - j]
            _finish(panels[offset + q * height :][:height], q, j + 4, work)


@inner_kernel
def _eliminate(column: Any, q: int, end: int, work: Any) -> None:
    """Finish unknown q and subtract its column from the rows q+1..end-1."""
    for k in range(3):
        work[k, q] /= column[q]
        for i in range(q + 1, end):
            work[k, i] -= column[i] * work[k, q]


@inner_kernel
def _finish(column: Any, q: int, end: int, work: Any) -> None:
    """Subtract the rows q+1..end-1 of column q from unknown q and finish it."""
    for k in range(3):
        total = work[k, q]
        for i in range(q + 1, end):
            total -= column[i] * work[k, i]
        work[k, q] = total / column[q]


@inner_kernel
def _call_leaf(
    leaf: int, panels: Any, offset: int, height: int, j: int, work: Any, sizes: Any, numbers: Any
) -> None:
    """Run a leaf on the columns j..j+3 of a panel and the rows from j+4 on."""
    sizes[0], sizes[1], sizes[2] = height - j - 4, height, work.shape[1]
    columns = array_address(panels) + (offset + j * height + j + 4) * panels.itemsize
    vectors = array_address(work) + (j + 4) * work.itemsize
    call_address(leaf, (array_address(sizes), columns, vectors, array_address(numbers)))


def _subtract_four(sizes: Any, columns: Any, vectors: Any, numbers: Any) -> None:
    """Leaf: subtract four columns times their coefficients from three vectors."""
    size = carray(sizes, (3,))
    count, height, stride = size[0], size[1], size[2]
    panel = carray(columns, (3 * height + count,))
    work = carray(vectors, (2 * stride + count,))
    factor = carray(numbers, (12,))
    l0, l1 = panel[:count], panel[height : height + count]
    l2, l3 = panel[2 * height : 2 * height + count], panel[3 * height :]
    u, v, w = work[:count], work[stride : stride + count], work[2 * stride :]
    a0, a1, a2, a3 = factor[0], factor[1], factor[2], factor[3]
    b0, b1, b2, b3 = factor[4], factor[5], factor[6], factor[7]
    c0, c1, c2, c3 = factor[8], factor[9], factor[10], factor[11]
    for i in range(count):
        u[i] -= l0[i] * a0 + l1[i] * a1 + l2[i] * a2 + l3[i] * a3
        v[i] -= l0[i] * b0 + l1[i] * b1 + l2[i] * b2 + l3[i] * b3
        w[i] -= l0[i] * c0 + l1[i] * c1 + l2[i] * c2 + l3[i] * c3


def _multiply_four(sizes: Any, columns: Any, vectors: Any, numbers: Any) -> None:
    """Leaf: write the twelve products of four columns with three vectors."""
    size = carray(sizes, (3,))
    count, height, stride = size[0], size[1], size[2]
    panel = carray(columns, (3 * height + count,))
    work = carray(vectors, (2 * stride + count,))
    sums = carray(numbers, (12,))
    l0, l1 = panel[:count], panel[height : height + count]
    l2, l3 = panel[2 * height : 2 * height + count], panel[3 * height :]
    u, v, w = work[:count], work[stride : stride + count], work[2 * stride :]
    u0 = u1 = u2 = u3 = v0 = v1 = v2 = v3 = w0 = w1 = w2 = w3 = sums.dtype.type(0)
    for i in range(count):
        u0 += l0[i] * u[i]
        u1 += l1[i] * u[i]
        u2 += l2[i] * u[i]
        u3 += l3[i] * u[i]
        v0 += l0[i] * v[i]
        v1 += l1[i] * v[i]
        v2 += l2[i] * v[i]
        v3 += l3[i] * v[i]
        w0 += l0[i] * w[i]
        w1 += l1[i] * w[i]
        w2 += l2[i] * w[i]
        w3 += l3[i] * w[i]
    sums[0], sums[1], sums[2], sums[3] = u0, u1, u2, u3
    sums[4], sums[5], sums[6], sums[7] = v0, v1, v2, v3
    sums[8], sums[9], sums[10], sums[11] = w0, w1, w2, w3
