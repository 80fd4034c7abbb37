"""Nodes that the refinement threw out of the scene, put back.

A direction says nothing of distance, so that nothing holds a camera which fits two wrong directions by chance
and whose others are rejected: it may slide to any distance, and does where that improves a residual a little.
The convex starts have no such freedom. So groups of nodes that end far beyond the start's own radius, and
whose pairs with others mostly contradict that, go back where the start had them. A far group that the rest
agrees with stays: it is far.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sfm_shapefit.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.geometry import fit_similarity_l1, median_spread
from sfm_shapefit.viewgraph import ViewGraph

_REACH = 3.0  # times the largest distance of the start, both in median distances; a sound fit moves by shares
_LEAST_AGREEMENT = 0.5  # of the pairs that leave a group
_FEWEST_AGREEING = 2  # of them with the rest: along a single direction a group may slide
_FEWEST_OTHERS = 3  # nodes that say where the start lies


def left_scene(start: FloatArray, refined: FloatArray) -> BoolArray:
    """Return the nodes that ended far outside the start's radius, (n,); scale and origin do not matter.

    Args:
        start, refined: (n, d) locations before and after the refinement.
    """
    far: BoolArray = _distances(refined) > _REACH * _distances(start).max()
    return far if np.sum(~far) >= _FEWEST_OTHERS else np.zeros_like(far)


def strays(graph: ViewGraph, far: BoolArray, agreeing: BoolArray) -> IntArray:
    """Return the nodes that left the scene without the agreement of the rest, ascending.

    Args:
        graph: the view graph.
        far: (n,) those that left it, see `left_scene`.
        agreeing: (m,) pairs that fit the refined locations.
    """
    is_far = far[graph.edges]
    i, j = graph.edges[is_far.all(axis=1) & agreeing].T
    adjacency = coo_array((np.ones(len(i)), (i, j)), shape=(graph.num_cameras, graph.num_cameras))
    count, group = connected_components(adjacency, directed=False)
    ends = group[graph.edges]
    leaving = (ends[:, 0] != ends[:, 1])[:, None] & is_far
    pairs = np.bincount(ends[leaving], minlength=count)
    agreed = np.bincount(ends[leaving & agreeing[:, None]], minlength=count)  # with the rest: else one group
    enough = (agreed >= _FEWEST_AGREEING) & (agreed > _LEAST_AGREEMENT * pairs)
    lost = far & ~enough[group]
    return np.flatnonzero(lost).astype(np.int64)


def put_back(start: FloatArray, refined: FloatArray, nodes: IntArray) -> FloatArray:
    """Return the refined locations (n, d) with some nodes where the start had them among the others."""
    others = np.ones(len(refined), dtype=np.bool_)
    others[nodes] = False
    similarity = fit_similarity_l1(start[others], refined[others], rotate=False)
    result = refined.copy()
    result[nodes] = similarity.apply(start[nodes])
    return result


def _distances(t: FloatArray) -> FloatArray:
    """Return the distance of each node from the coordinate-wise median, in median distances."""
    return np.asarray(np.linalg.norm(t - np.median(t, axis=0), axis=1) / median_spread(t))
