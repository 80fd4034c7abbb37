"""Nodes that the refinement threw out of the scene, put back.

Nothing holds a camera which fits two wrong directions by chance and whose others are rejected, or a group of
cameras that see the rest in nearly one direction: it may slide to any distance, and does where that improves
a residual a little. LUD, which bounds each length, has no such freedom. So groups of nodes that end far
beyond its radius go back where it had them, unless the rest holds them where they are: at least two pairs
with the rest agree, more than half do, and they leave the distance of the group open by less than a third.

How far a distance is open: the baseline d_e of a node at offset x_e from its group's middle changes direction
by P_e (a + s x_e) / |d_e| if the group moves by a and grows by s, P_e = I - u_e u_e^T. The information

    sum_e J_e^T J_e / sigma_e^2,    J_e = P_e [I, x_e] / |d_e|,

bounds what is known of a and s, and so of each node's a + s x. Nearly parallel baselines leave a open along
them, and a group that was blown up around the rest leaves s open. Others may hang on a group farther out:
each tenfold radius is looked at by itself.
"""

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, distinct
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.base.geometry import distances_in_spreads, fit_similarity_l1
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.program import differences

# Distance of a stray, in the largest distance of the start, both in median distances. A sound refinement
# moves cameras by a fraction of the radius, not by 3 radii.
_REACH = 3.0
_FARTHER = 10.0  # ratio of successive radii at which strays are looked for; strays may stand at any distance
_LEAST_AGREEMENT = 0.5  # share of the pairs that leave a group; if fewer agree the rest does not hold it
# Pairs with the rest that must agree: along a single direction a group may slide.
_FEWEST_AGREEING = 2
_FEWEST_OTHERS = 3  # nodes that must stay in the scene; fewer do not show where the start lies
_ROUNDING = 1e-14  # share of the largest eigenvalue; smaller ones are rounding
_UNKNOWN = 1e-12  # information that these count as; a standard deviation of a million distances
# A distance is open if its standard deviation is a larger share of it: three of them reach to the rest.
_OPEN_SHARE = 1.0 / 3.0


def find_strays(
    graph: ViewGraph, start: FloatArray, refined: FloatArray, agreeing: BoolArray, noise_rad: FloatArray
) -> IntArray:
    """Return the nodes that left the scene and that the rest does not hold where they are, ascending.

    Args:
        graph: the view graph.
        start, refined: (n, d) locations before and after; each has its own scale and origin.
        agreeing: (m,) pairs that fit the refined locations.
        noise_rad: (m,) standard deviation of each direction, per axis.
    """
    strays: BoolArray = np.zeros(graph.num_nodes, dtype=np.bool_)
    reach = _REACH
    while (far := left_scene(start, refined, reach)).any():
        strays |= _find_drifting(graph, refined, far, agreeing, noise_rad)
        reach *= _FARTHER
    return np.flatnonzero(strays).astype(np.int64)


def left_scene(start: FloatArray, refined: FloatArray, reach: float = _REACH) -> BoolArray:
    """Return the nodes that ended farther out than `reach` radii of the start, (n,), whatever the scales."""
    far = distances_in_spreads(refined, refined) > reach * distances_in_spreads(start, start).max()
    return far if np.sum(~far) >= _FEWEST_OTHERS else np.zeros_like(far)


def _find_drifting(
    graph: ViewGraph, refined: FloatArray, far: BoolArray, agreeing: BoolArray, noise_rad: FloatArray
) -> BoolArray:
    """Return those of the far nodes, (n,), whose group the others do not hold where it is."""
    is_far = far[graph.edges]
    group = connected_components(graph.num_nodes, graph.edges[is_far.all(axis=1) & agreeing])
    count = int(group.max()) + 1
    ends = group[graph.edges]
    leaving = (ends[:, 0] != ends[:, 1])[:, None] & is_far
    pairs = np.bincount(ends[leaving], minlength=count)
    agreed = np.bincount(ends[leaving & agreeing[:, None]], minlength=count)  # with the rest: else one group
    enough = (agreed >= _FEWEST_AGREEING) & (agreed > _LEAST_AGREEMENT * pairs)
    lost: BoolArray = far & ~enough[group]
    for label in distinct(group[far & enough[group]]).tolist():
        members = np.flatnonzero(group == label)
        joining = np.flatnonzero((leaving & (ends == label)).any(axis=1) & agreeing)
        lost[members] = openness(refined, graph.edges[joining], members, noise_rad[joining]) > _OPEN_SHARE
    return lost


def openness(t: FloatArray, edges: IntArray, group: IntArray, noise_rad: FloatArray) -> FloatArray:
    """Return the standard deviation of each node of a group along its loosest axis, over its distance, (k,).

    Args:
        t: (n, d) locations.
        edges: (m, 2) at least one pair, each of a node of the group and another.
        group: (k,) the nodes of the group, which moves as a whole and may grow.
        noise_rad: (m,) standard deviation of each direction, per axis.
    """
    d = t.shape[1]
    baselines = differences(t, edges)
    lengths = np.maximum(np.linalg.norm(baselines, axis=1), np.finfo(np.float64).tiny)
    u = baselines / lengths[:, None]
    first = np.isin(edges[:, 0], group)
    own, other = np.where(first, edges.T, edges.T[::-1])
    middle, unit = t[own].mean(axis=0), float(np.median(lengths))
    motions = np.tile(np.eye(d, d + 1), (len(edges), 1, 1))
    motions[:, :, d] = (t[own] - middle) / unit
    transverse = motions - u[:, :, None] * (u[:, None, :] @ motions)
    seen = transverse * (unit / (lengths * noise_rad))[:, None, None]
    values, vectors = np.linalg.eigh(np.einsum("eax,eay->xy", seen, seen))
    values = np.where(values > _ROUNDING * values[-1], values, _UNKNOWN)
    moves = np.tile(np.eye(d, d + 1), (len(group), 1, 1))
    moves[:, :, d] = (t[group] - middle) / unit
    roots = moves @ vectors / np.sqrt(values)
    sigmas = unit * np.linalg.norm(roots, ord=2, axis=(1, 2))
    return np.asarray(sigmas / np.linalg.norm(t[group] - t[other].mean(axis=0), axis=1))


def put_back(start: FloatArray, refined: FloatArray, nodes: IntArray) -> FloatArray:
    """Return the refined locations (n, d) with some nodes where the start had them among the others."""
    if len(nodes) == 0:
        return refined
    others = np.ones(len(refined), dtype=np.bool_)
    others[nodes] = False
    similarity = fit_similarity_l1(start[others], refined[others], rotate=False)
    result = refined.copy()
    result[nodes] = similarity.apply(start[nodes])
    return result
