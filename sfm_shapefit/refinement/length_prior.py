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

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.operators import LaplacianOperator, Workers, adjacency

_TAUS = (0.2, 2.0)  # standard deviation of log lengths, least and largest; others are of collapsed scenes
_SPREAD = 1.25  # standard deviations per mean absolute deviation; that of a normal variable
_SIZES = (1, 2, 4, 8, 16, 32, 64)  # averages with the neighbors; 64 more say little more, and cost as much
_PROBES = 8  # vectors of signs; their mean square is known to a few percent then


class LengthPrior:
    """The precision of log lengths in a connected graph."""

    def __init__(self, graph: ViewGraph) -> None:
        """Measure how far averages cancel independent signs."""
        m = graph.num_edges
        self._edges, self._degrees = graph.edges, graph.degrees().astype(np.float64)
        self._laplacian = LaplacianOperator(adjacency(graph.num_nodes, graph.edges), np.ones(m), Workers(1))
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (m, _PROBES))
        self._independent = np.mean(self._averages(signs), axis=1) * m / graph.num_nodes

    def variance(self, lengths: FloatArray) -> float:
        """Return that of the log of one of m lengths."""
        logs = np.log(lengths)
        tau = np.clip(_SPREAD * np.mean(np.abs(logs - np.median(logs))), *_TAUS)
        return float(tau**2)

    def design_effect(self, lengths: FloatArray) -> float:
        """Return how many observations count as one, at least 1."""
        averages = self._averages(np.log(lengths)[:, None])[:, 0]
        return float(max(1.0, (averages / self._independent).max() / self.variance(lengths)))

    def _averages(self, of_pairs: FloatArray) -> FloatArray:
        """Return the mean square, over cameras, of averages of columns (m, k), (number of sizes, k)."""
        ends, n, total = self._edges.ravel(), len(self._degrees), self._degrees.sum()
        centered = of_pairs - of_pairs.mean(axis=0)
        sums = [np.bincount(ends, np.repeat(column, 2), n) for column in centered.T]
        means, found = np.stack(sums, axis=1) / self._degrees[:, None], []
        for step in range(_SIZES[-1] + 1):
            if step in _SIZES:
                found.append(self._degrees @ means**2 / total)
            means = means - 0.5 * self._laplacian(means) / self._degrees[:, None]
        return np.asarray(found)
