"""Orders of elimination that keep a sparse Cholesky factor small.

    metis            multilevel nested dissection (Karypis, Kumar 1998): a small separator cuts the graph in
                     two; both halves are eliminated first, each in the same way, the separator last
    minimum degree   always eliminate a node that creates the least fill (Liu 1985), as SuperLU does it

Neither is best everywhere (minimum degree wins on videos, METIS on networks of areas), and the fill of an
order is known long before any factor (`symbolic.elimination_tree`). So "auto" tries minimum degree too where
it can win, and keeps the order with the least work. Both are deterministic.
"""

from typing import Any, Literal

import numpy as np

from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.laplacian.operators import Adjacency
from sfm_shapefit.laplacian.superlu import superlu
from sfm_shapefit.laplacian.symbolic import EliminationTree, elimination_tree

Ordering = Literal["auto", "metis", "minimum-degree"]

_MINIMUM_DEGREE_LIMIT = 400_000  # edges; on more, minimum degree takes longer than it can save

_BAND_FLOPS = 600  # operations per edge in METIS's order; with more a graph is no band, and METIS was best

# METIS refines a cut so often per level; its own 10 take half as long again and save at most 5 % of the work.
_METIS_REFINEMENTS = 1


def best_order(graph: Adjacency, method: Ordering = "auto") -> EliminationTree:
    """Return the elimination tree of the order with the least work.

    The method "auto" tries METIS, and minimum degree as well on graphs of up to 400,000 edges where it can be
    better; the one whose factorization takes fewer operations is kept.
    """
    trees = [] if method == "minimum-degree" else [elimination_tree(graph, metis_order(graph))]
    edges = len(graph.neighbors) // 2
    worthwhile = edges <= _MINIMUM_DEGREE_LIMIT and all(t.flops <= _BAND_FLOPS * edges for t in trees)
    if method == "minimum-degree" or (method == "auto" and worthwhile):
        trees.append(elimination_tree(graph, minimum_degree_order(graph)))
    return min(trees, key=lambda tree: tree.flops)  # the first of equals


def metis_order(graph: Adjacency) -> IntArray:
    """Return METIS's nested dissection order, (n,): node eliminated k-th."""
    import pymetis

    if graph.num_nodes == 0 or len(graph.neighbors) == 0:
        return np.arange(graph.num_nodes)
    rows = np.repeat(np.arange(graph.num_nodes), np.diff(graph.pointers))
    entries = np.sort(rows * graph.num_nodes + graph.neighbors)  # np.unique takes five times as long
    entries = entries[np.append(True, entries[1:] != entries[:-1])]  # METIS demands each neighbor once
    rows, neighbors = np.divmod(entries, graph.num_nodes)
    pointers = np.searchsorted(rows, np.arange(graph.num_nodes + 1))
    csr = pymetis.CSRAdjacency(pointers.astype(np.int32), neighbors.astype(np.int32))
    options = pymetis.Options(niter=_METIS_REFINEMENTS)
    return np.asarray(pymetis.nested_dissection(adjacency=csr, options=options)[0], dtype=np.int64)


def minimum_degree_order(graph: Adjacency) -> IntArray:
    """Return SuperLU's multiple minimum degree order, (n,): node eliminated k-th.

    SuperLU orders before it factors. An incomplete factorization that drops everything costs no more than
    that order, which it then reports.
    """
    n = graph.num_nodes
    if n <= 1 or len(graph.neighbors) == 0:
        return np.arange(n)
    nodes = np.arange(n)
    columns = np.repeat(nodes, np.diff(graph.pointers))
    places = np.concatenate([graph.neighbors, nodes]), np.concatenate([columns, nodes])
    # The diagonal dominates so that no pivoting or breakdown interferes.
    values = np.repeat([-1.0, 2.0 * len(graph.neighbors)], [len(graph.neighbors), n])
    return np.argsort(superlu(n, places, values, order=True).perm_c)


def widest_level(graph: Adjacency) -> int:
    """Return how many nodes are at the most frequent graph distance from a far end of a connected graph.

    A level separates what is nearer from what is farther. Where a graph looks the same everywhere, as a
    geometric one, no separator in halves is much smaller (METIS finds 0.75 of it on boxes of 1e4 and 1e5).
    """
    last = _distances(graph.pointers, graph.neighbors, 0)[1]
    distance, _ = _distances(graph.pointers, graph.neighbors, last)
    return int(np.bincount(distance[distance >= 0]).max())


@kernel
def _distances(pointers: Any, neighbors: Any, start: int) -> Any:
    """Return the graph distance of each node from `start`, -1 if not reached, and a farthest node."""
    distance = np.full(len(pointers) - 1, -1)
    queue = np.empty(len(distance), np.int64)
    distance[start], queue[0] = 0, start
    head, tail = 0, 1
    while head < tail:
        v = queue[head]
        head += 1
        for p in range(pointers[v], pointers[v + 1]):
            u = neighbors[p]
            if distance[u] < 0:
                distance[u] = distance[v] + 1
                queue[tail] = u
                tail += 1
    return distance, queue[tail - 1]
