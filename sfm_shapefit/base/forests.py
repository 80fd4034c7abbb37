"""Sets that unite: a forest in which each set is a tree and its smallest member the root.

Paths are halved as they are walked (Tarjan and van Leeuwen 1984), so that the answer does not depend on the
order of unions, and costs eight bytes a member.
"""

from typing import Any

import numpy as np

from sfm_shapefit.base.arrays import IntArray
from sfm_shapefit.base.jit import inner_kernel


@inner_kernel
def root_of(parent: Any, k: int) -> int:
    """Return the root of a member."""
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


@inner_kernel
def merge_sets(parent: Any, a: int, b: int) -> None:
    """Unite the sets of two members under the smaller root."""
    a, b = root_of(parent, a), root_of(parent, b)
    if a < b:
        parent[b] = a
    else:
        parent[a] = b


def roots(parent: IntArray) -> IntArray:
    """Return the root of each member."""
    while (parent[parent] != parent).any():
        parent = parent[parent]
    return parent


def compact(label: IntArray) -> IntArray:
    """Renumber non-negative labels to 0..k-1, keeping their order."""
    used = np.zeros(int(label.max(initial=-1)) + 1, dtype=np.int64)
    used[label] = 1
    return np.asarray((np.cumsum(used) - 1)[label], dtype=np.int64)


def connected_components(num_nodes: int, edges: IntArray) -> IntArray:
    """Return the connected component of each of n nodes under edges (m, 2), numbered from 0 by first node."""
    root = np.arange(num_nodes)
    while True:
        ends = np.sort(root[edges], axis=1)
        low, high = ends[ends[:, 0] < ends[:, 1]].T
        if not len(low):
            return compact(root)
        np.minimum.at(root, high, low)
        root = roots(root)
