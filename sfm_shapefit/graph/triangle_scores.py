"""All-about-that-base: a pair is as wrong as its triangles say, and triangles count by their other sides.

In a triangle without errors the direction of one side lies on the arc between the other two, suitably signed.
The angle to that arc is what the triangle says of the side; the mean over triangles its score (AAB).
Iterated, a triangle's weight falls with the last scores of its other two sides (IR-AAB). Pairs in no triangle
have nothing against them. Nor has a triangle whose other two sides are nearly opposite, as they are at a far
camera: its arc is half a circle of no plane in particular. It is left aside, which the paper does not do.

Source: Shi and Lerman, "Estimation of camera locations in highly corrupted scenarios: all about that base, no
shape trouble", CVPR 2018, sections 3 and 4. Written from the paper.
"""

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.geometry import angle_between, normalized
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.operators import adjacency

_ITERATIONS = 10  # rounds of weights and scores; the weights sharpen from one to the next
_SHARPEST = 20.0  # fall of a triangle's weight per radian of its sides' scores; reached in the last round
# Two sides are opposite if one is so near to the other turned round; a noise of 0.05 then bends the
# plane by 0.3.
_OPPOSITE_RAD = 0.2


def triangle_scores(graph: ViewGraph, iterations: int = _ITERATIONS) -> FloatArray:
    """Return each pair's mean angle to what its triangles say, (m,) radians; 0 for pairs in no triangle."""
    sides = _triangles(graph)
    if len(sides) == 0:
        return np.zeros(graph.num_edges)
    angles = _angles(graph, sides)
    sides, angles = sides[np.isfinite(angles)], angles[np.isfinite(angles)]
    scores = _weighted_means(sides[:, 0], angles, np.ones(len(sides)), graph.num_edges)
    for step in range(1, iterations + 1):
        doubt = scores[sides[:, 1]] + scores[sides[:, 2]]
        weights = np.exp(-_SHARPEST * step / iterations * (doubt - doubt.min()))
        scores = _weighted_means(sides[:, 0], angles, weights + 1e-12, graph.num_edges)
    return scores


def _weighted_means(side: IntArray, angles: FloatArray, weights: FloatArray, num_edges: int) -> FloatArray:
    total = np.bincount(side, weights=weights, minlength=num_edges)
    sums = np.bincount(side, weights=weights * angles, minlength=num_edges)
    return np.asarray(np.divide(sums, total, out=np.zeros(num_edges), where=total > 0.0))


def _triangles(graph: ViewGraph) -> IntArray:
    """Return the triangles of each pair, (k, 3) edge indices: the pair (i, j), the pair of i, that of j."""
    around = adjacency(graph.num_nodes, graph.edges)
    blocks = [np.empty((0, 3), dtype=np.int64)]
    for e, (i, j) in enumerate(graph.edges.tolist()):
        rows = [slice(around.pointers[c], around.pointers[c + 1]) for c in (i, j)]
        around_i, around_j = (around.neighbors[row] for row in rows)
        _, of_i, of_j = np.intersect1d(around_i, around_j, assume_unique=True, return_indices=True)
        sides = np.full((len(of_i), 3), e, dtype=np.int64)
        sides[:, 1] = around.edge_of[rows[0]][of_i]
        sides[:, 2] = around.edge_of[rows[1]][of_j]
        blocks.append(sides)
    return np.concatenate(blocks)


def _angles(graph: ViewGraph, sides: IntArray) -> FloatArray:
    """Return the angle of each triangle's first side to the arc of the others, (k,) radians; NaN if none."""
    i, j = graph.edges[sides[:, 0]].T
    v = graph.directions
    a = np.where((graph.edges[sides[:, 1], 0] == i)[:, None], 1.0, -1.0) * v[sides[:, 1]]  # from k to i
    b = np.where((graph.edges[sides[:, 2], 0] == j)[:, None], -1.0, 1.0) * v[sides[:, 2]]  # from j to k
    x = v[sides[:, 0]]  # from j to i: a positive sum of both
    with np.errstate(invalid="ignore"):
        e2 = normalized(b - np.sum(a * b, axis=1, keepdims=True) * a)
    e2 = np.nan_to_num(e2)
    along_a, along_e = np.sum(x * a, axis=1), np.sum(x * e2, axis=1)
    reach = np.arctan2(np.sum(b * e2, axis=1), np.sum(a * b, axis=1))  # length of the arc from a to b
    nearest = np.arctan2(along_e, along_a)
    on_arc = (nearest >= 0.0) & (nearest <= reach)
    off_plane = x - along_a[:, None] * a - along_e[:, None] * e2
    to_plane = np.arctan2(np.linalg.norm(off_plane, axis=1), np.hypot(along_a, along_e))
    angles = np.where(on_arc, to_plane, np.minimum(angle_between(x, a), angle_between(x, b)))
    return np.where(angle_between(a, -b) < _OPPOSITE_RAD, np.nan, angles)
