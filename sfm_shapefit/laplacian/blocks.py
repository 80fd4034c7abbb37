"""Nodes of a graph cut into blocks of about one size, and blocks grown into their neighbors."""

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.laplacian.operators import adjacency, group_by

# METIS takes whole weights, and adds all of them up in 32 bits. Finer ones cut no better.
_LARGEST_WEIGHT, _LARGEST_SUM = 1e3, 2.0**29
_SEED = 1  # seed of METIS; the same input gives the same blocks


def cut_graph(num_nodes: int, edges: IntArray, weights: FloatArray, size: int) -> IntArray:
    """Return the block of each node, (n,), numbered without gaps: blocks of about `size` nodes, by METIS.

    Few edges (m, 2) of large weight (m,) are cut; no edge appears twice.
    """
    count = -(-num_nodes // size)
    if count <= 1 or not len(edges):
        return np.zeros(num_nodes, dtype=np.int64)
    import pymetis

    graph = adjacency(num_nodes, edges)
    scale = min(_LARGEST_WEIGHT / (weights.max() or 1.0), _LARGEST_SUM / (weights.sum() or 1.0))
    whole = 1 + (scale * weights).astype(np.int32)
    csr = pymetis.CSRAdjacency(graph.pointers.astype(np.int32), graph.neighbors)
    options = pymetis.Options(seed=_SEED)
    _, parts = pymetis.part_graph(count, csr, eweights=whole[graph.edge_of], options=options)
    return np.unique(parts, return_inverse=True)[1].astype(np.int64)


def grow_blocks(block_of: IntArray, edges: IntArray, weights: FloatArray, share: float) -> list[IntArray]:
    """Return the nodes of each block, ascending, and a share more: those outside that are tied most to it.

    Args:
        block_of: (n,) from `cut_graph`.
        edges, weights: those that were cut.
        share: of the nodes of a block.
    """
    count, grown = int(block_of.max(initial=-1)) + 1, []
    both = np.concatenate([edges, edges[:, ::-1]])
    leaves = block_of[both[:, 0]] != block_of[both[:, 1]]
    ends, ties = both[leaves], np.tile(weights, 2)[leaves]
    (first, members), (begins, rows) = group_by(block_of, count), group_by(block_of[ends[:, 0]], count)
    for k in range(count):
        own, out = members[first[k] : first[k + 1]], rows[begins[k] : begins[k + 1]]
        others, of = np.unique(ends[out, 1], return_inverse=True)
        strongest = np.argsort(-np.bincount(of, ties[out]), kind="stable")[: round(share * len(own))]
        grown.append(np.sort(np.concatenate([own, others[strongest]])))
    return grown
