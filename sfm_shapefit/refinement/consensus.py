"""Cameras put where most of their lines meet: resection by consensus, and the likelihood that it maximizes.

With the others held, each pair of a node is a ray on which the node lies, if the pair is right. Any two rays
propose the middle of their closest approach. The node moves to the proposal, or stays, where

    sum_e log(1 + odds l_e(A_e))  -  3 log(1 + (r / 3 R)^2)

is largest: l_e is the density of the measured direction, normal of standard deviation s_e about the baseline,
over that of a wrong one, uniform on the sphere; A_e the angle between both; r the distance from the median of
all nodes, R the median of r. The last term is a heavy-tailed prior: where wrong rays are nearly parallel they
meet far out, 26 radii on a real scene. A sum of norms or a refinement moves a node along its gradient only;
a consensus finds the place that half a dozen right rays of sixty agree on, wherever the node is.

The evidence for locations is the log likelihood of all directions under such a mixture, less that prior, and
less log(1 / s) for each unknown, which is known to s of the radius: random directions can be fitted exactly
too, as many as there are unknowns, and that must be worth nothing.

Share of right pairs and s are those of a mixture fitted to all residuals by expectation maximization:
s_e^2 = s^2 + the direction's own variance.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.executors import in_slices
from sfm_shapefit.base.jit import inner_kernel, kernel, mix_bits
from sfm_shapefit.base.scipy_parts import expit, gammaln, logit
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.operators import adjacency
from sfm_shapefit.solver.program import SLICE, measure_baselines

_EM_ROUNDS = 60  # rounds of the mixture; share and width settle in fewer
_SHARES = (0.02, 0.999)  # least and largest share of right pairs; at 0 and 1 nothing is learned any more
_LEAST_LEVEL_RAD = 1e-4  # radians; rays of exact directions still meet within their rounding
# Meetings of two rays that are tried for a node; drawn by a fixed seed where it has more.
_MOST_PROPOSALS = 1500
_STRIDE = 1_000_003  # a prime above that; its multiples visit each pair of rays once, and neighbors far apart
_MISSED = 1e-4  # odds of missing a better place; more proposals are not tried (Fischler and Bolles 1981)
_REACH = 3.0  # radii; beyond, a place must be paid for
_SWEEPS = 3  # visits of all nodes, at most; the next placement does the rest
_PRIOR_POWER = 3.0  # power of the heavy tail; the density of places falls as r^-6
_MOVE_COST = 1.0  # nats that a move must gain; a smaller gain is that of chance
_LEAST_LOG_ODDS = -5.0  # log odds; a pair of less says nothing for a place
_PARALLEL = 1e-3  # squared sine of two rays; less parallel ones meet where noise says
_SHORT = 1e-12  # length of a baseline; a shorter one has no direction
# Least and largest variance, rad^2: exact directions still have a finite density, and of more than 0.3 rad
# right ones are no longer told from wrong ones.
_LEVELS2 = (1e-12, 0.3**2)
_SETTLED = 1e-4  # relative change of shares and levels; a smaller one ends the fit
_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResidualMixture:
    """Which residuals are those of right pairs, and how likely all are."""

    shares: FloatArray
    """(number of classes,) share of right pairs of each class."""
    log_odds: FloatArray
    """(m,) log odds that a pair of its class is right, whatever its residual."""
    variances: FloatArray
    """(m,) s_e^2, rad^2."""
    log_ratio: FloatArray
    """(m,) log density of each direction if it is right, over that of a wrong one."""
    evidence: float
    """Log likelihood of all directions, over that of all being wrong, less what the locations cost."""

    @property
    def posterior(self) -> FloatArray:
        """(m,) probability that each pair is right."""
        return np.asarray(expit(self.log_ratio + self.log_odds))


def residual_angles(graph: ViewGraph, locations: FloatArray) -> FloatArray:
    """Return the angle between each direction and its baseline, (m,) radians; 60 deg where there is none."""
    baselines, lengths = measure_baselines(locations, graph.edges)
    chords = np.linalg.norm(baselines / np.maximum(lengths, _SHORT)[:, None] - graph.directions, axis=1)
    return np.asarray(2.0 * np.arcsin(np.minimum(0.5 * chords, 1.0)))


def fit_mixture(measured: MeasuredGraph, locations: FloatArray, threads: int = 1) -> ResidualMixture:
    """Fit share and level of the right pairs of each class to the residuals at locations (n, d)."""
    graph, classes, own = measured.graph, measured.classes, own_variances(measured)
    angles, d, count = residual_angles(graph, locations), graph.dimension, int(classes.max()) + 1
    peak, given = log_ratio(0.0, 1.0, d), (classes, angles, own)
    numbers = np.maximum(np.bincount(classes, minlength=count), 1)
    shares = np.full(count, 0.5)
    levels2 = np.array([np.median(angles[classes == k]) ** 2 if k in classes else 1.0 for k in range(count)])
    for _ in range(_EM_ROUNDS):
        before, levels2 = (shares, levels2), np.clip(levels2, *_LEVELS2)
        sums = np.zeros((len(angles) // SLICE + 1, 3, count))
        in_slices(threads, len(angles), SLICE, _add_right, given, (levels2, peak + logit(shares)), d, sums)
        right, wanted, inverse = sums.sum(axis=0)
        shares = np.clip(right / numbers, *_SHARES)
        # Stationary where sum right (A^2 / (d - 1) - total) / total^2 = 0; without variances their mean.
        levels2 = levels2 * wanted / (d - 1) / np.maximum(inverse, _TINY)
        if np.allclose(before, (shares, levels2), rtol=_SETTLED, atol=0.0):
            break
    total, odds = np.clip(levels2, *_LEVELS2)[classes] + own, logit(shares)[classes]
    ratio = log_ratio(angles, total, d)
    likelihood = np.sum(np.logaddexp(odds + ratio, 0.0) + np.log1p(-shares)[classes])
    unknowns, level2 = d * (graph.num_nodes - 1) - 1, max(float(levels2[0]), _LEVELS2[0])
    cost = penalty_of_strays(locations) - 0.5 * unknowns * min(float(np.log(level2)), 0.0)
    return ResidualMixture(
        shares=shares,
        log_odds=odds,
        variances=total,
        log_ratio=ratio,
        evidence=float(likelihood) - cost,
    )


@kernel
def _add_right(begin: int, end: int, given: Any, model: Any, dimension: int, sums: Any) -> None:
    """Add up a slice's posteriors of being right, times 1, A^2 / s^4 and 1 / s^2, (3, number of classes)."""
    (classes, angles, own), (levels2, odds) = given, model
    there = sums[begin // SLICE]
    for e in range(begin, end):
        k = classes[e]
        total = levels2[k] + own[e]
        log_odds = odds[k] - 0.5 * (angles[e] ** 2 / total + (dimension - 1) * np.log(total))
        right = 1.0 / (1.0 + np.exp(-log_odds))
        there[0, k] += right
        there[1, k] += right * (angles[e] / total) ** 2
        there[2, k] += right / total


def own_variances(measured: MeasuredGraph) -> FloatArray:
    """Return the variance per axis that each direction states itself, (m,); 0 where it states none."""
    if measured.covariance is None:
        return np.zeros(measured.graph.num_edges)
    variances = np.trace(measured.covariance, axis1=1, axis2=2) / (measured.graph.dimension - 1)
    return np.asarray(np.where(np.isfinite(variances), np.maximum(variances, 0.0), 0.0))


def log_ratio(angles: FloatArray | float, variances: FloatArray | float, dimension: int) -> FloatArray:
    """Return the log density of directions off by `angles`, over the uniform one of the sphere, (m,)."""
    sphere = np.log(2.0) + 0.5 * dimension * np.log(np.pi) - gammaln(0.5 * dimension)
    peak = sphere - 0.5 * (dimension - 1) * np.log(2.0 * np.pi * np.asarray(variances))
    return np.asarray(peak - 0.5 * angles**2 / variances)


def _middle_and_radius(locations: FloatArray) -> tuple[FloatArray, float]:
    """Return the median of locations (n, d), and the median distance from it."""
    middle = np.median(locations, axis=0)
    return middle, max(float(np.median(np.linalg.norm(locations - middle, axis=1))), _SHORT)


def penalty_of_strays(locations: FloatArray) -> float:
    """Return minus the log prior of locations (n, d), 0 if all are at their median."""
    middle, radius = _middle_and_radius(locations)
    squares = np.sum((locations - middle) ** 2, axis=1)
    return float(_PRIOR_POWER * np.sum(np.log1p(squares / (_REACH * radius) ** 2)))


def put_by_consensus(
    graph: ViewGraph,
    locations: FloatArray,
    log_odds: FloatArray,
    variances: FloatArray,
    sweeps: int = _SWEEPS,
) -> FloatArray:
    """Return locations (n, d) with each node where most of its rays meet; worst nodes first.

    Pairs are right with `log_odds` (m,), their directions have the variances s_e^2 (m,). Nodes are visited in
    so many sweeps at most.
    """
    variances = np.maximum(variances, _LEAST_LEVEL_RAD**2)
    fit = np.repeat(np.exp(-0.5 * residual_angles(graph, locations) ** 2 / variances), 2)
    order = np.argsort(np.bincount(graph.edges.ravel(), fit, graph.num_nodes), kind="stable")
    peak = log_odds + log_ratio(np.zeros_like(variances), variances, graph.dimension)
    middle, radius = _middle_and_radius(locations)
    around, moved = adjacency(graph.num_nodes, graph.edges), locations.copy()
    structure = (around.pointers, around.neighbors, around.edge_of)
    rays = (structure, graph.edges, graph.directions, peak, variances)
    has_moved = np.ones(graph.num_nodes, dtype=np.bool_)
    for _ in range(sweeps):
        _resect(rays, order, moved, has_moved, middle, _REACH * radius)
    return moved


@inner_kernel
def _propose(proposal: int, seed: int, starts: Any, rays: Any, place: Any) -> bool:
    """Write where two of a node's rays meet: each pair of rays once if they are few, else by a hash."""
    degree = len(starts)
    count = degree * (degree - 1) // 2
    if count <= _MOST_PROPOSALS:
        pair = proposal * _STRIDE % count
        x = np.int64((1.0 + np.sqrt(1.0 + 8.0 * pair)) / 2.0)
        y = pair - x * (x - 1) // 2
    else:
        key = mix_bits(mix_bits(np.uint64(seed)) + np.uint64(proposal))
        x = np.int64(key % np.uint64(degree))
        y = np.int64((key >> np.uint64(32)) % np.uint64(degree))
    return _meet(starts[x], rays[x], starts[y], rays[y], place)


@inner_kernel
def _meet(p: Any, u: Any, q: Any, w: Any, out: Any) -> bool:
    """Write the middle of the closest approach of the rays p + a u and q + b w; False if they do not meet."""
    cosine, along_u, along_w = 0.0, 0.0, 0.0
    for a in range(len(p)):
        cosine += u[a] * w[a]
        along_u += (q[a] - p[a]) * u[a]
        along_w += (q[a] - p[a]) * w[a]
    sine2 = 1.0 - cosine * cosine
    if sine2 < _PARALLEL:
        return False
    reach_u, reach_w = (along_u - cosine * along_w) / sine2, (cosine * along_u - along_w) / sine2
    for a in range(len(p)):
        out[a] = 0.5 * (p[a] + reach_u * u[a] + q[a] + reach_w * w[a])
    return bool(reach_u > 0.0 and reach_w > 0.0)


@inner_kernel
def _penalty(place: Any, middle: Any, reach: float) -> float:
    """Return minus the log prior of a place."""
    square = 0.0
    for a in range(len(place)):
        square += (place[a] - middle[a]) ** 2
    return float(_PRIOR_POWER * np.log1p(square / (reach * reach)))


@inner_kernel
def _enough(share: float) -> int:
    """Return how many random pairs of rays hardly miss a place that this share of all rays speaks for."""
    if share <= 0.0:
        return _MOST_PROPOSALS
    return int(np.ceil(np.log(_MISSED) / np.log1p(-min(share * share, 0.99))))


@inner_kernel
def _gain(log_odds: float) -> float:
    """Return log(1 + e^x), by which a pair of log odds x speaks for a place."""
    return float(np.log1p(np.exp(min(log_odds, 30.0))))


@inner_kernel
def _score(place: Any, rays: Any, least: float) -> float:
    """Return sum_e log(1 + odds l_e) at a place, or less than `least` if it is less.

    Pairs of less than e^-5 are wrong there.

    `rays`: starts, directions, log odds at the peak, variances, and the most that all from each on may add.
    """
    starts, directions, peak, variances, most = rays
    total, d = 0.0, len(place)
    for k in range(len(peak)):
        if total + most[k] < least:
            break
        length2, dot = 0.0, 0.0
        for a in range(d):
            along = place[a] - starts[k, a]
            length2 += along * along
            dot += along * directions[k, a]
        cosine = 1.0 - (peak[k] - _LEAST_LOG_ODDS) * variances[k]
        if cosine > 0.0 and (dot < 0.0 or dot * dot < cosine * cosine * length2):
            continue
        # The squared chord 2 - 2 cos; its rounding is far below the least level.
        log_odds = peak[k] - (1.0 - dot / np.sqrt(max(length2, 1e-300))) / variances[k]
        if log_odds > _LEAST_LOG_ODDS:
            total += _gain(log_odds)
    return total


@kernel
def _resect(graph: Any, order: Any, t: Any, has_moved: Any, middle: Any, reach: float) -> None:
    """Move each node of `order` to the best meeting of two of its rays, the others held.

    Nodes none of whose neighbors has moved since are where their rays meet already.
    """
    (pointers, neighbors, edge_of), edges, v, all_peaks, all_variances = graph
    d = t.shape[1]
    place, best_place = np.empty(d), np.empty(d)
    for node in order:
        first, degree = pointers[node], pointers[node + 1] - pointers[node]
        is_due = False
        for k in range(first, first + degree):
            is_due = is_due or has_moved[neighbors[k]]
        has_moved[node] = False
        if not is_due:
            continue
        starts, rays = np.empty((degree, d)), np.empty((degree, d))
        peak, variances, most = np.empty(degree), np.empty(degree), np.zeros(degree + 1)
        for k in range(degree - 1, -1, -1):
            e = edge_of[first + k]
            peak[k], variances[k] = all_peaks[e], all_variances[e]
            most[k] = most[k + 1] + _gain(peak[k])
            for a in range(d):
                starts[k, a] = t[neighbors[first + k], a]
                rays[k, a] = v[e, a] if edges[e, 0] == node else -v[e, a]
        best, proposal = -np.inf, -2
        enough = min(degree * (degree - 1) // 2, _MOST_PROPOSALS)
        while proposal + 1 < enough:
            proposal += 1
            if proposal < 0:
                for a in range(d):
                    place[a] = t[node, a]
            elif not _propose(proposal, node, starts, rays, place):
                continue
            price = _penalty(place, middle, reach) - (_MOVE_COST if proposal < 0 else 0.0)
            score = _score(place, (starts, rays, peak, variances, most), best + price) - price
            if score > best:
                best = score
                enough = min(enough, _enough(best / most[0]))
                for a in range(d):
                    best_place[a] = place[a]
        for a in range(d):
            has_moved[node] = has_moved[node] or t[node, a] != best_place[a]
            t[node, a] = best_place[a]
