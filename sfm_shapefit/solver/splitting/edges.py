"""One pass over the edges: the proximal step of ADMM, fused with everything that reads the same memory.

Both programs are a sum of w_e times the distance of the baseline t_i - t_j to a set of multiples of v_e,

    ShapeFit   { a v_e : a real }    r = x - <x, v> v
    LUD        { a v_e : a >= 1 }    r = x - max(<x, v>, 1) v

so one formula, r = x - max(<x, v>, least) v with least = -inf or 1, serves both. The state of an edge is
one vector x. With radius w_e / rho_e and clip(r) = r shortened to at most the radius, it stands for

    y = x - clip(r)    the copy of t_i - t_j (proximal point of x)
    u = clip(r)        the scaled multiplier; rho u, the dual of the edge, lies in the ball of radius w_e

A pass is cut into a fixed number of chunks of edges, each with its own node sums, which are added in
the order of the chunks: the result does not depend on the number of threads, to the last bit.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, frozen
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.operators import Workers

_CHUNKS = 4  # chunks of edges, whatever the threads; sums have one order
_BLOCK = 64  # edges that are gathered and then worked on together; short loops on contiguous memory
_EDGES_WORTH_A_THREAD = 20_000  # edges; for fewer, handing work to a thread costs more than the work

OBJECTIVE, PAIRING, ALONG, CHANGE, INTERIOR = range(5)
"""Columns of the sums of a pass: w ||r(D T)||, <rho u, D T>, <rho u, v>, rho ||x' - x||^2, and the
number of edges whose dual lies inside its ball."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeData:
    """The edges in the order of the passes (ascending first node, so that memory is read in order)."""

    num_nodes: int
    ends: IntArray
    """(m, 2) nodes (i, j)."""
    directions: FloatArray
    """(m, d) unit v_e."""
    weights: FloatArray
    """(m,) positive w_e."""
    least: float
    """Least multiple of v_e that costs nothing: -inf for ShapeFit, 1 for LUD."""
    order: IntArray | slice
    """(m,) index of each edge in the graph it came from; slice(None) where the order is the graph's."""
    bounds: tuple[int, ...]
    """Chunk k is the edges bounds[k]:bounds[k + 1]."""

    @property
    def axes(self) -> tuple[int, ...]:
        """(0, ..., d - 1); its length tells the compiler the dimension, so that it unrolls loops over it."""
        return tuple(range(self.directions.shape[1]))

    def between(self, first: int, last: int) -> "_Edges":
        """Return what kernels take first to work on some of the edges."""
        return self.axes, first, last, self.ends, self.directions, self.weights, self.least


_Edges = tuple[tuple[int, ...], int, int, IntArray, FloatArray, FloatArray, float]


def edge_data(graph: ViewGraph, least: float) -> EdgeData:
    """Return the edges of a graph, sorted and cut into chunks; shared with the graph if sorted already."""
    keys = graph.edges[:, 0] * graph.num_nodes + graph.edges[:, 1]
    is_sorted = bool((keys[:-1] <= keys[1:]).all())
    order = slice(None) if is_sorted else frozen(np.argsort(keys, kind="stable"))
    m = graph.num_edges
    chunks = _CHUNKS if m >= _EDGES_WORTH_A_THREAD else 1
    return EdgeData(
        num_nodes=graph.num_nodes,
        ends=graph.edges if is_sorted else frozen(graph.edges[order]),
        directions=graph.directions if is_sorted else frozen(graph.directions[order]),
        weights=graph.weights if is_sorted else frozen(graph.weights[order]),
        least=least,
        order=order,
        bounds=tuple(m * k // chunks for k in range(chunks + 1)),
    )


class EdgePasses:
    """The passes over one set of edges, with their buffers and threads. Close it after use."""

    def __init__(self, data: EdgeData, threads: int) -> None:
        """Allocate the node sums of each chunk; `threads` >= 1."""
        self.data = data
        chunks, d = len(data.bounds) - 1, data.directions.shape[1]
        self._sums = np.zeros((chunks, data.num_nodes, d))
        self._totals = np.zeros((chunks, 5))
        self._workers = Workers(min(threads, chunks))

    def close(self) -> None:
        """End the threads."""
        self._workers.close()

    def step(
        self, x: FloatArray, x_next: FloatArray, t: FloatArray, rho: FloatArray, relaxation: float
    ) -> tuple[FloatArray, FloatArray]:
        """Take one proximal step: x_next = relaxation D t + (1 - relaxation) y + u, written; may be x itself.

        Returns D^T rho (y - u - D t) of the new state, (n, d), and the five sums of the pass.
        """

        def chunk(k: int, first: int, last: int) -> None:
            edges = self.data.between(first, last)
            _step(*edges, rho, relaxation, t, x, x_next, self._sums[k], self._totals[k])

        self._totals[...] = 0.0
        pull = self._accumulate(chunk)
        return pull, self._totals.sum(axis=0)

    def pull(self, x: FloatArray, t: FloatArray, rho: FloatArray) -> FloatArray:
        """Return D^T rho (y - u - D t), (n, d): the right-hand side of the correction of t."""
        return self._accumulate(lambda k, a, b: _pull(*self.data.between(a, b), rho, t, x, self._sums[k]))

    def dual(self, x: FloatArray, rho: FloatArray) -> FloatArray:
        """Return rho u, (m, d), in the edge order of the passes."""
        out = np.empty_like(x)
        data, axes = self.data, self.data.axes
        self.over_chunks(
            lambda _k, a, b: _dual(axes, a, b, data.directions, data.weights, data.least, rho, x, out)
        )
        return out

    def in_graph_order(self, values: FloatArray) -> FloatArray:
        """Return an array over edges in the order of the graph; the array itself if that is its order."""
        if isinstance(self.data.order, slice):
            return values
        out = np.empty_like(values)
        out[self.data.order] = values
        return out

    def residuals(self, t: FloatArray) -> FloatArray:
        """Return ||r(t_i - t_j)|| for every edge, (m,)."""
        data, axes = self.data, self.data.axes
        out = np.empty(len(data.ends))
        self.over_chunks(
            lambda _k, a, b: _residuals(axes, a, b, data.ends, data.directions, data.least, t, out)
        )
        return out

    def imbalance(
        self, x_before: FloatArray, x: FloatArray, t: FloatArray, rho: FloatArray
    ) -> tuple[float, float]:
        """Return sum rho ||D t - y||^2 and sum rho ||y - y_before||^2: the primal and the dual residual."""
        totals = np.zeros((len(self.data.bounds) - 1, 2))
        self.over_chunks(lambda k, a, b: _imbalance(*self.data.between(a, b), rho, t, x_before, x, totals[k]))
        primal, dual = totals.sum(axis=0)
        return float(primal), float(dual)

    def change_penalties(self, x: FloatArray, rho: FloatArray, rho_next: FloatArray) -> None:
        """Rewrite x in place so that y and the dual rho u stay what they are under the new penalties."""
        data, axes = self.data, self.data.axes
        self.over_chunks(
            lambda _k, a, b: _change_penalties(
                axes, a, b, data.directions, data.weights, data.least, rho, rho_next, x
            )
        )

    def _accumulate(self, chunk: Callable[[int, int, int], None]) -> FloatArray:
        """Run a pass that adds to node sums, from zero, and return their total in chunk order."""

        def cleared(k: int, first: int, last: int) -> None:
            self._sums[k] = 0.0
            chunk(k, first, last)

        self.over_chunks(cleared)
        total: FloatArray = self._sums[0].copy()
        for part in self._sums[1:]:
            total += part
        return total

    def over_chunks(self, run: Callable[[int, int, int], None]) -> None:
        """Call run(k, first, last) for every chunk of edges."""
        bounds = self.data.bounds
        self._workers.run([partial(run, k, bounds[k], bounds[k + 1]) for k in range(len(bounds) - 1)])


@inner_kernel
def _clip_factor(axes: Any, x: Any, v: Any, e: int, least: float, radius: float) -> Any:
    """Return (a, shrink) of an edge: r = x - a v, clip(r) = shrink * r."""
    d = len(axes)
    a = 0.0
    for k in range(d):
        a += x[e, k] * v[e, k]
    a = max(a, least)
    square = 0.0
    for k in range(d):
        r = x[e, k] - a * v[e, k]
        square += r * r
    return a, radius / max(np.sqrt(square), radius)  # no branch: half of the edges take either side


@kernel
def _step(
    axes: Any, first: int, last: int, ends: Any, v: Any, w: Any, least: float,
    rho: Any, relaxation: float, t: Any, x: Any, x_next: Any, sums: Any, totals: Any,
) -> None:  # fmt: skip
    """Take the proximal step of a chunk; see `EdgePasses.step`."""
    d = len(axes)
    block = np.empty((3 * d + 2, _BLOCK))  # one array: several might overlap, for all the compiler knows
    for begin in range(first, last, _BLOCK):
        count = min(_BLOCK, last - begin)
        for b in range(count):
            e = begin + b
            i, j = ends[e, 0], ends[e, 1]
            for k in range(d):
                block[k, b] = t[i, k] - t[j, k]
                block[d + k, b] = x[e, k]
                block[2 * d + k, b] = v[e, k]
            block[3 * d, b] = w[e]
            block[3 * d + 1, b] = rho[e]
        _advance(axes, block, count, least, relaxation, totals)
        for b in range(count):
            e = begin + b
            i, j = ends[e, 0], ends[e, 1]
            for k in range(d):
                x_next[e, k] = block[d + k, b]
                sums[i, k] += block[k, b]
                sums[j, k] -= block[k, b]


@inner_kernel
def _advance(axes: Any, block: Any, count: int, least: float, relaxation: float, totals: Any) -> None:
    """Take the step for edges side by side, coordinate by coordinate, so that it is vectorized.

    The rows of `block` are D t, x, v, w and rho; D t becomes what is pulled, and x what follows it.
    """
    d = len(axes)
    baseline, x, v, w, rho = block[:d], block[d:], block[2 * d :], block[3 * d], block[3 * d + 1]
    objective, pairing, along, change, interior = 0.0, 0.0, 0.0, 0.0, 0.0
    for b in range(count):
        radius = w[b] / rho[b]
        a = 0.0
        for k in range(d):
            a += x[k, b] * v[k, b]
        a = max(a, least)
        square = 0.0
        for k in range(d):
            r = x[k, b] - a * v[k, b]
            square += r * r
        shrink = radius / max(np.sqrt(square), radius)  # no branch: half of the edges take either side
        moved, length = 0.0, 0.0
        for k in range(d):
            u = shrink * (x[k, b] - a * v[k, b])
            g = relaxation * (baseline[k, b] - x[k, b] + u)
            moved += g * g
            length += baseline[k, b] * v[k, b]
            x[k, b] += g
        a = 0.0
        for k in range(d):
            a += x[k, b] * v[k, b]
        a, length = max(a, least), max(length, least)
        square, missed = 0.0, 0.0
        for k in range(d):
            r = x[k, b] - a * v[k, b]
            square += r * r
            r = baseline[k, b] - length * v[k, b]
            missed += r * r
        shrink = radius / max(np.sqrt(square), radius)
        paired, projected = 0.0, 0.0
        for k in range(d):
            u = shrink * (x[k, b] - a * v[k, b])
            paired += u * baseline[k, b]
            projected += u * v[k, b]
            baseline[k, b] = rho[b] * (x[k, b] - 2.0 * u - baseline[k, b])
        objective += w[b] * np.sqrt(missed)
        pairing += rho[b] * paired
        along += rho[b] * projected
        change += rho[b] * moved
        interior += 1.0 if shrink == 1.0 else 0.0
    totals[0] += objective
    totals[1] += pairing
    totals[2] += along
    totals[3] += change
    totals[4] += interior


@kernel
def _pull(
    axes: Any, first: int, last: int, ends: Any, v: Any, w: Any, least: float,
    rho: Any, t: Any, x: Any, sums: Any,
) -> None:  # fmt: skip
    d = len(axes)
    for e in range(first, last):
        i, j = ends[e, 0], ends[e, 1]
        a, shrink = _clip_factor(axes, x, v, e, least, w[e] / rho[e])
        for k in range(d):
            u = shrink * (x[e, k] - a * v[e, k])
            p = rho[e] * (x[e, k] - 2.0 * u - (t[i, k] - t[j, k]))
            sums[i, k] += p
            sums[j, k] -= p


@kernel
def _dual(axes: Any, first: int, last: int, v: Any, w: Any, least: float, rho: Any, x: Any, out: Any) -> None:
    d = len(axes)
    for e in range(first, last):
        a, shrink = _clip_factor(axes, x, v, e, least, w[e] / rho[e])
        for k in range(d):
            out[e, k] = rho[e] * shrink * (x[e, k] - a * v[e, k])


@kernel
def _residuals(axes: Any, first: int, last: int, ends: Any, v: Any, least: float, t: Any, out: Any) -> None:
    d = len(axes)
    for e in range(first, last):
        i, j = ends[e, 0], ends[e, 1]
        a = 0.0
        for k in range(d):
            a += (t[i, k] - t[j, k]) * v[e, k]
        a = max(a, least)
        square = 0.0
        for k in range(d):
            r = t[i, k] - t[j, k] - a * v[e, k]
            square += r * r
        out[e] = np.sqrt(square)


@kernel
def _imbalance(
    axes: Any, first: int, last: int, ends: Any, v: Any, w: Any, least: float,
    rho: Any, t: Any, x_before: Any, x: Any, totals: Any,
) -> None:  # fmt: skip
    d = len(axes)
    primal, dual = 0.0, 0.0
    for e in range(first, last):
        i, j = ends[e, 0], ends[e, 1]
        a0, shrink0 = _clip_factor(axes, x_before, v, e, least, w[e] / rho[e])
        a1, shrink1 = _clip_factor(axes, x, v, e, least, w[e] / rho[e])
        p, q = 0.0, 0.0
        for k in range(d):
            y0 = x_before[e, k] - shrink0 * (x_before[e, k] - a0 * v[e, k])
            y1 = x[e, k] - shrink1 * (x[e, k] - a1 * v[e, k])
            p += (t[i, k] - t[j, k] - y1) ** 2
            q += (y1 - y0) ** 2
        primal += rho[e] * p
        dual += rho[e] * q
    totals[0] += primal
    totals[1] += dual


@kernel
def _change_penalties(
    axes: Any, first: int, last: int, v: Any, w: Any, least: float, rho: Any, rho_next: Any, x: Any
) -> None:
    d = len(axes)
    for e in range(first, last):
        a, shrink = _clip_factor(axes, x, v, e, least, w[e] / rho[e])
        factor = (rho[e] / rho_next[e] - 1.0) * shrink
        for k in range(d):
            x[e, k] += factor * (x[e, k] - a * v[e, k])
