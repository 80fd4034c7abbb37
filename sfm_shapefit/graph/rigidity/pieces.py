"""The rigid pieces of a graph: growth, then the pebble game on more and more of what is left."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sfm_shapefit.base.arrays import Int32Array, IntArray, distinct, frozen
from sfm_shapefit.base.errors import InputError
from sfm_shapefit.base.forests import compact
from sfm_shapefit.base.jit import kernel
from sfm_shapefit.base.lists import RowLists
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.graph.rigidity.game import contract, play
from sfm_shapefit.graph.rigidity.growth import grow_sets, incidence, triangle_sets
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.laplacian.operators import adjacency, check_edges

_FIRST_GAME_NODES = 500  # nodes; a pebble game on these takes milliseconds

_FEW_LINKS = 6  # pairs per node; twice what rigidity needs in space, mostly enough where pairs abound


@dataclass(frozen=True, slots=True, eq=False)
class RigidPiece:
    """A maximal set of pairs whose nodes are determined up to one translation and one scale."""

    nodes: IntArray
    """Its nodes, ascending, at least 2."""
    edges: IntArray
    """Indices of its pairs in the graph's `edges`, ascending."""
    hinges: IntArray
    """Nodes that also belong to another piece of at least 3 nodes, ascending."""


def parallel_rigid_pieces(num_nodes: int, edges: IntArray, dimension: int) -> IntArray:
    """Return the rigid piece of each pair, for positions in general position.

    The contraction is exact: a motion of the whole is one translation and scale per set, equal where sets
    share a node. A set on the b shared nodes w_0, w_1, ... is replaced by a frame: d - 1 copies of each
    w_0 w_k, one of each w_1 w_k, k > 1. It admits the same motions there, as it has d b - (d + 1) copies, and
    it is independent, since each w_k adds d copies, at most d - 1 of them to one node.

    Args:
        num_nodes: n.
        edges: (m, 2) node indices; InputError for a self-loop or an index outside [0, n).
        dimension: d >= 2.

    Returns:
        (m,) labels. Piece 0 has the most nodes; then come more edges, then the smaller first node, then the
        smaller second one, whatever the order of `edges`. A pair may be a piece of its own.
    """
    edges = _check_edges(num_nodes, edges, dimension)
    set_of = compact(triangle_sets(num_nodes, edges))
    set_of = grow_sets(num_nodes, edges, set_of)
    part = _FIRST_GAME_NODES
    while True:
        game = contract(num_nodes, edges, set_of, part, dimension)
        united, is_settled = play(game, dimension)
        set_of = united[set_of]
        if is_settled and game.is_whole:
            return _rank(num_nodes, edges, set_of)
        if set_of.max() + 1 < game.num_sets:
            set_of = grow_sets(num_nodes, edges, set_of)
        if is_settled:
            part *= 2


def is_parallel_rigid(num_nodes: int, edges: IntArray, dimension: int) -> bool:
    """Return whether pairs fix all n nodes up to translation and scale, generically; one node is rigid."""
    checked = _check_edges(num_nodes, edges, dimension)
    if len(checked):
        graph = adjacency(num_nodes, checked)
        if _grows_from_first_pair(checked, graph.pointers, graph.neighbors):
            return True
    few = checked[_among_first_links(num_nodes, checked, _FEW_LINKS)]
    if 2 * len(few) <= len(checked) and _is_one_piece(num_nodes, few, dimension):
        return True  # more pairs only hold the nodes faster; the search takes memory by the pair
    return _is_one_piece(num_nodes, checked, dimension)


def _is_one_piece(num_nodes: int, edges: IntArray, dimension: int) -> bool:
    """Return whether the checked pairs are one rigid piece, and touch every node."""
    label = parallel_rigid_pieces(num_nodes, edges, dimension)
    if len(label) == 0:
        return num_nodes == 1
    return bool(label.max() == 0) and len(distinct(edges)) == num_nodes


def rigid_pieces(graph: ViewGraph) -> list[RigidPiece]:
    """Return the parallel-rigid pieces of a view graph, largest first; single pairs are pieces too."""
    return _find_pieces(graph.num_nodes, graph.edges, graph.dimension)


def rigid_pieces_of_groups(graph: ViewGraph, groups: RigidGroups) -> list[RigidPiece]:
    """Return the pieces of a view graph the nodes of each of whose groups are at one place."""
    outer, pieces = np.flatnonzero(groups.joins(graph.edges)), []
    for piece in _find_pieces(groups.num_groups, groups.group_of[graph.edges[outer]], graph.dimension):
        edges = outer[piece.edges]
        nodes = distinct(graph.edges[edges])
        hinges = nodes[np.isin(groups.group_of[nodes], piece.hinges)]
        pieces.append(RigidPiece(frozen(nodes), frozen(edges), frozen(hinges)))
    return pieces


def _find_pieces(num_nodes: int, pairs: IntArray, dimension: int) -> list[RigidPiece]:
    """Return the pieces of pairs (m, 2), of which some may be given more than once."""
    label = parallel_rigid_pieces(num_nodes, pairs, dimension)
    if len(label) == 0:
        return []
    num_pieces = int(label.max()) + 1
    start, nodes, _, _ = incidence(num_nodes, pairs, label, num_pieces)
    owner = np.repeat(np.arange(num_pieces), np.diff(start))
    nodes = nodes[np.lexsort((nodes, owner))]

    is_large = np.diff(start)[owner] >= 3
    large_at = np.bincount(nodes[is_large], minlength=num_nodes)
    is_hinge = large_at[nodes] - is_large > 0

    edges = RowLists.by_label(label)
    parts = zip(np.split(nodes, start[1:-1]), edges, np.split(is_hinge, start[1:-1]), strict=True)
    return [RigidPiece(frozen(own), frozen(rows), frozen(own[hinge])) for own, rows, hinge in parts]


@kernel
def _grows_from_first_pair(edges: IntArray, start: IntArray, neighbors: Int32Array) -> bool:
    """Return whether the first pair grows to all nodes by nodes that are joined to two of its own.

    Sufficient for rigidity, and linear in the pairs: each such node has 2 (d - 1) >= d new copies of edges.
    """
    num_nodes = len(start) - 1
    links = np.zeros(num_nodes, dtype=np.int64)
    last = np.full(num_nodes, -1)  # the member that linked last: a pair given twice is one link
    members = np.empty(num_nodes, dtype=np.int64)
    members[0], members[1] = edges[0, 0], edges[0, 1]
    links[members[0]] = links[members[1]] = 2
    size, done = 2, 0
    while done < size:
        node = members[done]
        done += 1
        for p in range(start[node], start[node + 1]):
            other = neighbors[p]
            links[other] += last[other] != node
            if links[other] == 2 and last[other] != node:
                members[size] = other
                size += 1
            last[other] = node
    return bool(size == num_nodes)


@kernel
def _among_first_links(num_nodes: int, edges: IntArray, few: int) -> npt.NDArray[np.bool_]:
    """Return which pairs are among the first `few` kept at one of their nodes, at least, (m,)."""
    counts = np.zeros(num_nodes, dtype=np.int64)
    is_kept = np.zeros(len(edges), dtype=np.bool_)
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        if counts[i] < few or counts[j] < few:
            is_kept[e] = True
            counts[i] += 1
            counts[j] += 1
    return is_kept


def _check_edges(num_nodes: int, edges: IntArray, dimension: int) -> IntArray:
    """Return `edges` as a contiguous, read-only (m, 2) int64 array, or raise InputError."""
    if dimension < 2:
        raise InputError(f"parallel rigidity needs dimension >= 2, got {dimension}")
    return frozen(check_edges(num_nodes, edges))


def _rank(num_nodes: int, edges: IntArray, set_of: IntArray) -> IntArray:
    """Renumber final pieces: more nodes, more edges, smaller first, smaller second node first."""
    if len(set_of) == 0:
        return set_of
    num_sets = int(set_of.max()) + 1
    start, nodes, _, _ = incidence(num_nodes, edges, set_of, num_sets)
    num_edges = np.bincount(set_of, minlength=num_sets)
    smallest = np.minimum.reduceat(nodes, start[:-1])
    owner = np.repeat(np.arange(num_sets), np.diff(start))
    others = np.where(nodes == smallest[owner], num_nodes, nodes)
    second = np.minimum.reduceat(others, start[:-1])  # two pieces never share both
    order = np.lexsort((second, smallest, -num_edges, -np.diff(start)))
    rank = np.empty(num_sets, dtype=np.int64)
    rank[order] = np.arange(num_sets)
    return np.asarray(rank[set_of], dtype=np.int64)
