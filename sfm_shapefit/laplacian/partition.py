"""A graph cut into parts of about equal size that few edges join.

METIS cuts best and keeps each part in one piece where it can. Without it parts are runs of a breadth-first
order from a node at the end of the graph: worse cuts, but connected in long graphs, which need parts most.

Source: Karypis and Kumar, "A fast and high quality multilevel scheme for partitioning irregular graphs",
SIAM Journal on Scientific Computing 20, 1998.
"""

from importlib.util import find_spec

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from sfm_shapefit.arrays import IntArray
from sfm_shapefit.laplacian.operators import Adjacency
from sfm_shapefit.laplacian.ordering import without_repeats

_SEED = 1


def partition(graph: Adjacency, count: int) -> IntArray:
    """Return the part of each node, (n,), numbered from 0; parts may be in pieces where the graph is.

    Args:
        graph: the neighbours of each node.
        count: number of parts wanted, at least 1.
    """
    if count <= 1 or graph.num_nodes <= count:
        return np.zeros(graph.num_nodes, dtype=np.int64)
    if find_spec("pymetis") is not None:
        return _metis_parts(graph, count)
    return _breadth_first_parts(graph, count)


def _metis_parts(graph: Adjacency, count: int) -> IntArray:
    import pymetis

    pointers, neighbours = without_repeats(graph)
    csr = pymetis.CSRAdjacency(pointers.astype(np.int32), neighbours)
    options = pymetis.Options(contig=_is_connected(graph), seed=_SEED)  # METIS refuses contig otherwise
    parts = pymetis.part_graph(count, adjacency=csr, options=options, recursive=False)[1]
    return np.asarray(parts, dtype=np.int64)


def _matrix(graph: Adjacency) -> csr_array:
    ones = np.ones(len(graph.neighbours), dtype=np.int8)
    return csr_array((ones, graph.neighbours, graph.pointers), shape=(graph.num_nodes, graph.num_nodes))


def _is_connected(graph: Adjacency) -> bool:
    return bool(connected_components(_matrix(graph), directed=False)[0] == 1)


def _breadth_first_parts(graph: Adjacency, count: int) -> IntArray:
    """Return runs of equal length of a breadth-first order that starts at an end of each component."""
    matrix = _matrix(graph)
    component = connected_components(matrix, directed=False)[1]
    orders = []
    for label in range(int(component.max()) + 1):
        first = int(np.flatnonzero(component == label)[0])
        last = int(breadth_first_order(matrix, first, directed=False)[0][-1])
        orders.append(breadth_first_order(matrix, last, directed=False)[0])
    parts = np.empty(graph.num_nodes, dtype=np.int64)
    parts[np.concatenate(orders)] = np.arange(graph.num_nodes) * count // graph.num_nodes
    return parts
