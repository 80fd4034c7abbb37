"""A view graph of rigid groups placed: rigs, fixed cameras; the counterpart of `placement`.

First it is asked which groups the pairs tie to one another at all, offsets included (`solver.rigs.tied`).
These are solved with a certificate, finished and judged; the others hang free, with any scale, and are named.
The answer is a `Placement` like any other, whose `unit` is the length of the offsets' unit.
"""

import numpy as np

from sfm_shapefit.arrays import FloatArray, IntArray
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.judgement.trust import Evidence
from sfm_shapefit.judgement.verdicts import assess
from sfm_shapefit.placement.place import Placement
from sfm_shapefit.refinement.options import PlacementOptions
from sfm_shapefit.refinement.starts import finish
from sfm_shapefit.rigidity import RigidPiece
from sfm_shapefit.solver.program import differences
from sfm_shapefit.solver.rigs import largest_tied, solve_groups
from sfm_shapefit.solver.rigs.groups import RigidGroups
from sfm_shapefit.viewgraph import ViewGraph

_LEAST_UNIT = 1e-6  # of the median baseline: the largest offset, below which the scale means nothing


def place_groups(
    graph: ViewGraph,
    groups: RigidGroups,
    options: PlacementOptions | None = None,
    covariance: FloatArray | None = None,
    evidence: Evidence | None = None,
    num_cameras: int | None = None,
    held: int | None = None,
) -> Placement:
    """Solve the groups that a view graph ties to one another, finish them robustly, and judge them.

    Args:
        graph: any view graph; pairs inside a group take no part.
        groups: of its nodes.
        options: settings; defaults if None.
        covariance: (m, d - 1, d - 1) of each direction, see `assess`; unknown if None.
        evidence: support of the edges, and pairs whose matches contradict the rotations, see `assess`.
        num_cameras: nodes from here on are 3D points; none if None.
        held: a group that does not move, around which the others are placed; the largest tied set if None.

    Raises:
        UnsolvableError: if the pairs do not tie the groups, or leave the scale of their offsets open; the
            message says which.
    """
    options = options or PlacementOptions()
    k = graph.num_nodes if num_cameras is None else num_cameras
    tied = _tied_groups(graph, groups, k, held)
    inside = np.isin(groups.group_of[graph.edges], tied).all(axis=1)
    edges = np.flatnonzero(inside & groups.joins(graph.edges))
    piece, nodes = graph.restricted_to(edges)
    part = groups.restricted_to(nodes)
    still = None if held is None else _renumbered(groups, nodes, held)
    known = None if covariance is None else covariance[edges]
    heard = evidence and evidence.restricted_to(edges, nodes, graph.num_nodes)
    classes = np.max(graph.edges[edges] >= k, axis=1).astype(np.int64)

    solved = solve_groups(piece, part, options)
    finished = finish(piece, solved, options, known, classes, part)
    unit = _checked_unit(piece, part, finished.locations)
    placed = int(np.sum(nodes < k))
    assessment = assess(
        piece, finished.locations, known, heard, placed, part, still, unheld=finished.put_back
    )
    return Placement(
        graph=graph,
        num_cameras=k,
        dropped=np.zeros(0, dtype=np.int64),
        pieces=[RigidPiece(nodes=nodes, edges=edges, hinges=np.zeros(0, dtype=np.int64))],
        piece=0,
        solve=solved,
        finish=finished,
        assessment=assessment,
        groups=groups,
        unit=unit,
    )


def is_scaled(groups: RigidGroups, edges: IntArray) -> bool:
    """Return whether any group has two nodes apart that pairs with other groups see: else the scale is
    open."""
    nodes = np.unique(edges[groups.joins(edges)])
    return bool(len(nodes)) and bool(groups.restricted_to(nodes).centred().offsets.any())


def _tied_groups(graph: ViewGraph, groups: RigidGroups, num_cameras: int, held: int | None) -> IntArray:
    """Return the groups that are placed, or raise UnsolvableError."""
    if not is_scaled(groups, graph.edges):
        raise UnsolvableError(
            "no pair sees two cameras of one rig or of the fixed ones, so that nothing determines the scale"
        )
    sizes = np.bincount(groups.group_of[:num_cameras], minlength=groups.num_groups)
    tied = largest_tied(graph.edges, groups, sizes, around=held)
    if np.sum(sizes[tied] > 0) < 2:
        raise UnsolvableError(
            "the pairs tie no two frames to one another; match more pairs, of different cameras of a frame"
            if held is None
            else "the pairs tie no camera to the fixed ones; match the new images with more of those"
        )
    return tied


def _renumbered(groups: RigidGroups, nodes: IntArray, group: int) -> int:
    """Return the number that a group has among those of some nodes."""
    return int(np.searchsorted(np.unique(groups.group_of[nodes]), group))


def _checked_unit(graph: ViewGraph, groups: RigidGroups, locations: FloatArray) -> float:
    """Return s, or raise UnsolvableError where it is not positive or too small to mean anything."""
    unit = float(groups.fit(locations)[0][-1])
    size = float(np.linalg.norm(groups.centred().offsets, axis=1).max())
    baseline = float(np.median(np.linalg.norm(differences(locations, graph.edges), axis=1)))
    if not unit * size > _LEAST_UNIT * baseline:
        raise UnsolvableError(
            "the directions contradict the known offsets between cameras: their scale comes out as "
            f"{unit * size / baseline:.1e} of a baseline; check the rigs, or which cameras are fixed"
        )
    return unit
