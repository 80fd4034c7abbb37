"""Cameras that an adjustment has placed already: what is kept of a solve is its certificate."""

from dataclasses import replace

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import fit_similarity_l1, median_spread
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.refinement.angular import residual_levels
from sfm_shapefit.refinement.consensus import fit_mixture
from sfm_shapefit.refinement.starts import OPENING_RAD, RefinedPlacement
from sfm_shapefit.solver.program import normalize_locations
from sfm_shapefit.solver.solver_options import SolverResult

_CAP_OF_SIZE = 0.5  # spreads of all cameras; a larger distance from solved to adjusted counts no more
_COLLAPSED = 1e-9  # spreads of the solution; cameras that fit it with a smaller spread fit it nowhere
_LEAST_SPREAD = 1e-12  # smallest eigenvalue of a point's sum of projectors; below, its rays are parallel
# Rounds of "which residuals are inside?" and "how large are these?"; the level settles in about five.
_ROUNDS = 10


def stay_near(
    measured: MeasuredGraph, solved: SolverResult, centers: FloatArray, near: RefinedPlacement
) -> RefinedPlacement:
    """Return the locations of cameras that an adjustment has placed, and points where their rays meet.

    The centers (k, 3) are those of the cameras of a piece whose certified solution is given, in any scale and
    from any origin, in the same axes; `near` is the placement that was adjusted.
    """
    graph, there = measured.graph, solved.locations[: len(centers)]
    size, locations = median_spread(there), solved.locations.copy()
    fit = fit_similarity_l1(centers, there, rotate=False, cap=_CAP_OF_SIZE * size)
    # Where the solution has nothing of the adjusted cameras, it fits them best with all in one point.
    is_lost = fit.scale * median_spread(centers) <= _COLLAPSED * size
    locations[: len(centers)] = centers if is_lost else fit.apply(centers)
    locations = normalize_locations(graph, follow_cameras(measured, locations))
    opening = np.full(int(measured.classes.max()) + 1, OPENING_RAD)
    levels = residual_levels(measured, locations, opening, _ROUNDS)
    moved = near.moved_to(
        locations,
        np.empty(0, dtype=np.int64),
        refined=True,
        reason=f"{near.finish.reason}; then adjusted to the pixels, rotations too",
        levels_deg=tuple(np.degrees(levels).tolist()),
    )
    return replace(moved, posterior=fit_mixture(measured, locations).posterior)


def follow_cameras(part: MeasuredGraph, locations: FloatArray) -> FloatArray:
    """Return the locations with each point where the rays of its cameras come closest to one another.

    The point x minimizes sum |P_v (c - x)|^2 over its cameras c and directions v; P_v = I - v v^T.
    """
    rows = np.flatnonzero(~part.is_pair)
    cameras, points = part.graph.edges[rows].T
    v = part.graph.directions[rows]
    projectors = np.eye(3) - v[:, :, None] * v[:, None, :]
    sums, targets = np.zeros((part.graph.num_nodes, 3, 3)), np.zeros((part.graph.num_nodes, 3))
    np.add.at(sums, points, projectors)
    np.add.at(targets, points, np.einsum("kab,kb->ka", projectors, locations[cameras]))
    held = np.linalg.eigvalsh(sums)[:, 0] > _LEAST_SPREAD
    followed = locations.copy()
    followed[held] = np.linalg.solve(sums[held], targets[held][:, :, None])[:, :, 0]
    return followed
