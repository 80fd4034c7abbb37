"""The rigid groups of a measured graph that are placed: rigs, fixed cameras; the counterpart of rigid pieces.

The pairs tie some groups to one another, offsets included (`solver.rigs.tied`). These are placed, with the
scale of their offsets; the others hang free, with any scale.
"""

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.graph.rigidity import RigidPiece
from sfm_shapefit.solver.program import differences
from sfm_shapefit.solver.rigs.tied import largest_tied

# The largest offset, of the median baseline, below which the scale of the offsets means nothing.
_LEAST_UNIT = 1e-6


def is_scaled(groups: RigidGroups, edges: IntArray) -> bool:
    """Return whether any group has two nodes apart that pairs with other groups see.

    Without one the scale of the offsets is open.
    """
    nodes = np.unique(edges[groups.joins(edges)])
    return bool(len(nodes)) and bool(groups.restricted_to(nodes).center().offsets.any())


def find_tied_piece(measured: MeasuredGraph) -> RigidPiece:
    """Return the nodes of the groups that the pairs tie to one another, and the edges between these groups.

    They are those around the fixed group, or the largest set if none is fixed.

    Raises:
        UnsolvableError: if the pairs do not tie the groups, or leave the scale of their offsets open; the
            message says which.
    """
    groups, edges = measured.groups, measured.graph.edges
    assert groups is not None
    if not is_scaled(groups, edges):
        raise UnsolvableError(
            "no pair sees two cameras of one rig or of the fixed ones, so that nothing determines the scale"
        )
    sizes = measured.cameras_per_group
    tied = largest_tied(edges, groups, sizes, around=measured.fixed_group)
    if np.sum(sizes[tied] > 0) < 2:
        raise UnsolvableError(
            "the pairs tie no two frames to one another; match more pairs, of different cameras of a frame"
            if measured.fixed_group is None
            else "the pairs tie no camera to the fixed ones; match the new images with more of those"
        )
    inside = np.isin(groups.group_of[edges], tied).all(axis=1)
    rows = np.flatnonzero(inside & groups.joins(edges))
    return RigidPiece(nodes=np.unique(edges[rows]), edges=rows, hinges=np.zeros(0, dtype=np.int64))


def measure_unit(part: MeasuredGraph, locations: FloatArray) -> float:
    """Return the length of the offsets' unit at the locations (n, d) of tied groups.

    Raises:
        UnsolvableError: if it is not positive, or too small to mean anything.
    """
    assert part.groups is not None
    unit = float(part.groups.fit(locations)[0][-1])
    size = float(np.linalg.norm(part.groups.center().offsets, axis=1).max())
    baseline = float(np.median(np.linalg.norm(differences(locations, part.graph.edges), axis=1)))
    if not unit * size > _LEAST_UNIT * baseline:
        raise UnsolvableError(
            "the directions contradict the known offsets between cameras: their scale comes out as "
            f"{unit * size / baseline:.1e} of a baseline; check the rigs, or which cameras are fixed"
        )
    return unit
