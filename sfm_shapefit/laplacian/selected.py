"""The entries of the inverse of a factored Laplacian that belong to its nodes and edges, and no others.

With the factor A = L L^T in supernodes, own columns J and rows R below them, Y = L_RJ L_JJ^-1, the inverse
Z of A obeys, from the last supernode to the first,

    Z_RJ = -Z_RR Y,        Z_JJ = L_JJ^-T L_JJ^-1 + Y^T Z_RR Y,

and Z_RR is part of what is known of the parent, because R lies in the rows of the parent's panel (Takahashi,
Fagan, Chin 1973, "Formation of a sparse bus impedance matrix"; Erisman and Tinney 1975; in fronts: Amestoy et
al. 2012, "On computing inverse entries of a sparse matrix in an out-of-core environment"). It costs about
twice the factorization. The block Z_RR of a supernode waits as its update matrix did during the
factorization, from the parent to the supernode: the same interval run backwards, and the same units of work.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.jit import array_address, inner_kernel, kernel
from sfm_shapefit.laplacian.dense import Blas, blas_of, gemm, trsm
from sfm_shapefit.laplacian.front_memory import FrontMemory
from sfm_shapefit.laplacian.operators import Workers
from sfm_shapefit.laplacian.symbolic import SymbolicFactor

_STRIP = 64  # rows of a product; half of it is wanted, and smaller products are slower
_Solve = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SelectedInverse:
    """Blocks of the inverse of a factored matrix, the factor's grounding included."""

    nodes: FloatArray
    """(n, b, b) diagonal blocks."""
    edges: FloatArray
    """(m, b, b) block (i, j) of each edge; its transpose is block (j, i)."""


def regauged(nodes: FloatArray, solve: _Solve, null: FloatArray, dual: FloatArray) -> FloatArray:
    """Return the diagonal blocks (n, b, b) of S A^-1 S^T from those of A^-1; S = I - N F^T of (n, b, k)."""
    solved = solve(dual)
    middle = np.einsum("nai,naj->ij", dual, solved)
    cross = null @ solved.transpose(0, 2, 1)
    return np.asarray(nodes - cross - cross.transpose(0, 2, 1) + null @ middle @ null.transpose(0, 2, 1))


def selected_inverse(plan: SymbolicFactor, b: int, panels: FloatArray, workers: Workers) -> SelectedInverse:
    """Return the blocks of the inverse at the nodes and edges of the graph of a factor.

    Args:
        plan: of the factor.
        b: its blocks are b x b.
        panels: of the factor.
        workers: the threads.

    Raises:
        ValueError: if it is not float64.
    """
    if panels.dtype != np.float64:
        raise ValueError("selected_inverse takes a float64 factor")
    nodes, blocks = np.empty((plan.num_nodes, b, b)), np.empty((plan.num_edges, b, b))
    rooms = FrontMemory(plan, workers.threads)
    widths, below = np.diff(plan.first) * b, np.diff(plan.row_pointers) * b
    areas = widths * widths, widths * widths, widths * below, widths * below
    starts = np.cumsum([0, *(np.max(area, initial=0) for area in areas)])
    waiting, work = np.empty(rooms.size * b * b), np.empty((rooms.num_arenas, int(starts[-1])))
    plan_arrays = _Plan(
        b, plan.first, plan.row_pointers, plan.panel_pointers, plan.relative, plan.child_pointers,
        plan.children, plan.edge_pointers, plan.edge_index, plan.edge_row, plan.edge_column,
        plan.is_turned, plan.permutation,
    )  # fmt: skip

    def memory(arena: int) -> _Memory:
        return _Memory(waiting, work[arena], starts[:-1], rooms.offsets, blas_of(panels.dtype))

    def invert(unit: int) -> None:
        with rooms.room(unit, rooms.entering[unit], rooms.leaving[unit]) as arena:
            _invert(rooms.units[unit], plan_arrays, panels, memory(arena), nodes, blocks)

    with one_blas_thread():
        if rooms.num_arenas == 1:
            _invert(np.array([0, plan.num_supernodes]), plan_arrays, panels, memory(0), nodes, blocks)
        else:
            units = range(len(rooms.units) - 1, -1, -1)
            workers.run_after([partial(invert, unit) for unit in units], plan.needs_back())
    return SelectedInverse(nodes=nodes, edges=blocks)


class _Plan(NamedTuple):
    b: int
    first: IntArray
    row_pointers: IntArray
    panel_pointers: IntArray
    relative: Int32Array
    child_pointers: IntArray
    children: IntArray
    edge_pointers: IntArray
    edge_index: Int32Array
    edge_row: Int32Array
    edge_column: Int32Array
    is_turned: BoolArray
    permutation: IntArray


class _Memory(NamedTuple):
    """Where the kernels work; all matrices are column-major."""

    waiting: FloatArray  # -Z_RR of each supernode, from when its parent is done until it is done itself
    work: FloatArray  # L_JJ^-T, -Z_JJ, -Y^T, Z_JR of one supernode
    starts: IntArray  # (4,) where these are in `work`
    places: IntArray  # (S,) where each supernode's block is in `waiting`, in blocks of b x b
    blas: Blas


@kernel
def _invert(run: Any, plan: Any, panels: Any, memory: Any, nodes: Any, blocks: Any) -> None:
    """Write the inverse's blocks of the nodes (n, b, b) and edges (m, b, b) of a run of supernodes.

    BLAS subtracts products here, hence the signs of what is kept.
    """
    b, first, row_pointers, work, blas = plan.b, plan.first, plan.row_pointers, memory.work, memory.blas
    root_at, own_at, y_at, cross_at = memory.starts
    size, base = work.itemsize, array_address(work)
    for s in range(run[1] - 1, run[0] - 1, -1):
        width = (first[s + 1] - first[s]) * b
        below = (row_pointers[s + 1] - row_pointers[s]) * b
        panel = array_address(panels) + plan.panel_pointers[s] * b * b * size
        height, most = width + below, max(below, 1)
        root, own, y, cross = (
            base + root_at * size,
            base + own_at * size,
            base + y_at * size,
            base + cross_at * size,
        )
        rest = array_address(memory.waiting) + memory.places[s] * b * b * size, most
        for k in range(width * width):
            work[root_at + k] = 0.0
        for k in range(width):
            work[root_at + k * (width + 1)] = 1.0
        for i in range(0, width, _STRIP):  # strips of rows; the other triangle is left out
            rows, corner = min(_STRIP, width - i), i * (width + 1) * size
            right = width - i
            trsm(blas, (panel + i * (height + 1) * size, height), (root + corner, width), rows, right)
            beside = root + i * width * size, width
            gemm(
                blas, (root + corner, width), beside, (rows, i + rows, right), (own + i * size, width), False
            )
            if below > 0:
                under = panel + (width + i * height) * size, height
                gemm(blas, (root + corner, width), under, (rows, below, right), (y + i * size, width), False)
        if below > 0:
            gemm(blas, (y, width), rest, (width, below, below), (cross, width), False)
            for i in range(0, width, _STRIP):
                rows = min(_STRIP, width - i)
                shape, at = (rows, i + rows, below), i * size
                gemm(blas, (y + at, width), (cross, width), shape, (own + at, width), True)
        for i in range(width):
            for j in range(i):
                work[own_at + i * width + j] = work[own_at + j * width + i]
        inverse = work[own_at : own_at + width * width], work[cross_at : cross_at + width * below]
        _hand_to_children(s, plan, memory, inverse, width, below)
        _store(s, plan, inverse, width, nodes, blocks)


@inner_kernel
def _hand_to_children(s: int, plan: Any, memory: Any, inverse: Any, width: int, below: int) -> None:
    """Copy to each child's place what it needs of its parent's inverse, one triangle and its mirror image."""
    b, waiting, (own, cross) = plan.b, memory.waiting, inverse
    rest = memory.places[s] * b * b
    for q in range(plan.child_pointers[s], plan.child_pointers[s + 1]):
        child = plan.children[q]
        begin, count = plan.row_pointers[child], plan.row_pointers[child + 1] - plan.row_pointers[child]
        start, side = memory.places[child] * b * b, count * b
        for i in range(count):
            row = np.int64(plan.relative[begin + i]) * b
            for j in range(i + 1):
                column = np.int64(plan.relative[begin + j]) * b
                for a in range(b):
                    for c in range(b):
                        if row < width:
                            value = own[(row + a) * width + column + c]
                        elif column < width:
                            value = -cross[(row + a - width) * width + column + c]
                        else:
                            value = waiting[rest + (row + a - width) * below + column + c - width]
                        waiting[start + (i * b + a) * side + j * b + c] = value
                        waiting[start + (j * b + c) * side + i * b + a] = value


@inner_kernel
def _store(s: int, plan: Any, inverse: Any, width: int, nodes: Any, blocks: Any) -> None:
    """Write the blocks of a supernode's own columns to their nodes and edges."""
    b, (own, cross) = plan.b, inverse
    for k in range(width // b):
        node = plan.permutation[plan.first[s] + k]
        for a in range(b):
            for c in range(b):
                nodes[node, a, c] = -own[(k * b + a) * width + k * b + c]
    for k in range(plan.edge_pointers[s], plan.edge_pointers[s + 1]):
        e, row, column = plan.edge_index[k], np.int64(plan.edge_row[k]) * b, plan.edge_column[k] * b
        for a in range(b):
            for c in range(b):
                if row < width:
                    value = -own[(row + a) * width + column + c]
                else:
                    value = cross[(row + a - width) * width + column + c]
                if plan.is_turned[e]:  # the row is of its first node
                    blocks[e, a, c] = value
                else:
                    blocks[e, c, a] = value
