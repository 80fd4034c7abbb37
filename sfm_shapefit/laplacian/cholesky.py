"""Sparse Cholesky factorisation of graph Laplacians, scalar (n x n) and in b x b blocks (nb x nb).

The factorisation is multifrontal (Duff, Reid 1983; Liu 1992, "The multifrontal method for sparse matrix
solution"). For each supernode, children first:

    assemble   its panel from the edges' slots and from the children's update matrices
    factor     the square part, L_JJ = chol, and the rows below, L_RJ = A_RJ L_JJ^-T
    update     U = -L_RJ L_RJ^T + what the children leave for later fronts, kept on a stack

What depends on the graph alone is planned once (`analyse`); `refactor` takes new edge weights and neither
sorts nor allocates. A Laplacian is singular: constants are its null space. The mean weight is added to the
last pivot instead of removing a row. For right-hand sides orthogonal to the constants the answer is exact,
the one that is 0 at the last node.

Cholesky does not fail on a singular matrix: rounding makes the zero pivot a tiny number of either sign and
the answer garbage. Each pivot is therefore compared with the diagonal entry it came from; their smallest
ratio, `smallest_pivot`, is of the order of the rounding unit where the graph is disconnected or not rigid.
"""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from sfm_shapefit.arrays import FloatArray
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.jit import kernel
from sfm_shapefit.laplacian.dense import (
    FLAGS,
    potrf,
    routine_addresses,
    syrk,
    trsm,
    work_integers,
    work_scalars,
)
from sfm_shapefit.laplacian.symbolic import SymbolicFactor

PIVOT_TOLERANCE = 64.0
"""Pivots below this many rounding units of their diagonal entry count as zero."""


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
    _stack: npt.NDArray[Any] = field(repr=False, default_factory=lambda: np.empty(0))
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
        _refactor(self, weights, ground)

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Return x with L x = rhs, with x = 0 at the grounded node.

        Args:
            rhs: (n,) or (n, k) for block 1, else (n, b) or (n, b, k). Each right-hand side must be
                orthogonal to the constants (of each of the b components).

        Returns:
            Float64 of the shape of `rhs`, accurate to the precision of the factor.
        """
        return _solve(self, rhs)


def allocate_factor(
    symbolic: SymbolicFactor, block: int = 1, dtype: npt.DTypeLike = np.float64
) -> CholeskyFactor:
    """Allocate the memory of a factor, `symbolic.num_bytes(block, dtype)` in all."""
    area = block * block
    return CholeskyFactor(
        symbolic=symbolic,
        block=block,
        panels=np.empty(int(symbolic.panel_pointers[-1]) * area, dtype=dtype),
        _stack=np.empty(symbolic.stack_size * area, dtype=dtype),
        _diagonal=np.empty((symbolic.num_nodes, area)),
    )


def factorise(
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


def _refactor(factor: CholeskyFactor, weights: FloatArray, ground: float | None) -> None:
    plan, b = factor.symbolic, factor.block
    shape = (plan.num_edges,) if b == 1 else (plan.num_edges, b, b)
    if np.shape(weights) != shape:
        raise ValueError(f"weights have shape {np.shape(weights)}, this factor takes {shape}")
    w = np.ascontiguousarray(weights, dtype=np.float64).reshape(plan.num_edges, b * b)
    diagonal = factor._diagonal
    _sum_at_nodes(plan.edge_pointers, plan.edge_index, plan.edge_row, plan.edge_column,
                  plan.first, plan.row_pointers, plan.rows, w, diagonal)  # fmt: skip
    traces = diagonal[:, :: b + 1]
    grounding = float(traces.mean()) if ground is None else ground
    traces[-1] += grounding
    pivot = np.empty(2)
    failed = _factorise(
        0, plan.num_supernodes, b, plan.first, plan.row_pointers, plan.rows, plan.relative,
        plan.panel_pointers, plan.child_pointers, plan.children, plan.update_offsets,
        plan.edge_pointers, plan.edge_index, plan.edge_row, plan.edge_column,
        w, diagonal, factor.panels, factor._stack, pivot,
        routine_addresses(factor.dtype), FLAGS, work_integers(), work_scalars(factor.dtype),
    )  # fmt: skip
    factor.smallest_pivot = float(pivot[0])
    factor.weakest_node = int(plan.permutation[int(pivot[1]) // b])
    if failed or not pivot[0] > PIVOT_TOLERANCE * np.finfo(factor.dtype).eps:
        raise UnsolvableError(
            f"the Laplacian is singular at node {factor.weakest_node} (relative pivot {pivot[0]:.1e}); "
            "the graph is disconnected or not rigid there, or its weights are not positive"
        )


@kernel(exact=True)
def _sum_at_nodes(
    edge_pointers: Any,
    edge_index: Any,
    edge_row: Any,
    edge_column: Any,
    first: Any,
    row_pointers: Any,
    rows: Any,
    weights: Any,
    diagonal: Any,
) -> None:
    """Write the diagonal blocks of the Laplacian, in elimination order: sums over incident edges."""
    diagonal[:] = 0.0
    for s in range(len(first) - 1):
        start, width = first[s], first[s + 1] - first[s]
        for k in range(edge_pointers[s], edge_pointers[s + 1]):
            position = edge_row[k]
            i = start + edge_column[k]
            j = start + position if position < width else rows[row_pointers[s] + position - width]
            e = edge_index[k]
            for a in range(weights.shape[1]):
                w = weights[e, a]
                diagonal[i, a] += w
                diagonal[j, a] += w


@kernel()
def _factorise(
    begin: int, end: int, b: int, first: Any, row_pointers: Any, rows: Any, relative: Any,
    panel_pointers: Any, child_pointers: Any, children: Any, update_offsets: Any,
    edge_pointers: Any, edge_index: Any, edge_row: Any, edge_column: Any,
    weights: Any, diagonal: Any, panels: Any, stack: Any, pivot: Any,
    routines: Any, flags: Any, integers: Any, scalars: Any,
) -> bool:  # fmt: skip
    """Factor the supernodes begin..end-1; return True if a pivot was not positive.

    `pivot` receives the least relative pivot and the row it stands in.
    """
    pivot[0] = np.inf
    pivot[1] = 0.0
    for s in range(begin, end):
        start, width = first[s], (first[s + 1] - first[s]) * b
        below = (row_pointers[s + 1] - row_pointers[s]) * b
        height = width + below
        offset = panel_pointers[s] * b * b
        panel = panels[offset : offset + width * height]
        panel[:] = 0.0
        _assemble_edges(
            panel, height, b, edge_pointers[s], edge_pointers[s + 1], edge_index, edge_row, edge_column, weights
        )
        _assemble_diagonal(panel, height, b, start, first[s + 1], diagonal)
        for c in range(child_pointers[s], child_pointers[s + 1]):
            child = children[c]
            there = relative[row_pointers[child] : row_pointers[child + 1]]
            size = len(there) * b
            update = stack[update_offsets[child] * b * b :][: size * size]
            _add_update(update, there, b, 0, width // b, panel, height)
        info = potrf(routines, flags, integers, panels, offset, width, height)
        if info != 0:
            pivot[0] = 0.0
            pivot[1] = start * b + info - 1
            return True
        _check_pivots(panel, height, width, b, start, diagonal, pivot)
        if below == 0:
            continue
        trsm(routines, flags, integers, scalars, panels, offset, offset + width, below, width, height)
        update_start = update_offsets[s] * b * b
        syrk(
            routines, flags, integers, scalars, panels, offset + width, height, below, width,
            stack, update_start, below, False,
        )  # fmt: skip
        mine = stack[update_start : update_start + below * below]
        for c in range(child_pointers[s], child_pointers[s + 1]):
            child = children[c]
            there = relative[row_pointers[child] : row_pointers[child + 1]]
            size = len(there) * b
            update = stack[update_offsets[child] * b * b :][: size * size]
            _add_update(update, there, b, width // b, height // b, mine, below)
    return False


@kernel()
def _assemble_edges(
    panel: Any, height: int, b: int, begin: int, end: int, index: Any, row: Any, column: Any, weights: Any
) -> None:
    """Subtract the edges' weights from a panel at their slots."""
    for k in range(begin, end):
        e = index[k]
        for c in range(b):
            at = (column[k] * b + c) * height + row[k] * b
            for a in range(b):
                panel[at + a] -= weights[e, c * b + a]


@kernel()
def _assemble_diagonal(panel: Any, height: int, b: int, start: int, stop: int, diagonal: Any) -> None:
    """Add the diagonal blocks of the nodes start..stop-1 to a panel."""
    for q in range(stop - start):
        for c in range(b):
            at = (q * b + c) * height + q * b
            for a in range(b):
                panel[at + a] += diagonal[start + q, c * b + a]


@kernel()
def _check_pivots(
    panel: Any, height: int, width: int, b: int, start: int, diagonal: Any, pivot: Any
) -> None:
    """Lower pivot[0] to the least ratio of a squared pivot to its diagonal entry, and note its row."""
    for k in range(width):
        root = panel[k * height + k]
        ratio = root * root / diagonal[start + k // b, (k % b) * (b + 1)]
        if not ratio >= pivot[0]:
            pivot[0] = ratio
            pivot[1] = start * b + k


@kernel()
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
            while i < size:
                count = (run_end[i] - i) * b
                at = into + (there[i] - lowest) * b
                _add(target[at : at + count], update[source + i * b : source + i * b + count])
                i = run_end[i]


@kernel()
def _add(target: Any, values: Any) -> None:
    """Add one contiguous vector to another."""
    for i in range(len(target)):
        target[i] += values[i]


def _solve(factor: CholeskyFactor, rhs: FloatArray) -> FloatArray:
    plan, b = factor.symbolic, factor.block
    n = plan.num_nodes
    lead = (n,) if b == 1 else (n, b)
    if np.shape(rhs)[: len(lead)] != lead or np.ndim(rhs) > len(lead) + 1:
        raise ValueError(f"rhs has shape {np.shape(rhs)}, this factor takes {lead} or {(*lead, 'k')}")
    given = np.asarray(rhs, dtype=np.float64).reshape(n * b, -1)
    x = np.empty((3, n * b), dtype=factor.dtype)
    work = np.empty((3, int(np.max(np.diff(plan.row_pointers) + np.diff(plan.first), initial=1)) * b),
                    dtype=factor.dtype)  # fmt: skip
    out = np.empty_like(given)
    for k in range(0, given.shape[1], 3):
        columns = given[:, k : k + 3]
        _gather(columns, plan.permutation, b, x)
        _forward(b, plan.first, plan.row_pointers, plan.rows, plan.panel_pointers, factor.panels, x, work)
        _backward(b, plan.first, plan.row_pointers, plan.rows, plan.panel_pointers, factor.panels, x, work)
        _scatter(x, plan.permutation, b, out[:, k : k + 3])
    return out.reshape(np.shape(rhs))


@kernel()
def _gather(columns: Any, permutation: Any, b: int, x: Any) -> None:
    """Write up to three right-hand sides into the rows of x in elimination order; the others are 0."""
    for k in range(3):
        for i in range(len(permutation)):
            for a in range(b):
                x[k, i * b + a] = columns[permutation[i] * b + a, k] if k < columns.shape[1] else 0.0


@kernel()
def _scatter(x: Any, permutation: Any, b: int, columns: Any) -> None:
    """Undo `_gather`."""
    for k in range(columns.shape[1]):
        for i in range(len(permutation)):
            for a in range(b):
                columns[permutation[i] * b + a, k] = x[k, i * b + a]


@kernel()
def _forward(
    b: int, first: Any, row_pointers: Any, rows: Any, panel_pointers: Any, panels: Any, x: Any, work: Any
) -> None:
    """Solve L y = x in place, three right-hand sides at a time."""
    for s in range(len(first) - 1):
        start, width = first[s] * b, (first[s + 1] - first[s]) * b
        below = (row_pointers[s + 1] - row_pointers[s]) * b
        height = width + below
        panel = panels[panel_pointers[s] * b * b :][: width * height]
        for k in range(3):
            work[k, :width] = x[k, start : start + width]
            work[k, width:height] = 0.0
        w0, w1, w2 = work[0][:height], work[1][:height], work[2][:height]
        _eliminate(panel, height, width, w0, w1, w2)
        for k in range(3):
            x[k, start : start + width] = work[k, :width]
        for p in range(row_pointers[s], row_pointers[s + 1]):
            at = width + (p - row_pointers[s]) * b
            for a in range(b):
                for k in range(3):
                    x[k, rows[p] * b + a] += work[k, at + a]


@kernel()
def _eliminate(panel: Any, height: int, width: int, w0: Any, w1: Any, w2: Any) -> None:
    """Divide by the square part of a panel and subtract its rows below, four columns at a time."""
    j = 0
    while j + 4 <= width:
        for q in range(j, j + 4):
            _eliminate_rows(panel, height, q, j + 4, w0, w1, w2)
        l0, l1 = panel[j * height :][j + 4 : height], panel[(j + 1) * height :][j + 4 : height]
        l2, l3 = panel[(j + 2) * height :][j + 4 : height], panel[(j + 3) * height :][j + 4 : height]
        _subtract_4(l0, l1, l2, l3, w0[j : j + 4], w0[j + 4 :], w1[j : j + 4], w1[j + 4 :], w2[j : j + 4],
                    w2[j + 4 :])  # fmt: skip
        j += 4
    for q in range(j, width):
        _eliminate_rows(panel, height, q, height, w0, w1, w2)


@kernel()
def _eliminate_rows(panel: Any, height: int, q: int, end: int, w0: Any, w1: Any, w2: Any) -> None:
    """Finish unknown q and subtract its column from the rows q+1..end-1."""
    column = panel[q * height : (q + 1) * height]
    inverse = 1 / column[q]
    w0[q] *= inverse
    w1[q] *= inverse
    w2[q] *= inverse
    a0, a1, a2 = w0[q], w1[q], w2[q]
    for i in range(q + 1, end):
        w0[i] -= column[i] * a0
        w1[i] -= column[i] * a1
        w2[i] -= column[i] * a2


@kernel()
def _subtract_4(
    l0: Any, l1: Any, l2: Any, l3: Any, a: Any, u: Any, b: Any, v: Any, c: Any, w: Any
) -> None:
    """Subtract four columns times the coefficients a, b, c from u, v, w."""
    a0, a1, a2, a3 = a[0], a[1], a[2], a[3]
    b0, b1, b2, b3 = b[0], b[1], b[2], b[3]
    c0, c1, c2, c3 = c[0], c[1], c[2], c[3]
    for i in range(len(l0)):
        u[i] -= l0[i] * a0 + l1[i] * a1 + l2[i] * a2 + l3[i] * a3
        v[i] -= l0[i] * b0 + l1[i] * b1 + l2[i] * b2 + l3[i] * b3
        w[i] -= l0[i] * c0 + l1[i] * c1 + l2[i] * c2 + l3[i] * c3


@kernel()
def _backward(
    b: int, first: Any, row_pointers: Any, rows: Any, panel_pointers: Any, panels: Any, x: Any, work: Any
) -> None:
    """Solve L^T y = x in place, three right-hand sides at a time."""
    for s in range(len(first) - 2, -1, -1):
        start, width = first[s] * b, (first[s + 1] - first[s]) * b
        below = (row_pointers[s + 1] - row_pointers[s]) * b
        height = width + below
        panel = panels[panel_pointers[s] * b * b :][: width * height]
        for k in range(3):
            work[k, :width] = x[k, start : start + width]
        for p in range(row_pointers[s], row_pointers[s + 1]):
            at = width + (p - row_pointers[s]) * b
            for a in range(b):
                for k in range(3):
                    work[k, at + a] = x[k, rows[p] * b + a]
        w0, w1, w2 = work[0][:height], work[1][:height], work[2][:height]
        _substitute(panel, height, width, w0, w1, w2)
        for k in range(3):
            x[k, start : start + width] = work[k, :width]


@kernel()
def _substitute(panel: Any, height: int, width: int, w0: Any, w1: Any, w2: Any) -> None:
    """Solve with the transposed panel for its own unknowns, four columns at a time from the last."""
    sums = np.empty(12, panel.dtype)
    j = width
    while j % 4 != 0:
        j -= 1
        _substitute_row(panel, height, j, j + 1, height, w0, w1, w2)
        _finish_row(panel, height, j, w0, w1, w2)
    while j > 0:
        j -= 4
        l0, l1 = panel[j * height :][j + 4 : height], panel[(j + 1) * height :][j + 4 : height]
        l2, l3 = panel[(j + 2) * height :][j + 4 : height], panel[(j + 3) * height :][j + 4 : height]
        _dot_4(l0, l1, l2, l3, w0[j + 4 :], w1[j + 4 :], w2[j + 4 :], sums)
        for q in range(3, -1, -1):
            w0[j + q] -= sums[q]
            w1[j + q] -= sums[4 + q]
            w2[j + q] -= sums[8 + q]
            _substitute_row(panel, height, j + q, j + q + 1, j + 4, w0, w1, w2)
            _finish_row(panel, height, j + q, w0, w1, w2)


@kernel()
def _substitute_row(
    panel: Any, height: int, q: int, begin: int, end: int, w0: Any, w1: Any, w2: Any
) -> None:
    """Subtract the products of the rows begin..end-1 of column q from unknown q."""
    column = panel[q * height : (q + 1) * height]
    s0 = s1 = s2 = column[q] * 0
    for i in range(begin, end):
        s0 += column[i] * w0[i]
        s1 += column[i] * w1[i]
        s2 += column[i] * w2[i]
    w0[q] -= s0
    w1[q] -= s1
    w2[q] -= s2


@kernel()
def _finish_row(panel: Any, height: int, q: int, w0: Any, w1: Any, w2: Any) -> None:
    """Divide unknown q by its pivot."""
    inverse = 1 / panel[q * height + q]
    w0[q] *= inverse
    w1[q] *= inverse
    w2[q] *= inverse


@kernel()
def _dot_4(l0: Any, l1: Any, l2: Any, l3: Any, u: Any, v: Any, w: Any, sums: Any) -> None:
    """Write the twelve products of four columns with three vectors."""
    zero = l0.dtype.type(0)
    u0 = u1 = u2 = u3 = v0 = v1 = v2 = v3 = w0 = w1 = w2 = w3 = zero
    for i in range(len(l0)):
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
