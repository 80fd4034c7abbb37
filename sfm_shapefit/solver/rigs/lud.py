"""LUD over groups: the convex start that does not collapse on long chains, see `solver.splitting.lud`."""

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.graph.groups import RigidGroups
from sfm_shapefit.graph.viewgraph import ViewGraph
from sfm_shapefit.solver.rigs.reduced import RigidReduction
from sfm_shapefit.solver.splitting.linear import Resources
from sfm_shapefit.solver.splitting.lud import solve_lud

# As the start of a refinement that is enough; more hardly moves it.
_MAX_STEPS = 150


def lud_over_groups(graph: ViewGraph, groups: RigidGroups, max_steps: int = _MAX_STEPS) -> FloatArray | None:
    """Return LUD's locations (n, d), centered, after some steps; None if the system breaks down.

    The splitting sees the groups through its linear solve alone, which moves the locations by A x. Every pair
    of the graph joins two groups, and all groups are connected.
    """
    try:
        factor = RigidReduction(graph.edges, groups.normalize())
        resources = Resources(factor=factor)
        locations = solve_lud(graph, max_steps, certified=False, resources=resources).locations
    except UnsolvableError:
        return None
    return locations if np.isfinite(locations).all() else None
