"""Preconditioners without fill, and conjugate gradients: for graphs whose Cholesky factor would not fit.

Eliminating a node v with neighbors of weights w_1 <= ... <= w_d, W = sum w, adds the clique of weights
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
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import FloatArray, Int32Array, IntArray, frozen
from sfm_shapefit.base.jit import inner_kernel, kernel, mix_bits
from sfm_shapefit.laplacian.operators import Adjacency, LaplacianOperator

_DIVERGED = 1e6  # residual over the least so far; such a one shows that rounding leads, no longer the system

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
    """Minus these entries: the share of each neighbor in the weighted degree of the eliminated node."""
    pivots: FloatArray
    """(n,) weighted degree at elimination; 0 for the last node of each component."""

    def solve(self, rhs: FloatArray) -> FloatArray:
        """Return F^-T diag(pivots)^-1 F^-1 rhs for each column of rhs, (n, k)."""
        out = np.empty(rhs.shape)
        for k in range(0, rhs.shape[1], 3):
            width = min(rhs.shape[1] - k, 3)
            x = np.zeros((len(rhs), 3))
            x[:, :width] = rhs[self.permutation, k : k + 3]
            _substitute(self.pointers, self.rows, self.fractions, self.pivots, x)
            out[self.permutation, k : k + 3] = x[:, :width]
        return out


def approximate_cholesky(graph: Adjacency, weights: FloatArray, seed: int) -> ApproximateCholesky:
    """Return a sampled Cholesky factor of a graph Laplacian; `seed`, any integer, fixes its draws.

    The weights (m,) are non-negative; edges of weight 0 do not count.
    """
    w = frozen(np.ascontiguousarray(weights, dtype=np.float64).view())
    if not (np.isfinite(w).all() and (w >= 0.0).all()):
        raise ValueError("approximate Cholesky needs finite weights >= 0")
    state = np.array([seed & 0xFFFFFFFFFFFFFFFF], dtype=np.uint64)
    permutation, pointers, *entries, pivots = _eliminate_all(
        graph.pointers, graph.neighbors, graph.edge_of, w, state
    )
    entries = [entry[: pointers[-1]].copy() for entry in entries]
    return ApproximateCholesky(*(frozen(part) for part in (permutation, pointers, *entries, pivots)))


@inner_kernel
def _uniform(state: Any) -> float:
    """Return the next draw from [0, 1), by splitmix64."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    return (mix_bits(state[0]) >> np.uint64(11)) * (1.0 / 9007199254740992.0)  # type: ignore[no-any-return]


@inner_kernel
def _push(bucket: Any, above: Any, below: Any, degree: Any, v: int) -> None:
    """Put node v first into the bucket of its degree."""
    first = bucket[degree[v]]
    above[v] = -1
    below[v] = first
    if first >= 0:
        above[first] = v
    bucket[degree[v]] = v


@inner_kernel
def _remove(bucket: Any, above: Any, below: Any, degree: Any, v: Any) -> None:
    """Take node v out of the bucket of its degree."""
    if above[v] >= 0:
        below[above[v]] = below[v]
    else:
        bucket[degree[v]] = below[v]
    if below[v] >= 0:
        above[below[v]] = above[v]


@inner_kernel
def _enlarge(array: Any, size: int) -> Any:
    """Return a copy of an array (.,) with room for `size` entries."""
    larger = np.empty(size, array.dtype)
    for k in range(len(array)):
        larger[k] = array[k]
    return larger


@inner_kernel
def _enlarge_links(links: Any, size: int) -> Any:
    """Return a copy of links (., 2) with room for `size` of them."""
    larger = np.empty((size, 2), np.int32)
    for k in range(len(links)):
        larger[k, 0], larger[k, 1] = links[k, 0], links[k, 1]
    return larger


@inner_kernel
def _edge_lists(pointers: Any, neighbors: Any, edge_of: Any, weights: Any) -> Any:
    """Store the edges of positive weight as linked lists, one per node; both ends hold an edge.

    Returns the heads, `links` (next entry, other end), weights, degrees, and the pool: [first free entry,
    entries used].
    """
    n = len(pointers) - 1
    head = np.full(n, -1, np.int64)
    links = np.empty((len(neighbors) + 4 * n + 16, 2), np.int32)
    values = np.empty(len(links), np.float64)
    degree = np.zeros(n, np.int64)
    used = 0
    for v in range(n):
        for p in range(pointers[v], pointers[v + 1]):
            w = weights[edge_of[p]]
            if w > 0.0:
                links[used, 0], links[used, 1], values[used] = head[v], neighbors[p], w
                head[v] = used
                used += 1
                degree[v] += 1
    return head, links, values, degree, np.array([-1, used])


@inner_kernel
def _add_entry(
    head: Any, links: Any, values: Any, degree: Any, pool: Any, here: int, there: int, w: float
) -> None:
    """Add an entry to the list of node `here`."""
    entry = pool[0]
    if entry >= 0:
        pool[0] = links[entry, 0]
    else:
        entry = pool[1]
        pool[1] += 1
    links[entry, 0], links[entry, 1], values[entry] = head[here], there, w
    head[here] = entry
    degree[here] += 1


@inner_kernel
def _merge_star(
    v: int, head: Any, links: Any, values: Any, degree: Any, pool: Any, bucket: Any, above: Any,
    below: Any, step: Any, place: Any, star: Any, star_weight: Any,
) -> int:  # fmt: skip
    """Collect the neighbors of v that are left, parallel edges summed, and free v's list.

    Returns their number. Each neighbor leaves its bucket; its degree falls by the number of its edges to v.
    """
    size, entry, last = 0, head[v], -1
    while entry >= 0:
        u = np.int64(links[entry, 1])
        if step[u] < 0:
            if place[u] < 0:
                _remove(bucket, above, below, degree, u)
                place[u] = size
                star[size], star_weight[size] = u, 0.0
                size += 1
            star_weight[place[u]] += values[entry]
            degree[u] -= 1
        last = entry
        entry = np.int64(links[entry, 0])
    if last >= 0:
        links[last, 0] = pool[0]
        pool[0] = head[v]
    for k in range(size):
        place[star[k]] = -1
    return size


@inner_kernel
def _sort_star(size: int, star: Any, star_weight: Any, tail: Any) -> None:
    """Sort the neighbors by weight, ascending, equal ones by node; sum the weights from each to the last.

    Shell's method with Ciura's gaps: no allocation, and insertion sort where a star is small.
    """
    for gap in (4061, 1750, 701, 301, 132, 57, 23, 10, 4, 1):
        for i in range(gap, size):
            w, u = star_weight[i], star[i]
            j = i - gap
            while j >= 0 and (star_weight[j] > w or (star_weight[j] == w and star[j] > u)):
                star_weight[j + gap], star[j + gap] = star_weight[j], star[j]
                j -= gap
            star_weight[j + gap], star[j + gap] = w, u
    tail[size] = 0.0
    for i in range(size - 1, -1, -1):
        tail[i] = tail[i + 1] + star_weight[i]


@inner_kernel
def _sample_clique(
    size: int, star: Any, star_weight: Any, tail: Any, head: Any, links: Any, values: Any, degree: Any,
    pool: Any, state: Any,
) -> None:  # fmt: skip
    """Join each neighbor to one of larger weight, drawn in proportion to the weights."""
    for a in range(size - 1):
        target = tail[a + 1] * (1.0 - _uniform(state))  # in (0, tail[a + 1]]
        low, high = a + 1, size - 1
        while low < high:  # the last index whose tail is still >= target
            middle = (low + high + 1) // 2
            if tail[middle] >= target:
                low = middle
            else:
                high = middle - 1
        w = star_weight[a] * tail[a + 1] / tail[0]
        _add_entry(head, links, values, degree, pool, star[a], star[low], w)
        _add_entry(head, links, values, degree, pool, star[low], star[a], w)


@kernel
def _eliminate_all(pointers: Any, neighbors: Any, edge_of: Any, weights: Any, state: Any) -> Any:
    """Eliminate all nodes, each time one with the fewest edges left; rows and fractions have room left."""
    n = len(pointers) - 1
    head, links, values, degree, pool = _edge_lists(pointers, neighbors, edge_of, weights)
    bucket = np.full(len(neighbors) + 2, -1, np.int64)
    above, below = np.empty(n, np.int64), np.empty(n, np.int64)
    for v in range(n - 1, -1, -1):
        _push(bucket, above, below, degree, v)
    step, place = np.full(n, -1, np.int32), np.full(n, -1, np.int64)
    star, star_weight, tail = np.empty(n, np.int64), np.empty(n), np.empty(n + 1)
    permutation, pivots, columns = np.empty(n, np.int64), np.empty(n), np.zeros(n + 1, np.int64)
    rows = np.empty(len(neighbors) + n, np.int32)
    fractions = np.empty(len(rows), np.float32)
    lowest = 0
    for k in range(n):
        while bucket[lowest] < 0:
            lowest += 1
        v = bucket[lowest]
        _remove(bucket, above, below, degree, v)
        size = _merge_star(
            v, head, links, values, degree, pool, bucket, above, below, step, place, star, star_weight
        )
        _sort_star(size, star, star_weight, tail)
        step[v], permutation[k], pivots[k] = k, v, tail[0]
        end = columns[k] + size
        columns[k + 1] = end
        if end > len(rows):
            rows, fractions = _enlarge(rows, 2 * end), _enlarge(fractions, 2 * end)
        if pool[1] + 2 * size > len(values):
            links, values = _enlarge_links(links, 2 * len(values)), _enlarge(values, 2 * len(values))
        for a in range(size):  # nodes now, steps once all steps are known
            rows[end - size + a], fractions[end - size + a] = star[a], star_weight[a] / tail[0]
        _sample_clique(size, star, star_weight, tail, head, links, values, degree, pool, state)
        for a in range(size):
            _push(bucket, above, below, degree, star[a])
            lowest = min(lowest, degree[star[a]])
    for entry in range(columns[n]):
        rows[entry] = step[rows[entry]]
    return permutation, columns, rows, fractions, pivots


@kernel
def _substitute(pointers: Any, rows: Any, fractions: Any, pivots: Any, x: Any) -> None:
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


@dataclass(frozen=True, slots=True, eq=False)
class GradientsResult:
    """An answer of `conjugate_gradients` with the evidence for it."""

    x: FloatArray
    """(n, k) the solution, of mean 0 in each column."""
    iterations: int
    """Products with the operator."""
    residual: float
    """Largest ||rhs - L x|| of a column, relative to ||rhs||."""
    converged: bool
    """Whether `residual` is at most the tolerance."""


def conjugate_gradients(
    operator: Operator,
    preconditioner: Preconditioner,
    rhs: FloatArray,
    *,
    tol: float = 1e-10,
    max_iterations: int = 500,
    coupled_nodes: int | None = None,
) -> GradientsResult:
    """Solve L x = rhs for a Laplacian L, or a regular matrix, by preconditioned conjugate gradients.

    Where rhs is out of L's reach by rounding, or L is singular beyond constants, steps in the end lead away:
    the iteration stops then, and the iterate of least residual is returned.

    Args:
        operator: maps (n, k) to L times it.
        preconditioner: an `ApproximateCholesky`, `JacobiPreconditioner` or `CholeskyFactor`.
        rhs: (n, k); its column means are ignored, for L has no such vectors in its range.
        tol: stop when each residual is at most this, relative to its right-hand side.
        max_iterations: hard limit, reported in `converged`.
        coupled_nodes: rows, the first, that are nodes, which constants move, of one system whose unknown is
            all of x, none if it is regular; None: the columns are k separate systems, and each row is a node.
    """
    coupled = coupled_nodes is not None
    count = len(rhs) if coupled_nodes is None else coupled_nodes
    r = _centered(rhs, count)
    x, p = np.zeros_like(r), np.zeros_like(r)
    scale = _norms(r, coupled)
    scale = np.where(scale > 0.0, scale, 1.0)
    rho_before = np.ones_like(scale)
    norms = _norms(r, coupled)
    k, best, least = 0, x, float(np.max(norms / scale, initial=0.0))
    largest = least
    while (norms > tol * scale).any() and k < max_iterations and largest <= _DIVERGED * least:
        z = _centered(preconditioner.solve(r), count)
        rho = _products(r, z, coupled)
        p = z + (rho / rho_before if k else 0.0) * p
        q = operator(p)
        curvature = _products(p, q, coupled)
        alpha = np.divide(rho, curvature, out=np.zeros_like(rho), where=curvature > 0.0)
        x = x + alpha * p
        r = r - alpha * q
        rho_before = np.where(rho > 0.0, rho, 1.0)
        k += 1
        norms = _norms(r, coupled)
        largest = float(np.max(norms / scale, initial=0.0))
        if largest < least:
            best, least = x, largest
    return GradientsResult(_centered(best, count), k, least, bool(least <= tol))


def diagonal_suffices(operator: LaplacianOperator, steps: int) -> bool:
    """Return whether so few steps with the diagonal solve a system, as they do on expanders alone."""
    probe = np.random.default_rng(1).normal(size=(operator.graph.num_nodes, 3))
    jacobi = JacobiPreconditioner(operator.diagonal())
    return conjugate_gradients(operator, jacobi, probe, tol=1e-2, max_iterations=steps).converged


def _centered(x: FloatArray, count: int) -> FloatArray:
    """Return x (n, k) with the mean of its first rows, if any, taken from these."""
    if count == 0:
        return x
    return np.concatenate([x[:count] - x[:count].mean(axis=0), x[count:]])


def _products(a: FloatArray, b: FloatArray, coupled: bool) -> FloatArray:
    """Return the inner products of the columns, (k,), or of the whole, (1,)."""
    products: FloatArray = np.einsum("ij,ij->j", a, b)
    return products.sum(keepdims=True) if coupled else products


def _norms(a: FloatArray, coupled: bool) -> FloatArray:
    """Return the norms of the columns, (k,), or of the whole, (1,)."""
    return np.asarray(np.sqrt(_products(a, a, coupled)))
