"""Steps 1 and 2: rigid sets by triangles, and by growth over the nodes that sets share.

Rigid sets are sets of pairs. They are told apart by a label per pair; while they unite, by a forest in which
each set is a tree and its smallest member the root.
"""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.arrays import IntArray
from sfm_shapefit.jit import kernel
from sfm_shapefit.laplacian.operators import group_by

# A later round rarely unites anything; the pebble game is exact anyway.
_GROWTH_ROUNDS = 4

# Limit of the nodes looked at while growing, as a multiple of all incidences of sets and nodes.
_GROWTH_WORK = 30


def compact(label: IntArray) -> IntArray:
    """Renumber non-negative labels to 0..k-1, keeping their order."""
    used = np.zeros(int(label.max(initial=-1)) + 1, dtype=np.int64)
    used[label] = 1
    return np.asarray((np.cumsum(used) - 1)[label], dtype=np.int64)


@kernel()
def find_root(parent: IntArray, item: int) -> int:
    """Return the root of an item, halving its path."""
    while parent[item] != item:
        parent[item] = parent[parent[item]]
        item = parent[item]
    return item


@kernel()
def unite(parent: IntArray, a: int, b: int) -> None:
    """Unite the sets of two items under the smaller root."""
    a = find_root(parent, a)
    b = find_root(parent, b)
    if a < b:
        parent[b] = a
    else:
        parent[a] = b


@kernel()
def triangle_sets(num_nodes: int, edges: IntArray) -> IntArray:
    """Return a root edge for each edge (m,): edges joined by a chain of triangles have the same.

    Each pair is directed to its end of higher degree, which leaves at most sqrt(2 m) pairs at any
    node, and each triangle is met once, at its lowest end.
    """
    m = len(edges)
    degree = np.zeros(num_nodes, np.int64)
    for e in range(m):
        degree[edges[e, 0]] += 1
        degree[edges[e, 1]] += 1
    tail = np.empty(m, np.int64)
    for e in range(m):
        i, j = edges[e, 0], edges[e, 1]
        tail[e] = i if (degree[i], i) < (degree[j], j) else j
    start, edge_of = group_by(tail, num_nodes)
    head_of = (edges[:, 0] + edges[:, 1] - tail)[edge_of]

    parent = np.arange(m)
    seen_from = np.full(num_nodes, -1, np.int64)
    seen_edge = np.empty(num_nodes, np.int64)
    for a in range(num_nodes):
        for s in range(start[a], start[a + 1]):
            seen_from[head_of[s]] = a
            seen_edge[head_of[s]] = edge_of[s]
        for s in range(start[a], start[a + 1]):
            b = head_of[s]
            for r in range(start[b], start[b + 1]):
                c = head_of[r]
                if seen_from[c] == a:
                    unite(parent, edge_of[s], edge_of[r])
                    unite(parent, edge_of[s], seen_edge[c])
    for e in range(m):
        parent[e] = find_root(parent, e)
    return parent


@kernel()
def incidence(
    num_nodes: int, edges: IntArray, set_of: IntArray, num_sets: int
) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Return which nodes each set has, and which sets each node, as two (start, items) lists."""
    m = len(edges)
    edge_start, edge_of = group_by(set_of, num_sets)
    start = np.zeros(num_sets + 1, np.int64)
    nodes, owner = np.empty(2 * m, np.int64), np.empty(2 * m, np.int64)
    last = np.full(num_nodes, -1, np.int64)
    count = 0
    for b in range(num_sets):
        for s in range(edge_start[b], edge_start[b + 1]):
            for side in range(2):
                node = edges[edge_of[s], side]
                if last[node] != b:
                    last[node] = b
                    nodes[count], owner[count] = node, b
                    count += 1
        start[b + 1] = count
    back_start, entries = group_by(nodes[:count], num_nodes)
    return start, nodes[:count].copy(), back_start, owner[entries]


def grow_sets(num_nodes: int, edges: IntArray, set_of: IntArray) -> IntArray:
    """Return set labels after growing every set of at least 3 nodes, largest first (step 2)."""
    for _ in range(_GROWTH_ROUNDS):
        num_sets = int(set_of.max(initial=-1)) + 1
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
        set_of = compact(growth.parent[set_of])
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


@kernel()
def _grow(growth: _Growth, seeds: IntArray, max_work: int) -> None:
    """Let each seed absorb what step 2 allows; leave a root set for each set in `parent`."""
    for seed in seeds:
        if growth.parent[seed] == seed and growth.taken[seed] < 0 and max_work >= 0:
            max_work -= _grow_seed(growth, seed)
    for b in range(len(growth.parent)):
        growth.parent[b] = find_root(growth.parent, b)


@kernel()
def _grow_seed(growth: _Growth, seed: int) -> int:
    """Absorb each set that meets the seed's nodes a second time; return the work done.

    A set larger than what has grown so far is not searched for nodes that it shares with
    others, which bounds the work of small seeds beside large sets.
    """
    work = 0
    tail = _absorb(growth, seed, seed, 0)
    head = 0
    while head < tail:
        node = growth.queue[head]
        head += 1
        for s in range(growth.back_start[node], growth.back_start[node + 1]):
            b = growth.rigid_sets[s]
            work += 1
            if growth.taken[b] == seed:
                continue
            size = growth.start[b + 1] - growth.start[b]
            if growth.met[b] == seed:
                tail = _absorb(growth, seed, b, tail)
            elif size <= tail:
                work += size
                tail = _reach_out(growth, seed, b, node, tail)
            growth.met[b] = seed
    return work


@kernel()
def _reach_out(growth: _Growth, seed: int, b: int, node: int, tail: int) -> int:
    """Mark the nodes of a set that meets the seed at `node`; absorb it if that closes a triangle.

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
            unite(growth.parent, growth.reached_by[other], b)
        else:
            tail = _absorb(growth, seed, growth.reached_by[other], tail)
            return _absorb(growth, seed, b, tail)
    return tail


@kernel()
def _absorb(growth: _Growth, seed: int, eaten: int, tail: int) -> int:
    """Unite a set with the seed and queue the nodes that it brings; return the queue's new tail."""
    if growth.taken[eaten] == seed:
        return tail
    growth.taken[eaten] = seed
    unite(growth.parent, seed, eaten)
    for s in range(growth.start[eaten], growth.start[eaten + 1]):
        if growth.inside[growth.nodes[s]] != seed:
            growth.inside[growth.nodes[s]] = seed
            growth.queue[tail] = growth.nodes[s]
            tail += 1
    return tail
