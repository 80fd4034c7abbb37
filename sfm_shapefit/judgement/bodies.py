"""Bodies: sets of nodes that belong together, found by correlation clustering.

Two sets join while what speaks for it outweighs what speaks against it, the strongest first: greedy additive
edge contraction (Keuper et al. 2015, "Efficient decomposition of image and mesh graphs by lifted multicuts",
section 4). So each set is judged by all its pairs with another together.
"""

import heapq

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray


def find_bodies(num_nodes: int, pairs: IntArray, weights: FloatArray) -> IntArray:
    """Return the body of each node, (n,): 0 for the largest, that of the first node among equals, and so on.

    The weights (m,) of node pairs (m, 2) are positive where two nodes belong together, negative where they do
    not; repeated pairs add up.
    """
    ties: list[dict[int, float]] = [{} for _ in range(num_nodes)]
    for (i, j), weight in zip(pairs.tolist(), weights.tolist(), strict=True):
        ties[i][j] = ties[j][i] = ties[i].get(j, 0.0) + weight
    queue = [(-w, i, j) for i, tie in enumerate(ties) for j, w in tie.items() if i < j and w > 0.0]
    heapq.heapify(queue)
    members = [[node] for node in range(num_nodes)]
    while queue:
        weight, i, j = heapq.heappop(queue)
        if ties[i].get(j) != -weight:
            continue  # one of the two has changed since, or is part of another
        kept, gone = (i, j) if len(ties[i]) >= len(ties[j]) else (j, i)
        members[kept] += members[gone]
        members[gone] = []
        _contract(ties, kept, gone, queue)
    bodies = np.zeros(num_nodes, dtype=np.int64)
    ordered = sorted(filter(None, members), key=lambda member: (-len(member), min(member)))
    for label, member in enumerate(ordered):
        bodies[member] = label
    return bodies


def _contract(
    ties: list[dict[int, float]], kept: int, gone: int, queue: list[tuple[float, int, int]]
) -> None:
    """Hand the ties of one node to another and queue those that became positive."""
    del ties[kept][gone]
    for other, weight in ties[gone].items():
        if other == kept:
            continue
        del ties[other][gone]
        total = ties[kept].get(other, 0.0) + weight
        ties[kept][other] = ties[other][kept] = total
        if total > 0.0:
            heapq.heappush(queue, (-total, min(kept, other), max(kept, other)))
    ties[gone] = {}
