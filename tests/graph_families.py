"""Seeded test graphs: the families in which view graphs come, and uniform weights for them.

geo   cameras uniform in a flat box 1 x 1 x 0.1, each joined to its nearest neighbours
er    Erdos-Renyi of a given mean degree, locations N(0, I)
comm  an internet collection: clusters of about 400 cameras with power-law degrees, thin links between
seq   a video: a wandering trajectory, each camera joined to the next ones, 2 % loop closures
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

Graph = tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]


def unique_pairs(i: npt.NDArray[np.int64], j: npt.NDArray[np.int64], n: int) -> npt.NDArray[np.int64]:
    """Return the distinct unordered pairs (i < j) without self-loops, (m, 2), ascending."""
    low, high = np.minimum(i, j), np.maximum(i, j)
    key = np.unique(low[low < high] * n + high[low < high])
    return np.stack([key // n, key % n], axis=1)


def geo(n: int, degree: float, seed: int) -> Graph:
    """Return edges (m, 2) and locations (n, 3) of a geometric graph of about the given mean degree."""
    t = np.random.default_rng(seed).uniform(size=(n, 3)) * [1.0, 1.0, 0.1]
    k = round(degree / 1.25)
    neighbours = cKDTree(t).query(t, k + 1)[1][:, 1:]
    return unique_pairs(np.repeat(np.arange(n), k), neighbours.ravel().astype(np.int64), n), t


def er(n: int, degree: float, seed: int) -> Graph:
    """Return edges (m, 2) and locations (n, 3) of a random graph of the given mean degree."""
    rng = np.random.default_rng(seed)
    t = rng.normal(size=(n, 3))
    ends = rng.integers(n, size=(round(n * degree / 2), 2))
    return unique_pairs(ends[:, 0], ends[:, 1], n), t


def seq(n: int, degree: float, seed: int) -> Graph:
    """Return edges (m, 2) and locations (n, 3) of a video-like sequence with loop closures."""
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(scale=0.15, size=n))
    step = np.stack([np.cos(heading), np.sin(heading), 0.2 * rng.normal(size=n)], axis=1)
    t = np.cumsum(step, axis=0) + 0.3 * rng.normal(size=(n, 3))
    half = round(degree / 2)
    i = np.repeat(np.arange(n), half)
    j = i + np.tile(np.arange(1, half + 1), n)
    i, j = i[j < n], j[j < n]
    first = rng.integers(n, size=len(i) // 50)
    nearest = cKDTree(t).query(t[first], min(61, n))[1]
    second = nearest[np.arange(len(first)), rng.integers(1, nearest.shape[1], size=len(first))]
    return unique_pairs(np.concatenate([i, first]), np.concatenate([j, second]), n), t


def comm(n: int, degree: float, seed: int) -> Graph:
    """Return edges (m, 2) and locations (n, 3) of an internet-collection-like graph."""
    rng = np.random.default_rng(seed)
    clusters = max(1, round(n / 400))
    centre = rng.normal(size=(clusters, 3)) * [10.0, 10.0, 1.0]
    member = np.sort(rng.integers(clusters, size=n))
    t = centre[member] + rng.normal(size=(n, 3))
    popularity = np.minimum((1.0 - rng.uniform(size=n)) ** -0.5, 50.0)
    total = np.cumsum(popularity)
    bounds = np.searchsorted(member, np.arange(clusters + 1))
    base = np.concatenate([[0.0], total])[bounds]
    near = cKDTree(centre).query(centre, min(4, clusters))[1].reshape(clusters, -1)[:, 1:]

    def draw(cluster: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        u = base[cluster] + rng.uniform(size=len(cluster)) * (base[cluster + 1] - base[cluster])
        return np.minimum(np.searchsorted(total, u, side="right"), n - 1)

    num_edges = round(n * degree / 2)
    home = member[rng.integers(n, size=num_edges)]
    away = home.copy()
    if near.shape[1]:
        across = rng.uniform(size=num_edges) < 0.07
        choice = rng.integers(near.shape[1], size=num_edges)
        away = np.where(across, near[home, choice], home)
    i, j = draw(home), draw(away)
    k = np.arange(n)
    backbone = [(k[:-s], k[s:]) for s in range(1, 5)]
    ends_i = np.concatenate([i, *(a for a, _ in backbone)])
    ends_j = np.concatenate([j, *(b for _, b in backbone)])
    return unique_pairs(ends_i, ends_j, n), t


FAMILIES: dict[str, Callable[[int, float, int], Graph]] = {"geo": geo, "er": er, "comm": comm, "seq": seq}


def random_weights(num_edges: int, seed: int) -> npt.NDArray[np.float64]:
    """Return edge weights uniform in [0.5, 1.5]."""
    return np.random.default_rng(seed).uniform(0.5, 1.5, size=num_edges)


def random_blocks(num_edges: int, size: int, seed: int) -> npt.NDArray[np.float64]:
    """Return symmetric positive definite (m, size, size) edge blocks with eigenvalues in about [0.5, 5]."""
    a = np.random.default_rng(seed).normal(size=(num_edges, size, size)) / np.sqrt(size)
    return a @ np.swapaxes(a, 1, 2) + 0.5 * np.eye(size)
