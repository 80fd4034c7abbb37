"""Laplacians of a graph, assembled by slots or applied by rows; (D t)_e = t_i - t_j for e = (i, j).

    L = D^T W D                W = diag(w)             graph Laplacian, n x n
    L = D^T diag(B_e) D        B_e symmetric, b x b    block Laplacian, nb x nb

A Laplacian with new weights has the old pattern. `LaplacianPattern` finds once where in the matrix
each edge goes (its slots); `assemble` then only writes, without sorting or allocation of indices.
`LaplacianOperator` multiplies without a matrix, by row blocks on several threads.
"""

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import bsr_array, csr_array

from sfm_shapefit.arrays import FloatArray, IntArray, frozen
from sfm_shapefit.errors import InputError
from sfm_shapefit.jit import kernel

Int32Array = npt.NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False)
class Adjacency:
    """The neighbors of each node, in compressed rows; within a row in the order of the edges."""

    pointers: IntArray
    """(n + 1,) row i is `neighbors[pointers[i]:pointers[i + 1]]`."""
    neighbors: Int32Array
    """(2m,) node indices."""
    edge_of: Int32Array
    """(2m,) the edge behind each entry."""

    @property
    def num_nodes(self) -> int:
        """Number of nodes, n."""
        return len(self.pointers) - 1


def check_edges(num_nodes: int, edges: npt.ArrayLike) -> IntArray:
    """Return `edges` as a contiguous (m, 2) int64 array.

    Raises:
        InputError: if an edge leaves [0, num_nodes) or joins a node with itself.
    """
    array = np.ascontiguousarray(edges, dtype=np.int64).reshape(-1, 2)
    if array.size and (array.min() < 0 or array.max() >= num_nodes):
        raise InputError(f"an edge leaves the nodes 0..{num_nodes - 1}; give indices in [0, n)")
    if (array[:, 0] == array[:, 1]).any():
        raise InputError("an edge joins a node with itself; remove it")
    return array


def adjacency(num_nodes: int, edges: IntArray) -> Adjacency:
    """Return the neighbors of each node; a repeated edge stands repeatedly.

    Args:
        num_nodes: n.
        edges: (m, 2) int64, checked.
    """
    return Adjacency(*(frozen(part) for part in _adjacency(num_nodes, frozen(edges))))


@kernel
def _adjacency(num_nodes: int, edges: Any) -> Any:
    """Counting sort of both ends of the edges by node."""
    m = edges.shape[0]
    pointers = np.zeros(num_nodes + 1, np.int64)
    for e in range(m):
        pointers[edges[e, 0] + 1] += 1
        pointers[edges[e, 1] + 1] += 1
    for i in range(num_nodes):
        pointers[i + 1] += pointers[i]
    fill = pointers[:-1].copy()
    neighbors = np.empty(2 * m, np.int32)
    edge_of = np.empty(2 * m, np.int32)
    for e in range(m):
        i, j = edges[e, 0], edges[e, 1]
        neighbors[fill[i]], edge_of[fill[i]] = j, e
        neighbors[fill[j]], edge_of[fill[j]] = i, e
        fill[i] += 1
        fill[j] += 1
    return pointers, neighbors, edge_of


@dataclass(frozen=True, slots=True, eq=False)
class LaplacianPattern:
    """Where each edge stands in the assembled Laplacian: pattern and slots, found once per graph."""

    pointers: IntArray
    """(n + 1,) row pointers of the compressed (block) rows."""
    columns: Int32Array
    """(q,) column of each stored (block) entry, ascending within a row; the diagonal is stored."""
    diagonal: IntArray
    """(n,) slot of each diagonal entry."""
    upper: IntArray
    """(m,) slot of entry (i, j) of each edge (i, j)."""
    lower: IntArray
    """(m,) slot of entry (j, i)."""
    edges: IntArray
    """(m, 2) the edges."""


def laplacian_pattern(num_nodes: int, edges: npt.ArrayLike) -> LaplacianPattern:
    """Find the pattern and the slots of the Laplacian of a graph; repeated edges share their slots.

    Args:
        num_nodes: n.
        edges: (m, 2) node indices.

    Raises:
        InputError: if an edge leaves [0, num_nodes) or joins a node with itself.
    """
    pairs = check_edges(num_nodes, edges)
    m = len(pairs)
    nodes = np.arange(num_nodes)
    rows = np.concatenate([nodes, pairs[:, 0], pairs[:, 1]])
    columns = np.concatenate([nodes, pairs[:, 1], pairs[:, 0]])
    keys, slots = np.unique(rows * num_nodes + columns, return_inverse=True)
    pointers = np.searchsorted(keys, np.arange(num_nodes + 1) * num_nodes)
    parts = np.split(slots.astype(np.int64), [num_nodes, num_nodes + m])
    diagonal, upper, lower = (frozen(part) for part in parts)
    column = frozen((keys % max(num_nodes, 1)).astype(np.int32))
    return LaplacianPattern(frozen(pointers.astype(np.int64)), column, diagonal, upper, lower, frozen(pairs))


def assemble(
    pattern: LaplacianPattern, weights: FloatArray, out: FloatArray | None = None
) -> csr_array | bsr_array:
    """Return the Laplacian with the given edge weights as a scipy matrix.

    Args:
        pattern: from `laplacian_pattern`.
        weights: (m,) for the graph Laplacian, or (m, b, b) symmetric blocks for the block Laplacian.
        out: the `data` of a matrix assembled before, (q,) or (q, b, b), overwritten and shared if given.

    Returns:
        (n, n) csr_array, or (nb, nb) bsr_array, float64.
    """
    w = np.ascontiguousarray(weights, dtype=np.float64)
    shape = (len(pattern.columns), *w.shape[1:])
    data = np.empty(shape) if out is None else out
    block = 1 if w.ndim == 1 else w.shape[1]
    data[...] = 0.0
    _assemble(
        pattern.edges, pattern.diagonal, pattern.upper, pattern.lower,
        w.reshape(len(w), -1), data.reshape(len(data), -1),
    )  # fmt: skip
    n = len(pattern.diagonal) * block
    indices = (data, pattern.columns, pattern.pointers)
    return csr_array(indices, shape=(n, n)) if w.ndim == 1 else bsr_array(indices, shape=(n, n))


@kernel
def _assemble(edges: Any, diagonal: Any, upper: Any, lower: Any, weights: Any, data: Any) -> None:
    for e in range(edges.shape[0]):
        i, j = diagonal[edges[e, 0]], diagonal[edges[e, 1]]
        for k in range(weights.shape[1]):
            w = weights[e, k]
            data[i, k] += w
            data[j, k] += w
            data[upper[e], k] -= w
            data[lower[e], k] -= w


class Workers:
    """Runs jobs that do not touch each other's results, on up to so many threads, the caller's among them."""

    def __init__(self, threads: int) -> None:
        """Start no thread yet; `threads` >= 1."""
        self.threads = threads
        self._helpers = ThreadPoolExecutor(threads - 1) if threads > 1 else None  # end when it is forgotten

    def close(self) -> None:
        """End the threads now."""
        if self._helpers is not None:
            self._helpers.shutdown()

    def run(self, jobs: Sequence[Callable[[], object]]) -> None:
        """Run all jobs, in order where there is one thread; raise what the first failed one raised.

        Passes are so short that waking a thread counts: the caller begins at once, and helpers join it.
        """
        if self._helpers is None or len(jobs) == 1:
            for job in jobs:
                job()
            return
        waiting = deque(enumerate(jobs))
        failures: dict[int, BaseException] = {}

        def work() -> None:
            while waiting:
                try:
                    k, job = waiting.popleft()
                except IndexError:  # another thread took the last one
                    return
                try:
                    job()
                except BaseException as failure:
                    failures[k] = failure

        helpers = [self._helpers.submit(work) for _ in range(min(self.threads, len(jobs)) - 1)]
        try:
            work()
        finally:
            for helper in helpers:
                helper.result()
        if failures:
            raise failures[min(failures)]


_ROW_BLOCKS = 8

# On fewer entries, handing work to a thread costs more than the work.
_ENTRIES_WORTH_A_THREAD = 50_000


class LaplacianOperator:
    """The product with one Laplacian, for many products: its weights stand where they are read.

    They are rounded to float32, the same in both directions of an edge. So the operator is the exact
    Laplacian of weights that differ by 6e-8, relatively, from those given.
    """

    def __init__(self, graph: Adjacency, weights: FloatArray, workers: Workers) -> None:
        """Copy the weights, (m,), to the entries of the adjacency."""
        self.graph = graph
        self._entries = np.empty(len(graph.edge_of), np.float32)
        self.reweigh(weights)
        self._workers = workers
        entries = len(graph.neighbors)
        blocks = _ROW_BLOCKS if entries >= _ENTRIES_WORTH_A_THREAD and workers.threads > 1 else 1
        cuts = np.searchsorted(graph.pointers, np.arange(1, blocks) * (entries // blocks))
        self._bounds = [0, *(int(cut) for cut in cuts), graph.num_nodes]

    def reweigh(self, weights: FloatArray) -> None:
        """Take other weights, (m,), in place of those before."""
        _write_entries(self.graph.edge_of, weights, self._entries)

    def diagonal(self) -> FloatArray:
        """Return the weighted degree of each node, (n,)."""
        degree = np.empty(self.graph.num_nodes)
        _degrees(self.graph.pointers, self._entries, degree)
        return degree

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return L x, (n, k). Each row is one sum in the order of the adjacency, whatever the threads."""
        out = np.empty_like(x, order="C")
        apply = _apply_entries_3 if x.shape[1] == 3 else _apply_entries
        graph, entries = self.graph, self._entries

        def job(first: int, last: int) -> Callable[[], object]:
            return lambda: apply(first, last, graph.pointers, graph.neighbors, entries, x, out)

        self._workers.run([job(a, b) for a, b in zip(self._bounds, self._bounds[1:], strict=False)])
        return out


@kernel
def _write_entries(edge_of: Any, weights: Any, out: Any) -> None:
    for p in range(len(out)):
        out[p] = weights[edge_of[p]]


@kernel
def _degrees(pointers: Any, entries: Any, out: Any) -> None:
    for i in range(len(out)):
        total = 0.0
        for p in range(pointers[i], pointers[i + 1]):
            total += np.float64(entries[p])
        out[i] = total


@kernel
def _apply_entries_3(
    first: int, last: int, pointers: Any, neighbors: Any, entries: Any, x: Any, out: Any
) -> None:
    for i in range(first, last):
        degree, s0, s1, s2 = 0.0, 0.0, 0.0, 0.0
        for p in range(pointers[i], pointers[i + 1]):
            j, w = neighbors[p], np.float64(entries[p])
            degree += w
            s0 += w * x[j, 0]
            s1 += w * x[j, 1]
            s2 += w * x[j, 2]
        out[i, 0], out[i, 1], out[i, 2] = degree * x[i, 0] - s0, degree * x[i, 1] - s1, degree * x[i, 2] - s2


@kernel
def _apply_entries(
    first: int, last: int, pointers: Any, neighbors: Any, entries: Any, x: Any, out: Any
) -> None:
    for i in range(first, last):
        for k in range(x.shape[1]):
            total = 0.0
            for p in range(pointers[i], pointers[i + 1]):
                total += np.float64(entries[p]) * (x[i, k] - x[neighbors[p], k])
            out[i, k] = total
