"""Steps 1 and 2: rigid sets by triangles, and by growth over the nodes that sets share.

Rigid sets are sets of pairs. They are told apart by a label per pair; while they unite, by a forest in which
each set is a tree and its smallest member the root.
"""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.forests import compact, merge_sets, roots
from sfm_shapefit.base.jit import inner_kernel, kernel
from sfm_shapefit.laplacian.operators import group_by

_GROWTH_ROUNDS = 4  # rounds; a later one rarely unites anything, and the pebble game is exact anyway

_GROWTH_WORK = 30  # nodes looked at, per incidence of a set and a node; a bound, the game is exact anyway


def triangle_sets(num_nodes: int, edges: IntArray) -> IntArray:
    """Return a root edge for each edge (m,): edges joined by a chain of triangles have the same."""
    parent = np.arange(len(edges))
    _unite_triangles(edges, np.bincount(edges.ravel(), minlength=num_nodes), parent)
    return roots(parent)


@kernel
def _unite_triangles(edges: IntArray, degree: IntArray, parent: IntArray) -> None:
    """Unite the pairs of each triangle.

    Each pair is directed to its end of higher degree, which leaves at most sqrt(2 m) pairs at any
    node, and each triangle is met once, at its lowest end.
    """
    n, m = len(degree), len(edges)
    tail, head_of = np.empty(m, np.int64), np.empty(m, np.int64)
    for e in range(m):
        i, j = edges[e, 0], edges[e, 1]
        tail[e] = i if degree[i] < degree[j] or (degree[i] == degree[j] and i < j) else j
    start, edge_of = group_by(tail, n)
    for s in range(m):
        e = edge_of[s]
        head_of[s] = edges[e, 0] + edges[e, 1] - tail[e]
    seen_from, seen_edge = np.full(n, -1, np.int64), np.empty(n, np.int64)
    for a in range(n):
        for s in range(start[a], start[a + 1]):
            seen_from[head_of[s]] = a
            seen_edge[head_of[s]] = edge_of[s]
        for s in range(start[a], start[a + 1]):
            b = head_of[s]
            for r in range(start[b], start[b + 1]):
                c = head_of[r]
                if seen_from[c] == a:
                    merge_sets(parent, edge_of[s], edge_of[r])
                    merge_sets(parent, edge_of[s], seen_edge[c])


@kernel
def incidence(
    num_nodes: int, edges: IntArray, set_of: IntArray, num_sets: int
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Return which nodes each set has, and which sets each node, as two (start, items) lists."""
    m = len(edges)
    edge_start, edge_of = group_by(set_of, num_sets)
    start, last = np.empty(num_sets + 1, np.int64), np.full(num_nodes, -1, np.int64)
    nodes, owner = np.empty(2 * m, np.int64), np.empty(2 * m, np.int64)
    count = 0
    for b in range(num_sets):
        start[b] = count
        for s in range(edge_start[b], edge_start[b + 1]):
            for side in range(2):
                node = edges[edge_of[s], side]
                if last[node] != b:
                    last[node] = b
                    nodes[count], owner[count] = node, b
                    count += 1
    start[num_sets] = count
    back_start, entries = group_by(nodes[:count], num_nodes)
    rigid_sets = np.empty(count, np.int64)
    for s in range(count):
        rigid_sets[s] = owner[entries[s]]
    return start, nodes[:count], back_start, rigid_sets


def grow_sets(num_nodes: int, edges: IntArray, set_of: IntArray) -> IntArray:
    """Return set labels after growing every set of at least 3 nodes, largest first (step 2)."""
    for _ in range(_GROWTH_ROUNDS):
        num_sets = int(set_of.max(initial=-1)) + 1
        if num_sets < 2:
            break
        growth = _Growth(
            *incidence(num_nodes, edges, set_of, num_sets),
            np.arange(num_sets),
            *np.full((2, num_sets), -1),
            *np.full((5, num_nodes), -1),
        )
        size = np.diff(growth.start)
        seeds = np.argsort(-size, kind="stable")[: int((size >= 3).sum())]
        _grow(growth, seeds, _GROWTH_WORK * len(growth.nodes))
        if (growth.parent == np.arange(num_sets)).all():
            break
        set_of = compact(roots(growth.parent)[set_of])
    return set_of


class _Growth(NamedTuple):
    """State of growing sets; a mark is valid where it equals the seed that grows."""

    start: IntArray
    nodes: IntArray
    back_start: IntArray
    rigid_sets: IntArray
    """Nodes of each set, sets at each node."""
    parent: IntArray
    """(number of sets,) which sets were united."""
    taken: IntArray
    met: IntArray
    """(number of sets,) marks: part of the seed; shares a node with it."""
    inside: IntArray
    reached: IntArray
    """(n,) marks: node of the seed; node of a set that shares one with the seed, ..."""
    reached_by: IntArray
    reached_at: IntArray
    """(n,) ... the first such set, and the node that it shares."""
    queue: IntArray
    """The seed's nodes, in the order of joining."""


@kernel
def _grow(growth: _Growth, seeds: IntArray, max_work: int) -> None:
    """Let each seed absorb each set that meets its nodes a second time, or closes a triangle with another.

    A set larger than what has grown so far is not searched for nodes that it shares with
    others, which bounds the work of small seeds beside large sets.
    """
    start, back_start, met = growth.start, growth.back_start, growth.met
    for seed in seeds:
        if growth.parent[seed] != seed or growth.taken[seed] >= 0 or max_work < 0:
            continue
        tail = _absorb(growth, seed, seed, 0)
        head = 0
        while head < tail:
            node = growth.queue[head]
            head += 1
            for s in range(back_start[node], back_start[node + 1]):
                b = growth.rigid_sets[s]
                max_work -= 1
                if growth.taken[b] == seed:
                    continue
                size = start[b + 1] - start[b]
                partner = b if met[b] == seed else -1
                if partner < 0 and size <= tail:
                    max_work -= size
                    partner = _reach_out(growth, seed, b, node)
                if partner >= 0:
                    tail = _absorb(growth, seed, partner, tail)
                    tail = _absorb(growth, seed, b, tail)
                met[b] = seed


@inner_kernel
def _reach_out(growth: _Growth, seed: int, b: int, node: int) -> int:
    """Mark the nodes of a set that meets the seed at `node`; return which set closes a triangle, or -1.

    The triangle is the seed, this set, and one that meets the seed elsewhere and this set outside.
    Two sets that meet the seed at the same node, and each other outside, share two nodes.
    """
    for s in range(growth.start[b], growth.start[b + 1]):
        other = growth.nodes[s]
        if growth.inside[other] == seed:
            continue
        if growth.reached[other] != seed:
            growth.reached[other] = seed
            growth.reached_by[other] = b
            growth.reached_at[other] = node
        elif growth.reached_at[other] == node:
            merge_sets(growth.parent, growth.reached_by[other], b)
        else:
            return int(growth.reached_by[other])
    return -1


@inner_kernel
def _absorb(growth: _Growth, seed: int, eaten: int, tail: int) -> int:
    """Unite a set with the seed and queue the nodes that it brings; return the queue's new tail."""
    if growth.taken[eaten] == seed:
        return tail
    growth.taken[eaten] = seed
    merge_sets(growth.parent, seed, eaten)
    for s in range(growth.start[eaten], growth.start[eaten + 1]):
        node = growth.nodes[s]
        if growth.inside[node] != seed:
            growth.inside[node] = seed
            growth.queue[tail] = node
            tail += 1
    return tail
