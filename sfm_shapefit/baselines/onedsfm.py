"""1DSfM: pairs that contradict the order of the cameras along many random axes are wrong.

Projected to an axis, a direction says which of its two cameras comes first, the surer the longer its
projection. An order that most pairs agree with is a minimum feedback arc set of this weighted, directed
graph, here by the greedy rule of the paper: take next the camera with the most going out for what still
comes in. A pair collects the length of its projection on each axis where the order contradicts it; the mean
over axes is its score.

Source: Wilson and Snavely, "Robust global translations with 1DSfM", ECCV 2014, section 4.
"""

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sfm_shapefit.base.geometry import normalized
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.operators import adjacency

_AXES = 48
# This is the paper's threshold.
_THRESHOLD = 0.1
# Axes are drawn near the directions themselves, since others separate no cameras.
_JITTER = 0.3


def filter_1dsfm(
    graph: ViewGraph, num_axes: int = _AXES, threshold: float = _THRESHOLD, seed: int = 0
) -> BoolArray:
    """Return the (m,) pairs whose score stays below the threshold.

    Args:
        graph: any view graph.
        num_axes: random axes.
        threshold: largest mean length, per axis, of the projections that contradict the order.
        seed: of the axes.
    """
    return np.asarray(onedsfm_scores(graph, num_axes, seed) < threshold)


def onedsfm_scores(graph: ViewGraph, num_axes: int = _AXES, seed: int = 0) -> FloatArray:
    """Return each pair's mean projected length on the axes that contradict it, (m,)."""
    rng = np.random.default_rng(seed)
    chosen = graph.directions[rng.integers(graph.num_edges, size=num_axes)]
    axes = normalized(chosen + _JITTER * rng.standard_normal(chosen.shape))
    scores = np.zeros(graph.num_edges)
    arcs = adjacency(graph.num_nodes, graph.edges)
    node = np.repeat(np.arange(graph.num_nodes), np.diff(arcs.pointers))
    # The weight of an arc is positive where it leaves the node, that is, where the node comes first.
    sign = np.where(graph.edges[arcs.edge_of, 0] == node, -1.0, 1.0)
    for axis in axes:
        ahead = graph.directions @ axis  # positive: camera i comes after camera j
        place = _greedy_order(arcs.pointers, arcs.neighbors, sign * ahead[arcs.edge_of])
        before = place[graph.edges[:, 0]] < place[graph.edges[:, 1]]
        scores += np.where(before == (ahead > 0.0), np.abs(ahead), 0.0)
    return scores / num_axes


@kernel
def _greedy_order(start: IntArray, other: Int32Array, weight: FloatArray) -> IntArray:
    """Return the place (n,) of each camera in an order that most weight agrees with.

    The arcs of each camera follow one another: where they start (n + 1,), their other end, and their weight.
    """
    n = len(start) - 1
    entering, leaving = np.zeros(n), np.zeros(n)
    for c in range(n):
        for k in range(start[c], start[c + 1]):
            if weight[k] > 0.0:
                leaving[c] += weight[k]
            else:
                entering[c] -= weight[k]
    place = np.full(n, -1)
    for position in range(n):
        best, best_ratio = -1, -1.0
        for c in range(n):
            if place[c] < 0:
                ratio = (leaving[c] + 1.0) / (max(entering[c], 0.0) + 1.0)
                if ratio > best_ratio:
                    best, best_ratio = c, ratio
        place[best] = position
        for k in range(start[best], start[best + 1]):
            if weight[k] > 0.0:
                entering[other[k]] -= weight[k]
            else:
                leaving[other[k]] += weight[k]
    return place
