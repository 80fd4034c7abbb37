"""Bare graphs of directions whose truth is known: the paper's random model, and families of view graphs.

    random       Erdos-Renyi G(n, p), locations N(0, I_d): the model of the theorems
    expander     the same with a given mean degree, for sizes where all pairs cannot be drawn
    box          an area mapped from a drone: each camera joined to its nearest
    community    an internet collection: clusters with hubs, loosely joined

and long chains, where errors add up:

    trajectory   a video: each camera joined to the next ones, and a few loop closures; of varying speed too
    ring         once round, and five far links
    lawn         strips flown back and forth
    corridor     a corridor with five side branches, no loops

Each direction is the true one plus sigma times a random unit vector, normalized, or with probability q a
wrong one. What wrong directions are like is the corruption:

    uniform           each a uniformly random unit vector: the model of the theorems
    self-consistent   noisy directions of one second configuration of all cameras, as where facades repeat:
                      they contradict the truth, and never one another
    concentrated      uniform ones, on pairs of cameras with few pairs: the odds are in proportion to the
                      smaller degree's inverse, and q is the share over all pairs

With self-consistent corruption no method can succeed from q = 0.5 on: at that share, truth and the second
configuration explain the graph equally well.

Source of the random model: Hand, Lee, Voroninski (2015), arXiv 1506.01437, section 4.
"""

from dataclasses import dataclass
from typing import Literal, TypedDict, Unpack, get_args

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.graph.viewgraph import ViewGraph

Seed = int | np.random.Generator
CorruptionKind = Literal["uniform", "self-consistent", "concentrated"]


class Noise(TypedDict, total=False):
    """What is wrong with the directions, and the draws; all that is not given is 0, or uniform."""

    sigma: float
    """Size of the noise of the directions that are not corrupted."""
    q: float
    """Probability that a direction is a wrong one."""
    seed: Seed
    """An integer, or a Generator to draw from."""
    corruption: CorruptionKind
    """What wrong directions are like."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraphProblem:
    """Directions between unknown locations, with the answer."""

    locations: FloatArray
    """(n, d) the truth."""
    edges: IntArray
    """(m, 2) pairs (i, j), i < j, in lexicographic order."""
    directions: FloatArray
    """(m, d) measured unit directions of t_i - t_j."""
    corrupted: BoolArray
    """(m,) True where the direction is a wrong one."""
    false_locations: FloatArray | None = None
    """(n, d) the configuration that self-consistent wrong directions agree on; None for other corruption."""

    @property
    def view_graph(self) -> ViewGraph:
        """The graph to be solved, without the answer."""
        return ViewGraph(len(self.locations), self.edges, self.directions)


def random_graph_problem(n: int, p: float = 0.5, d: int = 3, **noise: Unpack[Noise]) -> GraphProblem:
    """Return the random model of the paper: locations N(0, I_d), an Erdos-Renyi graph G(n, p).

    Args:
        n: number of locations.
        p: probability of each pair.
        d: dimension, at least 2.
        noise: `sigma`, `q`, `seed` and `corruption`, see `Noise`; the other families take them as well.
    """
    rng = _rng(noise)
    locations = rng.standard_normal((n, d))
    pairs = np.stack(np.triu_indices(n, k=1), axis=1)
    return _measure(locations, pairs[rng.random(len(pairs)) < p], rng, noise)


def expander_graph_problem(n: int, degree: float = 20.0, **noise: Unpack[Noise]) -> GraphProblem:
    """Return locations N(0, I) and n degree / 2 pairs drawn uniformly; repeated draws are merged."""
    rng = _rng(noise)
    locations = rng.standard_normal((n, 3))
    drawn = rng.integers(n, size=(2, round(n * degree / 2.0)))
    return _measure(locations, _unique_pairs(drawn.T), rng, noise)


def box_graph_problem(n: int, degree: float = 20.0, **noise: Unpack[Noise]) -> GraphProblem:
    """Return cameras uniform in a flat box, 1 x 1 x 0.1, each joined to its nearest; mean degree `degree`.

    About degree / 1.25 neighbors are taken, for the union of the neighborhoods is larger than each of them.
    """
    rng = _rng(noise)
    locations = rng.random((n, 3)) * [1.0, 1.0, 0.1]
    neighbors = _nearest(locations, round(degree / 1.25))
    camera = np.repeat(np.arange(n), neighbors.shape[1])
    return _measure(locations, _unique_pairs(np.column_stack([camera, neighbors.ravel()])), rng, noise)


def trajectory_graph_problem(
    n: int, degree: float = 20.0, *, speed_ratio: float = 1.0, **noise: Unpack[Noise]
) -> GraphProblem:
    """Return a meandering trajectory: each camera joined to the next degree / 2, and 2 % of loop closures.

    A loop closure joins a random camera and one of its 60 nearest in space. The speed varies smoothly, three
    times up and down, by the factor `speed_ratio`: equal steps favor methods with a bound on each length.
    """
    rng = _rng(noise)
    heading = np.cumsum(0.15 * rng.standard_normal(n))
    steps = np.stack([np.cos(heading), np.sin(heading), 0.2 * rng.standard_normal(n)], axis=1)
    speeds = speed_ratio ** (0.5 * np.sin(6.0 * np.pi * np.arange(n) / n))
    steps *= speeds[:, None]
    locations = np.cumsum(steps, axis=0) + 0.3 * rng.standard_normal((n, 3))
    onward = _next_ones(n, degree)
    nearest = _nearest(locations, 60)
    closing = rng.integers(n, size=len(onward) // 50)
    closed = nearest[closing, rng.integers(nearest.shape[1], size=len(closing))]
    edges = _unique_pairs(np.concatenate([onward, np.column_stack([closing, closed])]))
    return _measure(locations, edges, rng, noise)


def ring_graph_problem(n: int, degree: float = 20.0, **noise: Unpack[Noise]) -> GraphProblem:
    """Return cameras round a circle, 1 apart, each joined to the next degree / 2, and 5 far links."""
    rng = _rng(noise)
    angle = 2.0 * np.pi * np.arange(n) / n
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1) * n / (2.0 * np.pi)
    locations = circle + 0.3 * rng.standard_normal((n, 3))
    reach = min(max(round(degree / 2.0), 1), n - 1)
    i = np.repeat(np.arange(n), reach)
    j = (i + np.tile(np.arange(1, reach + 1), n)) % n
    far = rng.integers(n, size=5)
    across = (far + rng.integers(n // 4, max(n - n // 4, n // 4 + 1), size=5)) % n
    edges = _unique_pairs(np.concatenate([np.column_stack([i, j]), np.column_stack([far, across])]))
    return _measure(locations, edges, rng, noise)


def lawn_graph_problem(n: int, degree: float = 20.0, **noise: Unpack[Noise]) -> GraphProblem:
    """Return strips of 50 cameras, 3 apart, each joined to the next degree / 4 along and across."""
    rng = _rng(noise)
    strip, place = np.divmod(np.arange(n), 50)
    locations = np.stack([place, 3.0 * strip, np.zeros(n)], axis=1) + 0.2 * rng.standard_normal((n, 3))
    reach = max(round(degree / 4.0), 1)
    pairs = []
    for shift in range(1, reach + 1):
        along = np.flatnonzero(place + shift < 50)
        pairs.append(np.stack([along, along + shift], axis=1))
    for shift in range(-(reach // 2), reach - reach // 2):
        across = np.flatnonzero((place + shift >= 0) & (place + shift < 50))
        pairs.append(np.stack([across, across + 50 + shift], axis=1))
    edges = np.concatenate(pairs)
    return _measure(locations, _unique_pairs(edges[edges[:, 1] < n]), rng, noise)


def corridor_graph_problem(n: int, degree: float = 20.0, **noise: Unpack[Noise]) -> GraphProblem:
    """Return a corridor of about n / 2 cameras with 5 side branches, each of which hangs on its junction.

    Cameras within degree / 2 steps of one another are joined. Nothing closes a loop.
    """
    rng = _rng(noise)
    length = n // 10
    main = n - 5 * length
    walks, pairs = [_walk(np.zeros(2), 0.0, main, rng)], [_next_ones(main, degree)]
    reach = max(round(degree / 2.0), 1)
    junctions = ((np.arange(5) + 0.5) * main / 5.0).astype(np.int64)
    for k, junction in enumerate(junctions.tolist()):
        walks.append(_walk(walks[0][junction], (-1.0) ** k * np.pi / 2.0, length, rng))
        first = main + k * length
        steps = np.add.outer(np.arange(1, length + 1), np.abs(np.arange(main) - junction))
        pairs += [first + _next_ones(length, degree), np.array([first, 0]) + np.argwhere(steps <= reach)]
    flat = np.concatenate(walks)
    locations = np.concatenate([flat, np.zeros((n, 1))], axis=1) + 0.3 * rng.standard_normal((n, 3))
    return _measure(locations, _unique_pairs(np.concatenate(pairs)), rng, noise)


def _walk(start: FloatArray, heading: float, n: int, rng: np.random.Generator) -> FloatArray:
    """Return (n, 2) a walk of unit steps away from a point, turning a little."""
    headings = heading + np.cumsum(0.03 * rng.standard_normal(n))
    walk: FloatArray = start + np.cumsum(np.stack([np.cos(headings), np.sin(headings)], axis=1), axis=0)
    return walk


def _next_ones(n: int, degree: float) -> IntArray:
    """Return the pairs (m, 2) of each of n cameras in a row with the next degree / 2."""
    reach = min(max(round(degree / 2.0), 1), n - 1)
    steps = [np.stack([np.arange(n - step), np.arange(step, n)], axis=1) for step in range(1, reach + 1)]
    return np.concatenate([np.zeros((0, 2), dtype=np.int64), *steps])


def community_graph_problem(n: int, degree: float = 30.0, **noise: Unpack[Noise]) -> GraphProblem:
    """Return clusters of about 400 cameras with a few hubs each, loosely joined: an internet collection.

    Locations are N(0, I) around centers N(0, diag(100, 100, 1)). 93 % of the edges join cameras of one
    cluster, 7 % those of a cluster and one of its 3 nearest; ends are drawn with power-law weights
    (1 - u)^(-1/2), at most 50. A backbone joins each camera with the next 4. Repeated draws are merged, so
    that the mean degree stays somewhat below `degree`.
    """
    rng = _rng(noise)
    num_clusters = max(round(n / 400), 1)
    cluster_centers = rng.standard_normal((num_clusters, 3)) * [10.0, 10.0, 1.0]
    cluster = np.sort(rng.integers(num_clusters, size=n))
    locations = cluster_centers[cluster] + rng.standard_normal((n, 3))

    num_drawn = round(n * degree / 2.0)
    cumulative = np.cumsum(np.minimum((1.0 - rng.random(n)) ** -0.5, 50.0))
    first = np.searchsorted(cluster, np.arange(num_clusters + 1))  # cameras of a cluster are consecutive
    bounds = np.concatenate([[0.0], cumulative])[first]

    i = np.searchsorted(cumulative, rng.random(num_drawn) * cumulative[-1], side="right")
    target = cluster[i]
    if num_clusters > 1:
        near = _nearest(cluster_centers, 3)
        leaves = rng.random(num_drawn) < 0.07
        target = np.where(leaves, near[target, rng.integers(near.shape[1], size=num_drawn)], target)
    drawn = bounds[target] + rng.random(num_drawn) * (bounds[target + 1] - bounds[target])
    j = np.searchsorted(cumulative, drawn, side="right")
    edges = _unique_pairs(np.concatenate([np.column_stack([i, j]), _next_ones(n, 8.0)]))
    return _measure(locations, edges, rng, noise)


def measured_problem(locations: FloatArray, edges: IntArray, **noise: Unpack[Noise]) -> GraphProblem:
    """Return directions between given locations (n, d) along given pairs (m, 2)."""
    return _measure(locations, edges, _rng(noise), noise)


def _rng(noise: Noise) -> np.random.Generator:
    return np.random.default_rng(noise.get("seed", 0))


def _measure(locations: FloatArray, edges: IntArray, rng: np.random.Generator, noise: Noise) -> GraphProblem:
    sigma, q, corruption = noise.get("sigma", 0.0), noise.get("q", 0.0), noise.get("corruption", "uniform")
    if corruption not in get_args(CorruptionKind):
        raise ValueError(
            f"corruption must be one of {', '.join(get_args(CorruptionKind))}, got {corruption!r}"
        )
    right = noisy_directions(locations, edges, sigma, rng)
    wrong = normalized(rng.standard_normal(right.shape))
    odds = np.full(len(edges), q) if corruption != "concentrated" else _odds_by_degree(edges, q)
    corrupted = rng.random(len(edges)) < odds
    false_locations = None
    if corruption == "self-consistent":  # drawn last: what is corrupted is the same for all models
        false_locations = locations[rng.permutation(len(locations))]
        wrong = noisy_directions(false_locations, edges, sigma, rng)
    return GraphProblem(
        locations=locations,
        edges=edges,
        directions=np.where(corrupted[:, None], wrong, right),
        corrupted=corrupted,
        false_locations=false_locations,
    )


def noisy_directions(
    locations: FloatArray, edges: IntArray, sigma: float | FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return the true directions (m, d) plus `sigma`, one or (m, 1), times unit vectors drawn at random."""
    true = normalized(locations[edges[:, 0]] - locations[edges[:, 1]])
    return normalized(true + sigma * normalized(rng.standard_normal(true.shape)))


def _odds_by_degree(edges: IntArray, q: float) -> FloatArray:
    """Return (m,) odds of corruption min(1, c / smaller degree), c such that their mean is q."""
    inverse = 1.0 / np.bincount(edges.ravel())[edges].min(axis=1)
    low, high = 0.0, 1.0 / float(inverse.min())
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.minimum(1.0, middle * inverse).mean() < q else (low, middle)
    odds: FloatArray = np.minimum(1.0, high * inverse)
    return odds


def _nearest(locations: FloatArray, k: int) -> IntArray:
    """Return (n, k) the k nearest other locations of each; all others where there are fewer."""
    from scipy.spatial import KDTree

    k = min(max(k, 1), len(locations) - 1)
    nearest = np.asarray(KDTree(locations).query(locations, k=k + 1)[1], dtype=np.int64)
    return nearest[:, 1:]  # the first is the location itself


def _unique_pairs(pairs: npt.NDArray[np.integer]) -> IntArray:
    """Return the unordered pairs (m, 2) of different cameras, each once, in lexicographic order."""
    ascending = np.sort(pairs.astype(np.int64), axis=1)
    return np.unique(ascending[ascending[:, 0] != ascending[:, 1]], axis=0)
