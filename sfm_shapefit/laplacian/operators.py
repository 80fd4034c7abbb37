"""Laplacians of a graph, as matrices or applied by rows; (D t)_e = t_i - t_j for e = (i, j).

    L = D^T W D                W = diag(w)             graph Laplacian, n x n
    L = D^T diag(B_e) D        B_e symmetric, b x b    block Laplacian, nb x nb

`LaplacianOperator` multiplies without a matrix, by row blocks on several threads.
"""

import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from heapq import heappop, heappush
from typing import Any

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import FloatArray, Int32Array, IntArray, frozen
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.base.threads import count_threads


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
    """Return `edges` as a contiguous (m, 2) int64 array; InputError for a bad index or a self-loop."""
    checked = np.ascontiguousarray(edges, dtype=np.int64).reshape(-1, 2)
    bad = ((checked < 0) | (checked >= num_nodes)).any(axis=1) | (checked[:, 0] == checked[:, 1])
    if bad.any():
        index = int(np.argmax(bad))
        raise InputError(
            f"edge {index} ({checked[index, 0]}, {checked[index, 1]}) must join two different nodes "
            f"of 0..{num_nodes - 1}"
        )
    return checked


def adjacency(num_nodes: int, edges: IntArray) -> Adjacency:
    """Return the neighbors of each of n nodes by checked edges (m, 2); a repeated edge stands repeatedly."""
    ends = frozen(edges.ravel())
    pointers, entries = group_by(ends, num_nodes)
    neighbors = ends[entries ^ 1].astype(np.int32)  # the other end of the same edge
    return Adjacency(frozen(pointers), frozen(neighbors), frozen((entries // 2).astype(np.int32)))


@kernel
def group_by(labels: Any, count: int) -> Any:
    """Sort items by their labels 0..count-1; return where each label begins, (count + 1,), and the items.

    Items of one label stay in their order.
    """
    pointers, items = np.zeros(count + 1, np.int64), np.empty(len(labels), np.int64)
    for k in range(len(labels)):
        pointers[labels[k]] += 1
    for label in range(count):
        pointers[label + 1] += pointers[label]
    for k in range(len(labels) - 1, -1, -1):
        pointers[labels[k]] -= 1
        items[pointers[labels[k]]] = k
    return pointers, items


def even_ranges(starts: IntArray, count: int) -> list[tuple[int, int]]:
    """Cut rows 0..n-1 into ranges of about equally many items, some perhaps empty.

    The items of row i are starts[i]..starts[i+1]-1.
    """
    cuts = np.searchsorted(starts, np.arange(1, count) * (int(starts[-1]) / count)).tolist()
    return list(zip([0, *cuts], [*cuts, len(starts) - 1], strict=True))


_RANGES = 4  # ranges of rows for each thread; with fewer, some threads end long before the others


class Workers:
    """Runs jobs that do not touch each other's results, on up to so many threads, the caller's among them."""

    def __init__(self, threads: int) -> None:
        """Start no thread yet; 0 is one for each core."""
        self.threads = count_threads(threads)
        several = self.threads > 1
        self._helpers = ThreadPoolExecutor(self.threads - 1) if several else None  # end when it is forgotten

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

        self._with_helpers(work, len(jobs))
        if failures:
            raise failures[min(failures)]

    def run_after(self, jobs: Sequence[Callable[[], object]], needs: Sequence[Sequence[int]]) -> None:
        """Run all jobs, each as soon as those before it that it needs have ended; else as `run`.

        Args:
            jobs: see `run`.
            needs: for each job the numbers of others, all less than its own.
        """
        if self._helpers is None or len(jobs) == 1:
            self.run(jobs)
            return
        waits, followers = [len(numbers) for numbers in needs], [list[int]() for _ in jobs]
        for k, numbers in enumerate(needs):
            for number in numbers:
                followers[number].append(k)
        ready = [k for k, count in enumerate(waits) if not count]
        done, changed, failures = list[int](), threading.Condition(), dict[int, BaseException]()

        def work() -> None:
            k = len(jobs)  # an interrupt while a thread waits comes after all failures
            try:
                while True:
                    with changed:
                        changed.wait_for(lambda: ready or failures or len(done) == len(jobs))
                        if failures or not ready:
                            return
                        k = heappop(ready)
                    jobs[k]()
                    with changed:
                        done.append(k)
                        for follower in followers[k]:
                            waits[follower] -= 1
                            if not waits[follower]:
                                heappush(ready, follower)
                        changed.notify_all()
            except BaseException as failure:
                with changed:
                    failures[k] = failure
                    changed.notify_all()

        self._with_helpers(work, len(jobs))
        if failures:
            raise failures[min(failures)]

    def _with_helpers(self, work: Callable[[], None], num_jobs: int) -> None:
        """Work in the caller's thread and in helpers, no more than there are jobs."""
        assert self._helpers is not None
        helpers = [self._helpers.submit(work) for _ in range(min(self.threads, num_jobs) - 1)]
        try:
            work()
        finally:
            for helper in helpers:
                if not helper.cancel():  # one that has not begun has nothing left to do
                    helper.result()

    def share(self, starts: IntArray, work: Callable[[int, int], object], least: int = 1) -> None:
        """Call `work(begin, end)` for ranges of rows, whose answers must not depend on how they are cut.

        Args:
            starts: (n + 1,) where the items of each row begin, by which ranges are cut alike.
            work: see above.
            least: items worth a thread; on fewer, handing work to a thread costs more than the work.
        """
        count = _RANGES * self.threads if self.threads > 1 and starts[-1] >= least else 1
        self.run([partial(work, *rows) for rows in even_ranges(starts, count)])

    def total(self, jobs: Sequence[Callable[[], tuple[FloatArray, ...]]]) -> tuple[FloatArray, ...]:
        """Return the sums of the arrays that jobs return, of which there are 1, 2, 4, 8, ...

        They are added two by two, as in a tree, each sum as soon as both parts of it are there: in one order,
        and few of them are held at a time, log2 of their number where there is one thread.
        """
        waiting, lock = dict[tuple[int, int], tuple[FloatArray, ...]](), threading.Lock()

        def run(k: int) -> None:
            own, width = jobs[k](), 1
            while width < len(jobs):
                with lock:
                    other = waiting.pop((width, k ^ width), None)
                    if other is None:
                        waiting[width, k] = own
                        return
                for total, more in zip(own, other, strict=True):
                    np.add(total, more, out=total)
                k, width = k & ~width, 2 * width
            waiting[width, 0] = own

        self.run([partial(run, k) for k in range(len(jobs))])
        return waiting[len(jobs), 0]


_ENTRIES_WORTH_A_THREAD = 50_000  # entries; on fewer, handing work to a thread costs more than the work


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

    def reweigh(self, weights: FloatArray) -> None:
        """Take other weights, (m,), in place of those before."""
        rounded = weights.astype(np.float32, copy=False)
        np.take(rounded, self.graph.edge_of, out=self._entries, mode="clip")

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

        def work(first: int, last: int) -> None:
            apply(first, last, graph.pointers, graph.neighbors, entries, x, out)

        self._workers.share(graph.pointers, work, _ENTRIES_WORTH_A_THREAD)
        return out


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


@kernel
def apply_blocks(edges: Any, blocks: Any, x: Any, axes: Any, out: Any) -> None:
    """Add D^T diag(B_e) D x to out (n, d); the length of `axes` tells the compiler the dimension."""
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        for a in range(len(axes)):
            pull = 0.0
            for b in range(len(axes)):
                pull += blocks[e, a, b] * (x[i, b] - x[j, b])
            out[i, a] += pull
            out[j, a] -= pull
