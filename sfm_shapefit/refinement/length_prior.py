"""The prior of lengths: how many observations of a common mean the log lengths of the pairs are.

Cameras that share matches are about as far apart as others that do. All m pairs together count as n
observations of that, one a camera, if cameras differ independently. Along a road they do not: a car that
slows down makes hundreds of steps shorter, and they say as much as one. A prior that counted each would pull
a whole road to one speed, against directions that know better. So the n observations are divided by the
design effect, the variance of a mean over that of as many independent observations (Kish 1965): lengths are
averaged over neighborhoods of growing size, each camera with its neighbors, again and again, and compared
with independent signs that are averaged in the same way. The size at which the ratio is largest counts;
at most the n observations do. The ratio is below .8 on orbits, domes, corridors, lawnmowers and crowds,
3 to 4 on streets with crossings, and 25 on a road of 1,000 cameras whose speed varies three times by 4.

Source: Kish, "Survey Sampling", 1965, section 8.2. The averages along a graph are our own.
"""

from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.operators import adjacency

_TAUS = (0.2, 2.0)  # standard deviation of log lengths, least and largest; others are of collapsed scenes
_SPREAD = 1.25  # standard deviations per mean absolute deviation; that of a normal variable
_SIZES = np.array([1, 2, 4, 8, 16, 32, 64])
"""Averages with the neighbors; 64 more say little more, and cost as much."""
_LEAST = 1e-24  # share of the first mean square; averages of a dense graph soon cancel to their rounding
_PROBES = 8  # vectors of signs; their mean square is known to a few percent then


class LengthPrior:
    """The precision of log lengths in a connected graph."""

    def __init__(self, graph: ViewGraph) -> None:
        """Measure how far averages cancel independent signs."""
        m, around = graph.num_edges, adjacency(graph.num_nodes, graph.edges)
        self._graph, self._around = graph, (around.pointers, around.neighbors, around.edge_of)
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (m, _PROBES))
        squares = np.mean(self._averages(signs - signs.mean(axis=0)), axis=1) * m / graph.num_nodes
        self._independent = np.maximum(squares, _LEAST * squares[0])

    def variance(self, logs: FloatArray) -> float:
        """Return that of one of m log lengths."""
        tau = np.clip(_SPREAD * np.mean(np.abs(logs - np.median(logs))), *_TAUS)
        return float(tau**2)

    def design_effect(self, logs: FloatArray) -> float:
        """Return how many observations count as one, at least 1, of log lengths (m,) less their mean."""
        averages = self._averages(logs[:, None])[:, 0]
        return float(max(1.0, (averages / self._independent).max() / self.variance(logs)))

    def precisions(self, logs: FloatArray) -> tuple[float, float]:
        """Return 1 / variance of log lengths (m,) less their mean, and that of independent cameras."""
        unit = self._graph.num_nodes / len(logs) / self.variance(logs)
        return unit / self.design_effect(logs), unit

    def _averages(self, of_pairs: FloatArray) -> FloatArray:
        """Return the mean square, over cameras, of averages of columns (m, k), (number of sizes, k)."""
        means = np.empty((2, self._graph.num_nodes, of_pairs.shape[1]))
        found = np.zeros((len(_SIZES), of_pairs.shape[1]))
        _average(self._around, of_pairs, _SIZES, means, found)
        return found / (2.0 * len(of_pairs))


@kernel
def _average(around: Any, of_pairs: Any, sizes: Any, means: Any, found: Any) -> None:
    """Add up the squares of averages over neighborhoods, each as often as its camera has pairs."""
    pointers, neighbors, edge_of = around
    size = 0
    for step in range(sizes[-1] + 1):
        now = step % 2
        before = 1 - now
        for i in range(len(pointers) - 1):
            degree = pointers[i + 1] - pointers[i]
            for k in range(means.shape[2]):
                total, mean = 0.0, 0.0
                if step > 0:
                    mean = means[before, i, k]
                for p in range(pointers[i], pointers[i + 1]):
                    if step == 0:
                        total += of_pairs[edge_of[p], k]
                    else:
                        total += mean - means[before, neighbors[p], k]
                mean = total / degree if step == 0 else mean - 0.5 * total / degree
                means[now, i, k] = mean
                if step == sizes[size]:
                    found[size, k] += degree * mean**2
        size += step == sizes[size]
