"""The entries of the inverse of a factored Laplacian that belong to its nodes and edges, and no others.

With the factor A = L L^T in supernodes, own columns J and rows R below them, Y = L_RJ L_JJ^-1, the inverse
Z of A obeys, from the last supernode to the first,

    Z_RJ = -Z_RR Y,        Z_JJ = L_JJ^-T L_JJ^-1 + Y^T Z_RR Y,

and Z_RR is part of what is known of the parent, because R lies in the rows of the parent's panel (Takahashi,
Fagan, Chin 1973, "Formation of a sparse bus impedance matrix"; Erisman and Tinney 1975; in fronts: Amestoy et
al. 2012, "On computing inverse entries of a sparse matrix in an out-of-core environment"). It costs about
twice the factorization. The block Z_RR of a supernode waits where its update matrix lay during the
factorization: it lives from the parent to the supernode, the same interval run backwards.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.blas_threads import one_blas_thread
from sfm_shapefit.base.scipy_parts import dtrtri
from sfm_shapefit.laplacian.cholesky import CholeskyFactor
from sfm_shapefit.laplacian.symbolic import SymbolicFactor

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


def selected_inverse(factor: CholeskyFactor, edges: IntArray) -> SelectedInverse:
    """Return the blocks of the inverse at the nodes and edges of the graph.

    The float64 factor's `refactor` succeeded; `edges` (m, 2) are those it was planned for, and say how each
    block is to be turned. ValueError if it is not float64, or the edges are not as many.
    """
    plan, b = factor.symbolic, factor.block
    if factor.dtype != np.float64 or len(edges) != plan.num_edges:
        raise ValueError("selected_inverse takes a float64 factor and the edges it was planned for")
    nodes = np.empty((plan.num_nodes, b, b))
    blocks = np.empty((plan.num_edges, b, b))
    waiting = np.empty((plan.stack_size + plan.arena_size) * b * b)
    places = plan.update_offsets.copy()
    for begin, end in plan.tasks.tolist():
        places[begin : end - 1] += plan.stack_size  # one task at a time has the arena
    places *= b * b
    with one_blas_thread():
        for s in range(plan.num_supernodes - 1, -1, -1):
            front = _front_inverse(factor, s, int(places[s]), waiting)
            _hand_to_children(plan, b, s, front, places, waiting)
            _store(plan, b, s, front, nodes, blocks)
    reversed_edges = plan.inverse[edges[:, 0]] < plan.inverse[edges[:, 1]]  # stored: (later, earlier)
    blocks[reversed_edges] = blocks[reversed_edges].transpose(0, 2, 1)
    return SelectedInverse(nodes=nodes, edges=blocks)


def _front_inverse(factor: CholeskyFactor, s: int, start: int, waiting: FloatArray) -> FloatArray:
    """Return the inverse on all rows of a supernode's panel, own columns first."""
    plan, b = factor.symbolic, factor.block
    width = int(plan.first[s + 1] - plan.first[s]) * b
    below = int(plan.row_pointers[s + 1] - plan.row_pointers[s]) * b
    offset = int(plan.panel_pointers[s]) * b * b
    panel = factor.panels[offset : offset + width * (width + below)].reshape(width, width + below)
    inverse_root, _ = dtrtri(panel[:, :width].T, lower=1)  # panel rows are columns of L
    inverse_root = np.tril(inverse_root)
    front = np.empty((width + below, width + below))
    front[:width, :width] = inverse_root.T @ inverse_root
    if below:
        rest = waiting[start : start + below * below].reshape(below, below)
        y = panel[:, width:].T @ inverse_root
        cross = -(rest @ y)
        front[:width, :width] -= y.T @ cross
        front[width:, :width] = cross
        front[:width, width:] = cross.T
        front[width:, width:] = rest
    return front


def _hand_to_children(
    plan: SymbolicFactor, b: int, s: int, front: FloatArray, places: IntArray, waiting: FloatArray
) -> None:
    """Copy to each child's place on the stack what it needs of its parent's front."""
    for child in plan.children[plan.child_pointers[s] : plan.child_pointers[s + 1]].tolist():
        there = plan.relative[plan.row_pointers[child] : plan.row_pointers[child + 1]].astype(np.int64)
        rows = (there[:, None] * b + np.arange(b)).ravel()
        start = int(places[child])
        waiting[start : start + len(rows) ** 2] = front[np.ix_(rows, rows)].ravel()


def _store(
    plan: SymbolicFactor, b: int, s: int, front: FloatArray, nodes: FloatArray, blocks: FloatArray
) -> None:
    """Write the blocks of a supernode's own columns to their nodes and edges."""
    tiles = front.reshape(len(front) // b, b, len(front) // b, b)
    first, last = int(plan.first[s]), int(plan.first[s + 1])
    own = np.arange(last - first)
    nodes[plan.permutation[first:last]] = tiles[own, :, own, :]
    slots = slice(int(plan.edge_pointers[s]), int(plan.edge_pointers[s + 1]))
    blocks[plan.edge_index[slots]] = tiles[plan.edge_row[slots], :, plan.edge_column[slots], :]
