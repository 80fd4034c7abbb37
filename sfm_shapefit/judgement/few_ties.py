"""Cameras of a view graph that so few agreeing pairs tie to the rest that none checks the others.

A camera has d unknowns, and a direction d - 1 equations: two pairs place it, and a third checks them. Pairs
that lie within the noise of one direction say the same. A street of cameras has d + 1 unknowns beside those
within: two pairs place it too.

The cuts of at most two edges are read off random numbers of the edges beyond a spanning tree: an edge of the
tree has the exclusive or of the numbers of all edges that close a loop with it. A bridge has 0 then, and two
edges whose numbers are equal are a cut (Pritchard and Thurimella 2011, "Fast computation of small cuts via
cycle space sampling"; with 64 bits chance does not count).
"""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.forests import connected_components
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.judgement.limits import ALIKE_DEG, CHANCE_SHARE, FEWEST_ALIKE
from sfm_shapefit.laplacian.operators import adjacency
from sfm_shapefit.placement.conditioning import FEW_PAIRS


class FewTies(NamedTuple):
    """Cameras that at most a few pairs tie to the rest."""

    cameras: IntArray
    """Ascending; two or more."""
    num_pairs: int
    """Pairs between them and the others."""


def barely_held(num_nodes: int, edges: IntArray, directions: FloatArray) -> BoolArray:
    """Return the nodes (n,) fewer than three of whose pairs (m, 2) differ in direction (m, d)."""
    order = np.argsort(edges.T.ravel(), kind="stable")
    ends, outward = edges.T.ravel()[order], np.concatenate([directions, -directions])[order]
    alike = np.cos(np.radians(ALIKE_DEG))
    for _ in range(FEWEST_ALIKE - 1):  # each round, the first direction of a node and all that say the same
        nodes, first = np.unique(ends, return_index=True)
        told = outward[first][np.searchsorted(nodes, ends)]
        differs = np.einsum("ed,ed->e", outward, told) < alike
        ends, outward = ends[differs], outward[differs]
    return np.asarray(np.bincount(ends, minlength=num_nodes) == 0)


def held_by_chance(graph: ViewGraph, agrees: BoolArray, level_rad: float) -> IntArray:
    """Return the nodes at most two of whose many pairs with the others agree, as chance lets two, ascending.

    The ray of a wrong pair meets another within three standard deviations where it lies in a band about half
    a half circle of directions: with odds of about `level_rad`, and its power d - 2 in d dimensions.
    """
    pairs = graph.degrees().astype(np.float64)
    others = 0.5 * pairs * (pairs - 1.0) - 1.0  # twos of pairs, but for one
    is_likely = others * level_rad ** (graph.dimension - 2) > CHANCE_SHARE
    by_chance = np.zeros(graph.num_nodes, dtype=np.bool_)
    while True:
        holding = graph.edges[agrees & ~by_chance[graph.edges].any(axis=1)]
        held = np.bincount(holding.ravel(), minlength=graph.num_nodes)
        more = is_likely & (held <= FEW_PAIRS) & ~by_chance
        if not more.any():
            return np.flatnonzero(by_chance)
        by_chance |= more


def find_few_ties(num_nodes: int, edges: IntArray) -> list[FewTies]:
    """Return the sets of nodes that a cut of at most two edges (m, 2) parts from the largest part."""
    label = connected_components(num_nodes, edges[~_in_small_cuts(num_nodes, edges)])
    is_apart = label != np.argmax(np.bincount(label))
    among = connected_components(num_nodes, edges[is_apart[edges].all(axis=1)])
    sizes = np.bincount(among[is_apart], minlength=num_nodes)
    crossing = np.bincount(among[edges[is_apart[edges].sum(axis=1) == 1]].ravel(), minlength=num_nodes)
    found = np.flatnonzero(sizes > 1).tolist()
    return [FewTies(np.flatnonzero(is_apart & (among == k)), int(crossing[k])) for k in found]


def are_bridges(num_nodes: int, edges: IntArray) -> BoolArray:
    """Return the edges (m,) without which two of their nodes are not connected."""
    return np.asarray(_loop_numbers(num_nodes, edges) == 0)


def _in_small_cuts(num_nodes: int, edges: IntArray) -> BoolArray:
    """Return the edges (m,) that are bridges, or a cut together with another edge."""
    numbers = _loop_numbers(num_nodes, edges)
    _, which, counts = np.unique(numbers, return_inverse=True, return_counts=True)
    return np.asarray((numbers == 0) | (counts[which] > 1))


def _loop_numbers(num_nodes: int, edges: IntArray) -> IntArray:
    """Return a number of each edge (m,): a random one if it closes a loop, else as the header has it."""
    levels, parent, edge_to = _spanning_forest(num_nodes, edges)
    is_loop = np.ones(len(edges), dtype=np.bool_)
    is_loop[edge_to[edge_to >= 0]] = False
    numbers = np.random.default_rng(0).integers(1, 2**63, len(edges)) * is_loop
    below = np.zeros(num_nodes, dtype=np.int64)
    for side in edges.T:
        np.bitwise_xor.at(below, side, numbers)
    for nodes in reversed(levels):
        numbers[edge_to[nodes]] = below[nodes]
        np.bitwise_xor.at(below, parent[nodes], below[nodes])
    return np.asarray(numbers)


def _spanning_forest(num_nodes: int, edges: IntArray) -> tuple[list[IntArray], IntArray, IntArray]:
    """Return breadth-first levels without roots, the parent of each node, and the edge to it; -1 of roots."""
    around, levels = adjacency(num_nodes, edges), list[IntArray]()
    parent, edge_to = np.full((2, num_nodes), -1)
    label = connected_components(num_nodes, edges)
    level = np.unique(label, return_index=True)[1]
    is_seen = np.isin(np.arange(num_nodes), level)
    while len(level):
        starts, counts = around.pointers[level], np.diff(around.pointers)[level]
        entries = np.repeat(starts - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
        entries = entries[~is_seen[around.neighbors[entries]]]
        fresh, first = np.unique(around.neighbors[entries], return_index=True)
        edge_to[fresh] = around.edge_of[entries[first]]
        parent[fresh] = edges[edge_to[fresh]].sum(axis=1) - fresh
        is_seen[fresh] = True
        level = fresh.astype(np.int64)
        levels.append(level)
    return levels, parent, edge_to
