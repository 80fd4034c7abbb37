"""Dense or sparse: which factor of a matrix over the n d coordinates of a graph's nodes is the faster one."""

from collections.abc import Callable

from sfm_shapefit.graph.viewgraph import ViewGraph

FEW_UNKNOWNS = 450
"""Unknowns up to which a sparse factor does not pay; whatever the graph."""

_MOST_DENSE_UNKNOWNS = 1800  # unknowns; beyond, a dense factor takes seconds
_DENSE_SHARE = 0.3  # share of all pairs; from here on no order of elimination saves much


def prefers_dense_factor(graph: ViewGraph, predict_flops: Callable[[], float]) -> bool:
    """Return whether the matrix of edge blocks (d, d) of a graph is better factored as a dense one.

    `predict_flops` returns the operations of the sparse factorization; it is asked only where the size and
    the density of the graph leave the answer open.
    """
    n, unknowns = graph.num_nodes, graph.num_nodes * graph.dimension
    if unknowns <= FEW_UNKNOWNS:
        return True
    if unknowns > _MOST_DENSE_UNKNOWNS:
        return False
    share = 2.0 * graph.num_edges / (n * (n - 1.0))
    return share >= _DENSE_SHARE or predict_flops() > unknowns**3 / 12
