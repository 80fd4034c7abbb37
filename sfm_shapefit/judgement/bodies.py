"""Bodies: sets of nodes that belong together, found by correlation clustering.

Two sets join while what speaks for it outweighs what speaks against it, the strongest first: greedy additive
edge contraction (Keuper et al. 2015, "Efficient decomposition of image and mesh graphs by lifted multicuts",
section 4). So each set is judged by all its pairs with another together.
"""

import heapq
from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.jit import inner_kernel, kernel, mix_bits


def find_bodies(num_nodes: int, pairs: IntArray, weights: FloatArray) -> IntArray:
    """Return the body of each node, (n,): 0 for the largest, that of the first node among equals, and so on.

    The weights (m,) of node pairs (m, 2) are positive where two nodes belong together, negative where they do
    not; repeated pairs add up.
    """
    ends = np.sort(pairs.reshape(-1, 2), axis=1).astype(np.int64)
    into = _contract(num_nodes, ends, np.array(weights, dtype=np.float64))
    while (into != into[into]).any():
        into = into[into]
    _, first, body, count = np.unique(into, return_index=True, return_inverse=True, return_counts=True)
    return np.asarray(np.argsort(np.lexsort((first, -count)))[body])


@inner_kernel
def _find(keys: Any, key: int) -> Any:
    """Return the place of a key in a table of a power of two places, or the free one where it belongs."""
    place = np.int64(mix_bits(np.uint64(key)) & np.uint64(len(keys) - 1))
    while keys[place] >= 0 and keys[place] != key:
        place = (place + 1) & (len(keys) - 1)
    return place


@inner_kernel
def _strengthen(table: Any, key: int, weight: float) -> Any:
    """Add a weight to the tie of a key; return the table of keys and ties, its place, and if it is new."""
    keys, ties, used = table
    if 2 * used >= len(keys):
        more, values = np.full(2 * len(keys), -1), np.empty(2 * len(keys))
        for place in range(len(keys)):
            if keys[place] >= 0:
                there = _find(more, keys[place])
                more[there], values[there] = keys[place], ties[place]
        keys, ties = more, values
    place = _find(keys, key)
    is_new = keys[place] < 0
    if is_new:
        keys[place], ties[place], used = key, 0.0, used + 1
    ties[place] += weight
    return (keys, ties, used), place, is_new


@kernel
def _contract(num_nodes: int, pairs: Any, weights: Any) -> Any:
    """Return the node that each is contracted into, (n,); of two, the one of more ties is kept.

    The key of the tie of i < j is i n + j. A tie to a node that is gone stays, and is not asked for.
    """
    table = (np.full(16, -1), np.empty(16), 0)
    degrees, into = np.zeros(num_nodes, np.int64), np.arange(num_nodes)
    others = [[node] for node in range(num_nodes)]  # the first is no other; an empty list has no type
    for e in range(len(pairs)):
        i, j = pairs[e]
        table, _, is_new = _strengthen(table, i * num_nodes + j, weights[e])
        if is_new:
            for a, b in ((i, j), (j, i)):
                others[a].append(b)
                degrees[a] += 1
    queue = [(0.0, 0, 0)]
    for place in range(len(table[0])):
        if table[0][place] >= 0 and table[1][place] > 0.0:
            queue.append((-table[1][place], table[0][place] // num_nodes, table[0][place] % num_nodes))
    heapq.heapify(queue)
    while queue:
        weight, i, j = heapq.heappop(queue)
        if i == j or into[i] != i or into[j] != j or table[1][_find(table[0], i * num_nodes + j)] != -weight:
            continue  # one of the two has changed since, or is part of another
        kept, lost = (i, j) if degrees[i] >= degrees[j] else (j, i)
        into[lost] = kept
        degrees[kept] -= 1
        for other in others[lost][1:]:
            if other == kept or into[other] != other:
                continue
            key = min(lost, other) * num_nodes + max(lost, other)
            handed = table[1][_find(table[0], key)]
            low, high = min(kept, other), max(kept, other)
            table, place, is_new = _strengthen(table, low * num_nodes + high, handed)
            if is_new:
                others[kept].append(other)
                others[other].append(kept)
                degrees[kept] += 1
            else:
                degrees[other] -= 1
            if table[1][place] > 0.0:
                heapq.heappush(queue, (-table[1][place], low, high))
    return into
