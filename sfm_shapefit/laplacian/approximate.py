"""Preconditioners without fill, and conjugate gradients: for graphs whose Cholesky factor would not fit.

Eliminating a node v with neighbours of weights w_1 <= ... <= w_d, W = sum w, adds the clique of weights
w_i w_j / W. Approximate Cholesky replaces the clique by d - 1 sampled edges of the right mean: each i < d is
joined to one later j, drawn with probability w_j / (w_{i+1} + ... + w_d), with weight
w_i (w_{i+1} + ... + w_d) / W. So the number of edges never grows.

Sources: Kyng, Sachdeva 2016, "Approximate Gaussian elimination for Laplacians"; Gao, Kyng, Spielman 2023,
"Robust and practical solution of Laplacian equations by approximate elimination" (the order by degree and
the sampling after sorting). Draws come from a counter-free generator with an explicit seed: the same seed
gives the same factor on every machine.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

from sfm_shapefit.arrays import FloatArray, IntArray, frozen
from sfm_shapefit.jit import kernel
from sfm_shapefit.laplacian.operators import Adjacency, Int32Array

Operator = Callable[[FloatArray], FloatArray]


class Preconditioner(Protocol):
    """Anything that maps a residual (n, k) to an approximate solution of L x = residual."""

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Return the approximate solution, (n, k)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class JacobiPreconditioner:
    """Division by the diagonal: enough for random graphs, hopeless on long ones."""

    diagonal: FloatArray
    """(n,) weighted degree of each node; nodes of degree 0 are left alone."""

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Return rhs / diagonal, (n, k)."""
        return rhs / np.where(self.diagonal > 0.0, self.diagonal, 1.0)[:, None]


@dataclass(frozen=True, slots=True, eq=False)
class ApproximateCholesky:
    """A sampled factor L ~ F diag(pivots) F^T with F unit lower triangular in the order of elimination."""

    permutation: IntArray
    """(n,) the node that is eliminated k-th."""
    pointers: IntArray
    """(n + 1,) column k of F is entries `pointers[k]:pointers[k + 1]`."""
    rows: Int32Array
    """Elimination steps of the entries below the diagonal."""
    fractions: npt.NDArray[np.float32]
    """Minus these entries: the share of each neighbour in the weighted degree of the eliminated node."""
    pivots: FloatArray
    """(n,) weighted degree at elimination; 0 for the last node of each component."""

    @property
    def num_entries(self) -> int:
        """Stored entries of F, 8 bytes each."""
        return len(self.rows)

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Return F^-T diag(pivots)^-1 F^-1 rhs for each column of rhs, (n, k)."""
        x = np.ascontiguousarray(rhs[self.permutation], dtype=np.float64)
        substitute = _substitute_3 if x.shape[1] == 3 else _substitute
        substitute(self.pointers, self.rows, self.fractions, self.pivots, x)
        out = np.empty_like(x)
        out[self.permutation] = x
        return out


def jacobi(graph: Adjacency, weights: FloatArray) -> JacobiPreconditioner:
    """Return the Jacobi preconditioner of the graph Laplacian with edge weights (m,)."""
    degree = np.bincount(
        np.repeat(np.arange(graph.num_nodes), np.diff(graph.pointers)),
        weights=weights[graph.edge_of],
        minlength=graph.num_nodes,
    )
    return JacobiPreconditioner(frozen(degree))


def approximate_cholesky(graph: Adjacency, weights: FloatArray, seed: int) -> ApproximateCholesky:
    """Return a sampled Cholesky factor of the graph Laplacian.

    Args:
        graph: the neighbours of each node.
        weights: (m,) non-negative edge weights; edges of weight 0 do not count.
        seed: of the draws; any integer.
    """
    w = np.ascontiguousarray(weights, dtype=np.float64)
    if not (np.isfinite(w).all() and (w >= 0.0).all()):
        raise ValueError("approximate Cholesky needs finite weights >= 0")
    state = np.array([seed & 0xFFFFFFFFFFFFFFFF], dtype=np.uint64)
    permutation, pointers, rows, fractions, pivots = _eliminate_all(
        graph.pointers, graph.neighbours, graph.edge_of, w, state
    )
    return ApproximateCholesky(
        frozen(permutation), frozen(pointers), frozen(rows), frozen(fractions), frozen(pivots)
    )


@kernel(exact=True)
def _uniform(state: Any) -> float:
    """Return the next draw from [0, 1) (splitmix64: Steele, Lea, Flood 2014)."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return (z >> np.uint64(11)) * (1.0 / 9007199254740992.0)  # type: ignore[no-any-return]


@kernel(exact=True)
def _push(bucket: Any, above: Any, below: Any, degree: Any, v: int) -> None:
    """Put node v first into the bucket of its degree."""
    first = bucket[degree[v]]
    above[v] = -1
    below[v] = first
    if first >= 0:
        above[first] = v
    bucket[degree[v]] = v


@kernel(exact=True)
def _remove(bucket: Any, above: Any, below: Any, degree: Any, v: int) -> None:
    """Take node v out of the bucket of its degree."""
    if above[v] >= 0:
        below[above[v]] = below[v]
    else:
        bucket[degree[v]] = below[v]
    if below[v] >= 0:
        above[below[v]] = above[v]


@kernel(exact=True)
def _grown(array: Any, size: int) -> Any:
    """Return a copy of an array with room for `size` entries."""
    larger = np.empty(size, array.dtype)
    larger[: len(array)] = array
    return larger


@kernel(exact=True)
def _merged_star(
    v: int, head: Any, follow: Any, ends: Any, values: Any, step: Any, place: Any, star: Any, star_weight: Any,
    copies: Any,
) -> Any:  # fmt: skip
    """Collect the neighbours of v that are left, parallel edges summed; return their number and the list's end."""
    size, entry, last = 0, head[v], -1
    while entry >= 0:
        u = ends[entry]
        if step[u] < 0:
            if place[u] < 0:
                place[u] = size
                star[size], star_weight[size], copies[size] = u, 0.0, 0
                size += 1
            star_weight[place[u]] += values[entry]
            copies[place[u]] += 1
        last = entry
        entry = follow[entry]
    for k in range(size):
        place[star[k]] = -1
    return size, last


@kernel(exact=True)
def _eliminate_all(pointers: Any, neighbours: Any, edge_of: Any, weights: Any, state: Any) -> Any:
    """Eliminate all nodes, each time one with the fewest edges left."""
    n = len(pointers) - 1
    room = len(neighbours) + len(neighbours) // 4 + 4 * n + 16
    head = np.full(n, -1, np.int32)  # each node's edges are a linked list; both ends hold an edge
    follow = np.empty(room, np.int32)
    ends = np.empty(room, np.int32)
    values = np.empty(room, np.float64)
    degree = np.zeros(n, np.int64)
    used = 0
    for v in range(n):
        for p in range(pointers[v], pointers[v + 1]):
            w = weights[edge_of[p]]
            if w > 0.0:
                ends[used], values[used], follow[used] = neighbours[p], w, head[v]
                head[v] = used
                used += 1
                degree[v] += 1
    free = np.int64(-1)  # list of entries that can be used again
    limit = n + 1
    for v in range(n):
        limit = max(limit, degree[v] + 1)
    bucket = np.full(limit + 1, -1, np.int64)
    above = np.empty(n, np.int64)
    below = np.empty(n, np.int64)
    for v in range(n - 1, -1, -1):
        _push(bucket, above, below, degree, v)

    step = np.full(n, -1, np.int32)
    place = np.full(n, -1, np.int64)
    star = np.empty(n, np.int64)
    star_weight = np.empty(n, np.float64)
    copies = np.empty(n, np.int64)
    partial = np.empty(n + 1, np.float64)
    permutation = np.empty(n, np.int64)
    pivots = np.zeros(n)
    columns = np.zeros(n + 1, np.int64)
    rows = np.empty(used // 2 + n, np.int32)
    fractions = np.empty(used // 2 + n, np.float32)
    lowest = 0
    for k in range(n):
        while bucket[lowest] < 0:
            lowest += 1
        v = bucket[lowest]
        _remove(bucket, above, below, degree, v)
        size, last = _merged_star(v, head, follow, ends, values, step, place, star, star_weight, copies)
        if last >= 0:  # the whole list of v can be used again
            follow[last] = free
            free = head[v]
        step[v] = k
        permutation[k] = v
        at = columns[k]
        columns[k + 1] = at + size
        if at + size > len(rows):
            rows = _grown(rows, 2 * (at + size))
            fractions = _grown(fractions, 2 * (at + size))
        order = np.argsort(star_weight[:size], kind="mergesort")
        partial[size] = 0.0
        for a in range(size - 1, -1, -1):
            partial[a] = partial[a + 1] + star_weight[order[a]]
        total = partial[0]
        pivots[k] = total if size > 0 else 0.0
        for a in range(size):
            u = star[order[a]]
            rows[at + a] = u  # node now, step once all steps are known
            fractions[at + a] = star_weight[order[a]] / total
            _remove(bucket, above, below, degree, u)
            degree[u] -= copies[order[a]]
        for a in range(size - 1):
            rest = partial[a + 1]
            target = rest * (1.0 - _uniform(state))  # in (0, rest]
            low, high = a + 1, size - 1
            while low < high:  # the last index whose tail sum is still >= target
                middle = (low + high + 1) // 2
                if partial[middle] >= target:
                    low = middle
                else:
                    high = middle - 1
            i, j = star[order[a]], star[order[low]]
            w = star_weight[order[a]] * rest / total
            for end in range(2):
                here, there = (i, j) if end == 0 else (j, i)
                if free >= 0:
                    entry = free
                    free = np.int64(follow[free])
                else:
                    if used == len(ends):
                        ends, follow = _grown(ends, 2 * used), _grown(follow, 2 * used)
                        values = _grown(values, 2 * used)
                    entry = np.int64(used)
                    used += 1
                ends[entry], values[entry], follow[entry] = there, w, head[here]
                head[here] = entry
                degree[here] += 1
        for a in range(size):
            u = star[order[a]]
            degree[u] = min(degree[u], limit)
            _push(bucket, above, below, degree, u)
            lowest = min(lowest, degree[u])
    count = columns[n]
    out = np.empty(count, np.int32)
    for p in range(count):
        out[p] = step[rows[p]]
    return permutation, columns, out, fractions[:count].copy(), pivots


@kernel(exact=True)
def _substitute_3(pointers: Any, rows: Any, fractions: Any, pivots: Any, x: Any) -> None:
    """Apply the inverse of the factor to three columns in place."""
    n = len(pivots)
    for k in range(n):
        x0, x1, x2 = x[k, 0], x[k, 1], x[k, 2]
        for p in range(pointers[k], pointers[k + 1]):
            f, i = np.float64(fractions[p]), rows[p]
            x[i, 0] += f * x0
            x[i, 1] += f * x1
            x[i, 2] += f * x2
        scale = 1.0 / pivots[k] if pivots[k] > 0.0 else 0.0
        x[k, 0], x[k, 1], x[k, 2] = scale * x0, scale * x1, scale * x2
    for k in range(n - 1, -1, -1):
        x0, x1, x2 = x[k, 0], x[k, 1], x[k, 2]
        for p in range(pointers[k], pointers[k + 1]):
            f, i = np.float64(fractions[p]), rows[p]
            x0 += f * x[i, 0]
            x1 += f * x[i, 1]
            x2 += f * x[i, 2]
        x[k, 0], x[k, 1], x[k, 2] = x0, x1, x2


@kernel(exact=True)
def _substitute(pointers: Any, rows: Any, fractions: Any, pivots: Any, x: Any) -> None:
    """Apply the inverse of the factor to each column in place."""
    n, width = x.shape
    for k in range(n):
        scale = 1.0 / pivots[k] if pivots[k] > 0.0 else 0.0
        for p in range(pointers[k], pointers[k + 1]):
            for c in range(width):
                x[rows[p], c] += fractions[p] * x[k, c]
        for c in range(width):
            x[k, c] *= scale
    for k in range(n - 1, -1, -1):
        for p in range(pointers[k], pointers[k + 1]):
            for c in range(width):
                x[k, c] += fractions[p] * x[rows[p], c]


@dataclass(frozen=True, slots=True, eq=False)
class GradientsResult:
    """An answer of `conjugate_gradients` with the evidence for it."""

    x: FloatArray
    """(n, k) the solution, of mean 0 in each column."""
    iterations: int
    """Products with the operator, after the first residual."""
    residual: float
    """Largest ||rhs - L x|| of a column, relative to what `relative_to` says."""
    converged: bool
    """Whether `residual` is at most the tolerance."""


def conjugate_gradients(
    operator: Operator,
    preconditioner: Preconditioner,
    rhs: FloatArray,
    *,
    start: FloatArray | None = None,
    tol: float = 1e-10,
    max_iterations: int = 500,
    relative_to: Literal["rhs", "start"] = "rhs",
    coupled: bool = False,
) -> GradientsResult:
    """Solve L x = rhs for a Laplacian L by preconditioned conjugate gradients.

    Args:
        operator: maps (n, k) to L times it.
        preconditioner: an `ApproximateCholesky`, `JacobiPreconditioner` or `CholeskyFactor`.
        rhs: (n, k); its column means are ignored, for L has no such vectors in its range.
        start: (n, k) first guess, 0 if None.
        tol: stop when each residual is at most this, relative to `relative_to`.
        max_iterations: hard limit, reported in `converged`.
        relative_to: "rhs", or "start": the residual of the first guess (a warm start must improve by `tol`).
        coupled: the k columns are one vector of an (nk x nk) system, not k separate systems.

    Raises:
        ValueError: if the shapes of `rhs` and `start` differ.
    """
    b = rhs - rhs.mean(axis=0)
    x = np.zeros_like(b) if start is None else np.array(start, dtype=np.float64)
    if x.shape != b.shape:
        raise ValueError(f"start has shape {x.shape}, rhs has {b.shape}")
    r = b if start is None else b - operator(x)
    scale = _norms(b if relative_to == "rhs" else r, coupled)
    scale = np.where(scale > 0.0, scale, 1.0)
    p = np.zeros_like(b)
    rho_before = np.ones_like(scale)
    k = 0
    while (_norms(r, coupled) > tol * scale).any() and k < max_iterations:
        z = preconditioner.solve(r)
        z = z - z.mean(axis=0)
        rho = _products(r, z, coupled)
        p = z + (rho / rho_before if k else 0.0) * p
        q = operator(p)
        curvature = _products(p, q, coupled)
        alpha = np.divide(rho, curvature, out=np.zeros_like(rho), where=curvature > 0.0)
        x = x + alpha * p
        r = r - alpha * q
        rho_before = np.where(rho > 0.0, rho, 1.0)
        k += 1
    residual = float(np.max(_norms(r, coupled) / scale, initial=0.0))
    return GradientsResult(x - x.mean(axis=0), k, residual, bool(residual <= tol))


def _products(a: FloatArray, b: FloatArray, coupled: bool) -> FloatArray:
    """Return the inner products of the columns, (k,), or of the whole, (1,)."""
    products = np.einsum("ij,ij->j", a, b)
    return products.sum(keepdims=True) if coupled else products


def _norms(a: FloatArray, coupled: bool) -> FloatArray:
    """Return the norms of the columns, (k,), or of the whole, (1,)."""
    return np.sqrt(_products(a, a, coupled))
