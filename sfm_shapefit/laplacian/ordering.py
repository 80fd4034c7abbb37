"""Orders of elimination that keep a sparse Cholesky factor small.

    nested dissection   a small separator cuts the graph in two; both halves are eliminated first, each in
                        the same way, the separator last (George 1973)
    minimum degree      always eliminate a node that creates the least fill (Liu 1985), as SuperLU does it
    metis               multilevel nested dissection (Karypis, Kumar 1998) where `pymetis` is installed

Our own dissection cuts across the longest axis of the nodes' coordinates, or, without coordinates, across
the difference of graph distances to two far ends, and improves the separator by moving nodes one at a time,
downhill out of small dips too (Fiduccia, Mattheyses 1982; Ashcraft, Liu 1998).

No method is best everywhere (minimum degree wins on videos, dissection on networks of areas), and the fill of
an order is known long before any factor (`symbolic.elimination_tree`). So "auto" tries several and keeps the
one with the least work. All of them are deterministic.
"""

import heapq
from importlib.util import find_spec
from typing import Any, Literal

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import spilu

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.jit import kernel
from sfm_shapefit.laplacian.operators import Adjacency
from sfm_shapefit.laplacian.symbolic import EliminationTree, elimination_tree

Ordering = Literal["auto", "metis", "dissection", "minimum-degree"]

_MINIMUM_DEGREE_LIMIT = 400_000  # edges; above, minimum degree takes longer than it can save
# Operations per edge: of METIS's order, above which the graph is no band, and minimum degree found a better
# order on no box or community; of our dissection, above which the graph is an expander, and minimum degree
# takes many seconds.
_BAND_FLOPS, _EXPANDER_FLOPS = 600, 100_000
_METIS_REFINEMENTS = 1  # per level; its own 10 take half as long again and save at most 5 % of the operations
_LEAF = 48  # nodes; smaller parts are not cut further
_SMOOTHING = 6  # averaging sweeps over the integer graph distances, to make cuts straight
_PASSES = 6  # refinement passes over a separator
_DIPS = 300  # moves without improvement before a pass gives up
_IMBALANCE = 0.6  # no side may hold a larger share of a part
_BALANCE_WEIGHT = 0.15  # weight of imbalance against separator size when passes are compared


def best_order(
    graph: Adjacency, method: Ordering = "auto", coordinates: FloatArray | None = None
) -> EliminationTree:
    """Return the elimination tree of the order with the least work.

    Args:
        graph: the neighbours of each node.
        method: one method, or "auto": metis where installed, else our dissection; on graphs of up to 400,000
            edges minimum degree as well, where it can be better, and the one whose factorisation takes fewer
            operations is kept.
        coordinates: (n, d) approximate positions that our dissection may cut by; graph distances if None.

    Raises:
        ModuleNotFoundError: if `method` is "metis" and pymetis is not installed.
    """
    candidates: list[IntArray] = []
    use_metis = method == "metis" or (method == "auto" and find_spec("pymetis") is not None)
    if use_metis:
        candidates.append(metis_order(graph))
    if method == "dissection" or (method == "auto" and not use_metis):
        candidates.append(dissection_order(graph, coordinates))
    trees = [elimination_tree(graph, order) for order in candidates]
    edges = len(graph.neighbours) // 2
    limit = (_BAND_FLOPS if use_metis else _EXPANDER_FLOPS) * edges
    worthwhile = edges <= _MINIMUM_DEGREE_LIMIT and all(t.flops <= limit for t in trees)
    if method == "minimum-degree" or (method == "auto" and worthwhile):
        trees.append(elimination_tree(graph, minimum_degree_order(graph)))
    return min(trees, key=lambda tree: tree.flops)  # the first of equals


def metis_order(graph: Adjacency) -> IntArray:
    """Return METIS's nested dissection order, (n,): node eliminated k-th. Needs pymetis (extra `fast`)."""
    import pymetis

    if graph.num_nodes == 0 or len(graph.neighbours) == 0:
        return np.arange(graph.num_nodes)
    unique = without_repeats(graph)
    csr = pymetis.CSRAdjacency(unique[0].astype(np.int32), unique[1])
    options = pymetis.Options(niter=_METIS_REFINEMENTS)
    return np.asarray(pymetis.nested_dissection(adjacency=csr, options=options)[0], dtype=np.int64)


def minimum_degree_order(graph: Adjacency) -> IntArray:
    """Return SuperLU's multiple minimum degree order, (n,): node eliminated k-th.

    SuperLU orders before it factors. An incomplete factorisation that drops everything costs no more than
    that order, which it then reports.
    """
    n = graph.num_nodes
    if n <= 1 or len(graph.neighbours) == 0:
        return np.arange(n)
    columns = np.repeat(np.arange(n), np.diff(graph.pointers))
    rows = np.concatenate([graph.neighbours, np.arange(n)])
    # The diagonal dominates so that no pivoting or breakdown interferes.
    values = np.concatenate([np.full(len(columns), -1.0), 2.0 * len(columns) * np.ones(n)])
    matrix = csc_array((values, (rows, np.concatenate([columns, np.arange(n)]))), shape=(n, n))
    dropped = spilu(matrix, drop_tol=1.0, fill_factor=1.0, permc_spec="MMD_AT_PLUS_A")
    return np.argsort(dropped.perm_c)


def dissection_order(graph: Adjacency, coordinates: FloatArray | None = None) -> IntArray:
    """Return our nested dissection order, (n,): node eliminated k-th.

    Args:
        graph: the neighbours of each node.
        coordinates: (n, d) positions to cut by, such as approximate camera centres; errors below the
            length of an edge do no harm. Graph distances are used if None.
    """
    n = graph.num_nodes
    given = np.zeros((n, 0)) if coordinates is None else np.ascontiguousarray(coordinates, dtype=np.float64)
    if given.shape[0] != n:
        raise ValueError(f"coordinates have {given.shape[0]} rows for {n} nodes")
    return np.asarray(_dissect(graph.pointers, graph.neighbours, given), dtype=np.int64)


def widest_level(graph: Adjacency) -> int:
    """Return how many nodes are at the most frequent graph distance from a far end of a connected graph.

    A level separates what is nearer from what is farther. Where a graph looks the same everywhere, as a
    geometric one, no separator in halves is much smaller (METIS finds 0.75 of it on boxes of 1e4 and 1e5).
    """
    n = graph.num_nodes
    part, members, queue = np.zeros(n, np.int64), np.arange(n), np.empty(n, np.int64)
    distance = np.empty(n)
    start = 0
    for _ in range(2):  # the second time from the node that was last
        reached = _distances(graph.pointers, graph.neighbours, part, 0, start, distance, members, queue)
        start = int(queue[reached - 1])
    return int(np.bincount(distance[queue[:reached]].astype(np.int64)).max())


def without_repeats(graph: Adjacency) -> tuple[IntArray, Any]:
    """Return row pointers and neighbours with each neighbour once, as METIS demands."""
    n = graph.num_nodes
    entries = (np.ones(len(graph.neighbours), np.int8), graph.neighbours, graph.pointers)
    matrix = csc_array(entries, shape=(n, n), copy=True)
    matrix.sum_duplicates()
    return matrix.indptr.astype(np.int64), matrix.indices.astype(np.int32)


@kernel(exact=True)
def _dissect(pointers: Any, neighbours: Any, coordinates: Any) -> Any:
    """Order all nodes: cut parts off a list until all are small. Each part is a range of `nodes`."""
    n = len(pointers) - 1
    nodes = np.arange(n)
    part = np.zeros(n, np.int64)  # stamp of the part that a node is in; separators and other parts differ
    value = np.zeros(n)
    side = np.zeros(n, np.int8)
    scratch = np.empty(n, np.int64)
    smooth = np.empty(n)
    pulled = np.zeros((n, 2), np.int64)
    locked = np.zeros(n, np.bool_)
    stack = [(0, n)]
    stamp = 0
    while len(stack) > 0:
        low, high = stack.pop()
        if high - low <= _LEAF:
            continue
        stamp += 1
        members = nodes[low:high]
        for v in members:
            part[v] = stamp
        reached = _level_values(pointers, neighbours, members, part, stamp, value, smooth, scratch)
        if reached < len(members):
            _split_reached(members, scratch[: len(members)], value)
            stack.append((low, low + reached))
            stack.append((low + reached, high))
            continue
        if coordinates.shape[1] > 0:
            _axis_values(coordinates, members, value)
        _halve(pointers, neighbours, members, part, stamp, value, side)
        _refine(pointers, neighbours, members, part, stamp, side, pulled, locked)
        first, second = _gather_sides(members, side, scratch)
        if first == 0 or second == 0:
            continue  # nothing to gain by cutting: a dense part
        stack.append((low, low + first))
        stack.append((low + first, low + first + second))
    return nodes


@kernel(exact=True)
def _distances(
    pointers: Any, neighbours: Any, part: Any, stamp: int, start: int, distance: Any, members: Any, queue: Any
) -> int:
    """Write graph distances from `start` within a part (-1 if not reached); return how many are reached.

    `queue` then holds the reached nodes, nearest first.
    """
    for v in members:
        distance[v] = -1.0
    distance[start] = 0.0
    queue[0] = start
    head, tail = 0, 1
    while head < tail:
        v = queue[head]
        head += 1
        for p in range(pointers[v], pointers[v + 1]):
            u = neighbours[p]
            if part[u] == stamp and distance[u] < 0:
                distance[u] = distance[v] + 1.0
                queue[tail] = u
                tail += 1
    return tail


@kernel(exact=True)
def _level_values(
    pointers: Any, neighbours: Any, members: Any, part: Any, stamp: int, value: Any, other: Any, queue: Any
) -> int:
    """Write distance to one end minus distance to the other, smoothed; return the number of nodes reached.

    If that is not all of them, `value` is negative exactly at the others.
    """
    reached = _distances(pointers, neighbours, part, stamp, members[0], value, members, queue)
    if reached < len(members):
        return reached
    end = queue[reached - 1]
    _distances(pointers, neighbours, part, stamp, end, other, members, queue)
    _distances(pointers, neighbours, part, stamp, queue[reached - 1], value, members, queue)
    for v in members:
        value[v] -= other[v]
    for _ in range(_SMOOTHING):
        for v in members:
            total, count = value[v], 1.0
            for p in range(pointers[v], pointers[v + 1]):
                if part[neighbours[p]] == stamp:
                    total += value[neighbours[p]]
                    count += 1.0
            other[v] = total / count
        for v in members:
            value[v] = other[v]
    return reached


@kernel(exact=True)
def _split_reached(members: Any, scratch: Any, value: Any) -> None:
    """Reorder the members: those with value >= 0 first."""
    scratch[:] = members
    at = 0
    for sign in range(2):
        for v in scratch:
            if (value[v] < 0) == (sign == 1):
                members[at] = v
                at += 1


@kernel(exact=True)
def _axis_values(coordinates: Any, members: Any, value: Any) -> None:
    """Write the coordinate along the direction of largest spread, found by power iteration."""
    d = coordinates.shape[1]
    centre = np.zeros(d)
    for v in members:
        centre += coordinates[v]
    centre /= len(members)
    spread = np.zeros((d, d))
    for v in members:
        for a in range(d):
            for c in range(d):
                spread[a, c] += (coordinates[v, a] - centre[a]) * (coordinates[v, c] - centre[c])
    axis = np.ones(d)
    for a in range(d):
        axis[a] += spread[a, a] / (spread.max() + 1e-300)
    for _ in range(30):
        turned = np.zeros(d)
        for a in range(d):
            for c in range(d):
                turned[a] += spread[a, c] * axis[c]
        axis = turned / (np.abs(turned).max() + 1e-300)
    for v in members:
        total = 0.0
        for a in range(d):
            total += axis[a] * (coordinates[v, a] - centre[a])
        value[v] = total


@kernel(exact=True)
def _halve(
    pointers: Any, neighbours: Any, members: Any, part: Any, stamp: int, value: Any, side: Any
) -> None:
    """Cut at the median value: sides 0 and 1, and as separator (2) the nodes of side 1 that touch side 0."""
    values = np.empty(len(members))
    for k in range(len(members)):
        values[k] = value[members[k]]
    order = np.argsort(values, kind="mergesort")
    for k in range(len(members)):
        side[members[order[k]]] = 0 if 2 * k < len(members) else 1
    for v in members:
        if side[v] != 1:
            continue
        for p in range(pointers[v], pointers[v + 1]):
            if part[neighbours[p]] == stamp and side[neighbours[p]] == 0:
                side[v] = 2
                break


@kernel(exact=True)
def _refine(
    pointers: Any, neighbours: Any, members: Any, part: Any, stamp: int, side: Any, pulled: Any,
    locked: Any,
) -> None:  # fmt: skip
    """Shrink the separator: passes of single moves, each pass undone back to its best point."""
    sizes = np.zeros(3, np.int64)
    for v in members:
        sizes[side[v]] += 1
    for _ in range(_PASSES):
        if not _refine_pass(pointers, neighbours, members, part, stamp, side, sizes, pulled, locked):
            return


@kernel(exact=True)
def _cost(sizes: Any) -> float:
    """Return what a separation costs: the separator, and a little for imbalance."""
    imbalance: float = abs(sizes[0] - sizes[1]) / (sizes[0] + sizes[1] + 1.0)
    return sizes[2] * (1.0 + _BALANCE_WEIGHT * imbalance)  # type: ignore[no-any-return]


@kernel(exact=True)
def _count_pulled(
    pointers: Any, neighbours: Any, part: Any, stamp: int, side: Any, v: int, pulled: Any, heap: Any
) -> None:
    """Count the nodes that would enter the separator if v left it for side 0 or 1, and offer both moves."""
    pulled[v, 0] = 0
    pulled[v, 1] = 0
    for p in range(pointers[v], pointers[v + 1]):
        u = neighbours[p]
        if part[u] == stamp and side[u] < 2:
            pulled[v, 1 - side[u]] += 1
    for to in range(2):
        heapq.heappush(heap, (pulled[v, to], np.int64(v), np.int64(to)))


@kernel(exact=True)
def _refine_pass(
    pointers: Any, neighbours: Any, members: Any, part: Any, stamp: int, side: Any, sizes: Any, pulled: Any,
    locked: Any,
) -> bool:  # fmt: skip
    """Move separator nodes, the best first and each once, then undo the moves after the best state.

    Returns whether the separation became better.
    """
    limit = np.int64(_IMBALANCE * len(members)) + 1
    heap = [(np.int64(0), np.int64(0), np.int64(0))]
    heap.pop()
    for v in members:
        if side[v] == 2:
            _count_pulled(pointers, neighbours, part, stamp, side, v, pulled, heap)
    changed = [np.int64(0)]  # nodes whose side changed, in order
    before = [np.int64(0)]
    changed.pop()
    before.pop()
    start = best = _cost(sizes)
    best_changes, dips = 0, 0
    while len(heap) > 0 and dips < _DIPS:
        count, v, to = heapq.heappop(heap)
        if side[v] != 2 or locked[v] or count != pulled[v, to] or sizes[to] + 1 > limit:
            continue  # out of date, moved already, or against the balance
        locked[v] = True
        changed.append(v)
        before.append(np.int64(2))
        _move(pointers, neighbours, part, stamp, side, sizes, v, to, pulled, heap, changed, before)
        dips += 1
        if _cost(sizes) < best:
            best, best_changes, dips = _cost(sizes), len(changed), 0
    while len(changed) > best_changes:
        v, was = changed.pop(), before.pop()
        sizes[side[v]] -= 1
        sizes[was] += 1
        side[v] = was
    for v in members:
        locked[v] = False
    return best < start


@kernel(exact=True)
def _move(
    pointers: Any, neighbours: Any, part: Any, stamp: int, side: Any, sizes: Any, v: Any, to: Any,
    pulled: Any, heap: Any, changed: Any, before: Any,
) -> None:  # fmt: skip
    """Move v from the separator to a side, pull in its neighbours on the other side, update the counts."""
    side[v] = to
    sizes[2] -= 1
    sizes[to] += 1
    for p in range(pointers[v], pointers[v + 1]):
        u = neighbours[p]
        if part[u] != stamp:
            continue
        if side[u] == 2:
            pulled[u, 1 - to] += 1
            heapq.heappush(heap, (pulled[u, 1 - to], np.int64(u), np.int64(1 - to)))
        elif side[u] == 1 - to:
            changed.append(np.int64(u))
            before.append(np.int64(1 - to))
            side[u] = 2
            sizes[1 - to] -= 1
            sizes[2] += 1
            for q in range(pointers[u], pointers[u + 1]):
                x = neighbours[q]
                if part[x] == stamp and side[x] == 2 and x != u:
                    pulled[x, to] -= 1
                    heapq.heappush(heap, (pulled[x, to], np.int64(x), np.int64(to)))
            _count_pulled(pointers, neighbours, part, stamp, side, u, pulled, heap)


@kernel(exact=True)
def _gather_sides(members: Any, side: Any, scratch: Any) -> Any:
    """Reorder the members: side 0, side 1, separator; return the sizes of the sides."""
    count = len(members)
    for k in range(count):
        scratch[k] = members[k]
    at, sizes = 0, np.zeros(3, np.int64)
    for s in range(3):
        for k in range(count):
            if side[scratch[k]] == s:
                members[at] = scratch[k]
                at += 1
                sizes[s] += 1
    return sizes[0], sizes[1]
