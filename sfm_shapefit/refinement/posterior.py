"""The posterior of each pair from its triangles: how probable it is that a direction is right.

The model. A pair is right or wrong, one bit each, right with the probability `prior`. The direction of a
right pair is the true one plus a normal error of some noise level tau, in radians per axis; that of a wrong
pair is uniform on the sphere. A triangle of three right pairs closes up to its noise: its directions lie in
one plane, and positive multiples of them add up to zero. A triangle with a wrong side is a random one. Its
likelihood ratio, right against random, for signed unit sides a, b, c around it is

    rho(tau)  =  N(tau) (tau R)^(2 - d) exp(-z^2 / 2 tau^2 - gap^2 / 4 tau^2),

z = sqrt(det Gram(a, b, c)) / R, by how much they leave a plane, R^2 the sum of the squared sines of their
angles (the noise of all three sides, propagated), gap the angle by which they fail to close in the plane, and
d the dimension. For finite tau R^2 grows by 6 tau^2. N makes the mean of rho over random triangles 1. In
space or more, random triangles of a dimension d have a density of Gram matrices of det^((d - 4) / 2), so that
those of space, weighed by (z R)^(d - 3), stand for them: hardly any that is drawn in many dimensions closes.
Powers of d are taken in logarithms.

Noise level and share of right triangles are read off the histogram of all triangles: expectation maximization
for the shares of levels from .005 to .2. The fitted mixture is the likelihood ratio; there is nothing to
choose. Where the sides of most triangles are independent, the share of right pairs is the cube root of that.

Belief propagation. A triangle of ratio rho tells a side log(1 + p q (rho - 1)), where p and q are the
posteriors of its other sides without what this triangle told them (the cavity). Messages are damped, and the
noise anneals: in early rounds levels below a rung count as the rung's, so that a triangle which nearly closes
already speaks while nobody knows which pairs are right. The prior is fitted again on each rung.

Every sum is taken in one order by one thread: the same bits whatever the number of threads. A pair draws at
most 64 triangles, by a hash of their nodes, and is also told by those that its neighbors drew.

Sources: inference on loops: Zach, Klopschitz, Pollefeys, "Disambiguating visual relations using loop
constraints", CVPR 2010; Pearl, "Probabilistic reasoning in intelligent systems", 1988. The ratio is our own.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray, frozen
from sfm_shapefit.base.executors import in_ranges, in_threads
from sfm_shapefit.base.jit import inner_kernel, kernel, mix_bits
from sfm_shapefit.base.scipy_parts import expit, gammaln, logit, xlogy
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.operators import group_by

_LEVELS_RAD = (0.2, 0.13, 0.085, 0.055, 0.036, 0.024, 0.016, 0.011, 0.0075, 0.005)
"""Noise levels of directions, descending by a factor of about 1.5; below the last all is exact."""
_RUNGS_RAD = (0.5, 0.35, 0.25, *_LEVELS_RAD)
_SWEEPS = 3  # sweeps of messages on a rung; more change little before the next one
_LAST_SWEEPS = 24  # sweeps on the last rung; messages have to settle there
_DAMPING = 0.4  # share of a message that stays; undamped ones swing on dense graphs
_MOST_PER_PAIR = 64  # triangles that a pair draws; 16 cost .001 of the area under the curve
_MOST_TRIANGLES = 2_000_000  # triangles of a graph, about; 100 bytes each
_TRIANGLES_WORTH_THREADS = 20_000  # triangles; a sweep over fewer is done before a thread has begun
_FIT_TRIANGLES = 100_000  # triangles that the histogram is fitted to; more change no third digit
_FIT_ROUNDS = 60  # rounds of expectation maximization; shares of neighboring levels part slowly
_RANDOM_TRIANGLES = 50_000  # triangles that normalize the ratio; it is good to 10 % at the last level
_SPACE = 3  # dimensions; random triangles are drawn in no more, see the header
_LARGEST_LOG_RATIO = 300.0  # nats; no float holds the ratio of an exact triangle in many dimensions
_PRIORS = (0.05, 0.95)  # least and largest share of right pairs; at 0 and 1 messages would be ignored


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TriangleEvidence:
    """What triangles say of the pairs of a graph."""

    log_odds: FloatArray
    """(m,) sum of the messages to each pair, a log likelihood ratio, right against wrong; 0 without any."""
    prior: float
    """Share of right pairs, fitted."""
    num_triangles: int
    """How many triangles were drawn."""

    @property
    def posterior(self) -> FloatArray:
        """(m,) probability that each pair is right."""
        return np.asarray(expit(self.log_odds + logit(self.prior)))


class _Shapes(NamedTuple):
    """The shapes of triangles, all of length k."""

    off_plane: FloatArray
    """z R = sqrt(det Gram), which is 0 in a plane."""
    sines: FloatArray
    """R^2, sum of the squared sines."""
    gap: FloatArray
    """Angle by which they fail to close in their plane, radians."""


def weigh_by_triangles(graph: ViewGraph, threads: int = 1) -> TriangleEvidence:
    """Return what the triangles of a graph say of its pairs, which threads share."""
    sides, products = _draw_triangles(graph)
    m, d = graph.num_edges, graph.dimension
    if len(sides) == 0:
        return TriangleEvidence(log_odds=np.zeros(m), prior=0.5, num_triangles=0)
    shapes = _shapes(products, threads)
    norms = _normalizers(d, threads)
    shares = _fit_shares(shapes, d, norms, threads)
    messages, log_odds = np.zeros((len(sides), 3)), np.zeros(m)
    prior = float(np.clip(np.cbrt(shares.sum()), *_PRIORS))
    shares = shares / shares.sum()
    above, rest = np.zeros(len(sides)), 1.0
    for rung, tau in enumerate(_RUNGS_RAD):
        level = rung - (len(_RUNGS_RAD) - len(_LEVELS_RAD))
        ratio = _ratio(shapes, tau, d, threads) * norms[rung]
        last = rung == len(_RUNGS_RAD) - 1
        for _ in range(_LAST_SWEEPS // _SWEEPS if last else 1):
            weights = above + rest * ratio
            for _ in range(_SWEEPS):
                _sweep(sides, weights, float(logit(prior)), messages, log_odds, threads)
            found = float(np.mean(expit(log_odds + logit(prior))))
            prior = float(np.clip(0.5 * (prior + found), *_PRIORS))
        if level >= 0:
            above += shares[level] * ratio
            rest = max(rest - float(shares[level]), 0.0)
    return TriangleEvidence(log_odds=log_odds, prior=prior, num_triangles=len(sides))


def _draw_triangles(graph: ViewGraph) -> tuple[IntArray, FloatArray]:
    """Return the edges of triangles (k, 3), and the dot products of their signed sides: ab, bc, ca."""
    ends, v = frozen(graph.edges.ravel()), graph.directions
    _, ascending = group_by(ends, graph.num_nodes)
    pointers, order = group_by(frozen(ends[ascending ^ 1]), graph.num_nodes)
    entries = ascending[order]
    around = (pointers, ends[entries], entries // 2, graph.edges)
    counts, no_sides, no_products = np.zeros(graph.num_edges), np.empty((0, 3), np.int64), np.empty((0, 3))
    everything = np.ones(graph.num_edges)
    _visit_triangles(around, v, everything, counts, no_sides, no_products)
    most = min(_MOST_PER_PAIR, _MOST_TRIANGLES // graph.num_edges + 1)
    odds = np.minimum(1.0, most / np.maximum(counts, 1.0))
    total = _visit_triangles(around, v, odds, counts, no_sides, no_products)
    sides, products = np.empty((total, 3), np.int64), np.empty((total, 3))
    _visit_triangles(around, v, odds, counts, sides, products)
    return sides, products


def _shapes(products: FloatArray, threads: int) -> _Shapes:
    """Return the shapes of triangles of given dot products (k, 3) of their unit sides."""
    found = _Shapes(*np.empty((3, len(products))))

    def fill(begin: int, end: int) -> None:
        ab, bc, ca = columns = products[begin:end].T
        squares = columns**2
        angles = np.arctan2(np.sqrt(np.maximum(1.0 - squares, 0.0)), columns)
        total, widest = angles.sum(axis=0), angles.max(axis=0)
        closes = 2.0 * np.pi - total <= total - 2.0 * widest
        off_plane2 = 1.0 + 2.0 * ab * bc * ca - squares.sum(axis=0)
        found.off_plane[begin:end] = np.sqrt(np.maximum(off_plane2, 0.0))
        found.sines[begin:end] = np.sum(1.0 - squares, axis=0)
        found.gap[begin:end] = np.where(closes, 0.0, np.pi - widest)

    in_ranges(threads, len(products), fill)
    return found


def _ratio(shapes: _Shapes, tau: float, dimension: int, threads: int = 1) -> FloatArray:
    """Return rho(tau) of triangles, (k,), but for its normalizer."""
    log_weight, ratio = _log_mean_power(max(dimension - _SPACE, 0)), np.empty(len(shapes.gap))

    def fill(begin: int, end: int) -> None:
        some = _Shapes(*(column[begin:end] for column in shapes))
        ratio[begin:end] = _weighed_ratio(some, tau, dimension, log_weight)

    in_ranges(threads if len(ratio) > _TRIANGLES_WORTH_THREADS else 1, len(ratio), fill)
    return ratio


def _weighed_ratio(
    shapes: _Shapes, tau: float, dimension: int, log_weights: FloatArray | float
) -> FloatArray:
    """Return rho(tau) of triangles times weights, (k,), but for a factor that is one for all triangles."""
    more = max(dimension - _SPACE, 0)
    spread = shapes.sines + 6.0 * tau**2
    exponent = shapes.off_plane**2 / (2.0 * tau**2 * spread) + shapes.gap**2 / (4.0 * tau**2)
    # The largest value of off_plane^more exp(-exponent), so that a mean of these is a number.
    peak = 0.5 * (xlogy(more, more) - more + xlogy(more, tau**2 * spread))
    logs = np.minimum(log_weights - exponent - peak, _LARGEST_LOG_RATIO)
    return np.asarray(spread ** (0.5 * (2 - min(dimension, _SPACE))) * np.exp(logs))


def _log_mean_power(more: int) -> float:
    """Return the logarithm of the mean of (z R)^more over random triangles of space, a product of sines."""
    sines = [gammaln(0.5 * (p + 1)) - gammaln(0.5 * p + 1.0) for p in (more + 1, 1, more, 0)]
    return float(2.0 * (sines[0] - sines[1]) + sines[2] - sines[3])


def _normalizers(dimension: int, threads: int) -> FloatArray:
    """Return what makes the mean of rho over random triangles 1, for each rung."""
    drawn = min(dimension, _SPACE)
    sides = np.random.default_rng(0).standard_normal((3, _RANDOM_TRIANGLES, drawn))
    a, b, c = sides / np.linalg.norm(sides, axis=2, keepdims=True)
    shapes = _shapes(np.stack([np.sum(x * y, axis=1) for x, y in ((a, b), (b, c), (c, a))], axis=1), threads)
    weights = xlogy(dimension - drawn, shapes.off_plane)

    def mean(tau: float) -> float:
        return float(np.mean(_weighed_ratio(shapes, tau, dimension, weights)))

    return 1.0 / np.array(list(in_threads(threads, mean, _RUNGS_RAD)))


def _fit_shares(shapes: _Shapes, dimension: int, norms: FloatArray, threads: int) -> FloatArray:
    """Return the share of all triangles that is right and of each noise level."""
    step = max(len(shapes.gap) // _FIT_TRIANGLES, 1)
    some = _Shapes(*(column[::step] for column in shapes))
    first = len(_RUNGS_RAD) - len(_LEVELS_RAD)
    ratios = np.stack(
        [_ratio(some, tau, dimension, threads) * norms[first + k] for k, tau in enumerate(_LEVELS_RAD)]
    )
    shares = np.full(len(ratios), 0.02)
    for _ in range(_FIT_ROUNDS):
        density = shares @ ratios + 1.0 - shares.sum()
        shares = shares * (ratios @ (1.0 / density)) / len(density)
    return np.asarray(shares)


@inner_kernel
def _direction(edges: Any, v: Any, e: int, start: int, out: Any) -> None:
    """Write the direction of edge e as it leaves the node `start`."""
    sign = 1.0 if edges[e, 0] == start else -1.0
    for a in range(v.shape[1]):
        out[a] = sign * v[e, a]


@kernel
def _visit_triangles(around: Any, v: Any, odds: Any, counts: Any, sides: Any, products: Any) -> int:
    """Return how many triangles are drawn; write sides and dot products where there is room for them.

    A triangle is drawn if the hash of its nodes, in [0, 1), is below the `odds` of one of its pairs. With no
    room, `counts` gets the number of each pair's.
    """
    pointers, neighbors, edge_of, edges = around
    found, d = 0, v.shape[1]
    a, b, c = np.empty(d), np.empty(d), np.empty(d)
    for i in range(len(pointers) - 1):
        for to_j in range(pointers[i], pointers[i + 1]):
            j = neighbors[to_j]
            if j < i:
                continue
            ij, x, y = edge_of[to_j], to_j + 1, pointers[j]
            while x < pointers[i + 1] and y < pointers[j + 1]:
                if neighbors[x] < neighbors[y]:
                    x += 1
                    continue
                if neighbors[x] > neighbors[y]:
                    y += 1
                    continue
                k, ki, jk = neighbors[x], edge_of[x], edge_of[y]
                x, y = x + 1, y + 1
                key = mix_bits(mix_bits(mix_bits(np.uint64(i)) + np.uint64(j)) + np.uint64(k))
                drawn = np.float64(key >> np.uint64(11)) / 9007199254740992.0
                if drawn >= max(odds[ij], odds[jk], odds[ki]):
                    continue
                if len(sides) == 0:
                    for e in (ij, jk, ki):
                        counts[e] += 1.0
                else:
                    sides[found, 0], sides[found, 1], sides[found, 2] = ij, jk, ki
                    _direction(edges, v, ij, i, a)
                    _direction(edges, v, jk, j, b)
                    _direction(edges, v, ki, k, c)
                    for q in range(3):
                        products[found, q] = 0.0
                    for q in range(d):
                        products[found, 0] += a[q] * b[q]
                        products[found, 1] += b[q] * c[q]
                        products[found, 2] += c[q] * a[q]
                found += 1
    return found


@inner_kernel
def _probability(log_odds: float) -> float:
    """Return the probability of given log odds, never 0 nor 1."""
    return 1.0 / (1.0 + math.exp(-min(max(log_odds, -30.0), 30.0)))


def _sweep(
    sides: IntArray, ratio: FloatArray, prior: float, messages: FloatArray, log_odds: FloatArray, threads: int
) -> None:
    """Send the messages (k, 3) of all triangles again, and write what they say together, (m,).

    `prior` is in log odds. All messages answer those of the sweep before, of which `log_odds` is the sum.
    """
    threads = threads if len(sides) > _TRIANGLES_WORTH_THREADS else 1
    in_ranges(threads, len(sides), _answer, sides, (ratio, prior), messages, log_odds)
    _add_up(sides, messages, log_odds)


@kernel
def _add_up(sides: Any, messages: Any, log_odds: Any) -> None:
    """Write the sum of the messages to each pair."""
    log_odds[:] = 0.0
    for t in range(len(sides)):
        for q in range(3):
            log_odds[sides[t, q]] += messages[t, q]


@kernel
def _answer(begin: int, end: int, sides: Any, odds: Any, messages: Any, log_odds: Any) -> None:
    """Write the messages of the triangles begin..end-1, by their own odds (k,) and those of all pairs."""
    ratio, prior = odds
    for t in range(begin, end):
        a = _probability(prior + log_odds[sides[t, 0]] - messages[t, 0])
        b = _probability(prior + log_odds[sides[t, 1]] - messages[t, 1])
        c = _probability(prior + log_odds[sides[t, 2]] - messages[t, 2])
        excess = ratio[t] - 1.0
        for q, others in ((0, b * c), (1, c * a), (2, a * b)):
            message = np.log1p(others * excess)
            messages[t, q] = _DAMPING * messages[t, q] + (1.0 - _DAMPING) * message
