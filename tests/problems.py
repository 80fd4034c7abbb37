"""View graphs for tests: which pairs, directions of known locations, and how far an answer is off."""

from collections.abc import Iterable
from itertools import combinations

import numpy as np
import numpy.typing as npt

from sfm_shapefit.geometry import normalized
from sfm_shapefit.solver.program import differences
from sfm_shapefit.viewgraph import ViewGraph

Floats = npt.NDArray[np.float64]


def all_pairs(nodes: int | Iterable[int]) -> list[tuple[int, int]]:
    """Return all pairs (i, j), i before j, of the given nodes, or of the nodes 0 .. nodes - 1."""
    return list(combinations(range(nodes) if isinstance(nodes, int) else nodes, 2))


def exact_graph(locations: Floats, edges: npt.ArrayLike | None = None) -> ViewGraph:
    """Return the graph of the true directions between locations (n, d), along all pairs if none are given."""
    edges = np.array(all_pairs(len(locations)) if edges is None else edges)
    return ViewGraph(len(locations), edges, normalized(differences(locations, edges)))


def draw_graph(
    seed: int, *, n: int = 16, d: int = 3, p: float = 0.8, q: float = 0.2, sigma: float = 0.0, weighted=False
) -> tuple[ViewGraph, Floats]:
    """Return a random rigid graph with noisy and corrupted directions, and the true locations (n, d)."""
    rng = np.random.default_rng(seed)
    truth = rng.normal(size=(n, d))
    i, j = np.triu_indices(n, 1)
    kept = (rng.random(len(i)) < p) | (j <= i + 2)  # consecutive cameras keep the graph rigid
    edges = np.stack([i[kept], j[kept]], axis=1)
    v = _measure(differences(truth, edges), sigma, q, rng)
    weights = rng.uniform(0.2, 3.0, len(edges)) if weighted else None
    return ViewGraph(n, edges, v, weights), truth


def measure_graph(
    edges: npt.NDArray[np.int64], truth: Floats, *, sigma: float, q: float, seed: int
) -> ViewGraph:
    """Return noisy and corrupted directions between locations (n, 3), with uneven weights."""
    rng = np.random.default_rng(seed)
    v = _measure(differences(truth, edges), sigma, q, rng)
    return ViewGraph(len(truth), edges, v, rng.uniform(0.5, 2.0, len(edges)))


def _measure(baselines: Floats, sigma: float, q: float, rng: np.random.Generator) -> Floats:
    """Return directions of baselines, each off by sigma or, with probability q, a random one."""
    v = normalized(normalized(baselines) + sigma * normalized(rng.normal(size=baselines.shape)))
    corrupted = rng.random(len(v)) < q
    v[corrupted] = normalized(rng.normal(size=v.shape))[corrupted]
    return v


def shape(locations: Floats) -> Floats:
    """Return locations (n, d) moved and scaled to centroid 0 and norm 1."""
    centred = locations - locations.mean(axis=0)
    return np.asarray(centred / np.linalg.norm(centred))


def shape_error(locations: Floats, truth: Floats) -> float:
    """Return the distance of two shapes: the relative error of Hand et al. (2015), section 4."""
    return float(np.linalg.norm(shape(locations) - shape(truth)))
