"""A placement whose cameras an adjustment has moved: other locations of the same graph, judged anew."""

from dataclasses import replace

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import fit_similarity_l1, median_spread
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.placement.place import Placement, replace_locations
from sfm_shapefit.refinement.options import PlacementOptions

# A camera that is farther off, of the spread of all, has no say in the common scale and shift.
_CAP_OF_SIZE = 0.5
# A point whose rays are closer to parallel stays where it is.
_LEAST_SPREAD = 1e-12


def move_cameras(placement: Placement, locations: FloatArray, options: PlacementOptions) -> Placement:
    """Return the placement with its cameras moved, and its points after them.

    Args:
        placement: of k cameras.
        locations: (k, 3) of these, in the solver's units; a camera whose row is NaN stays where it is.
        options: as they were given to `place`.

    Raises:
        UnsolvableError: if the factor for standard deviations would take more memory than allowed.
    """
    refined, before = placement.refined, placement.locations
    known = np.isfinite(locations).all(axis=1)
    moved = refined.locations.copy()
    moved[: len(before)][known] = locations[known]
    by = float(np.median(np.linalg.norm(moved[: len(before)] - before, axis=1))) / median_spread(before)
    adjusted = replace(
        refined,
        locations=_follow(placement.measured_part(), moved),
        reason=f"{refined.reason}; then adjusted to the pixels, which moved cameras by {by:.2%} (median)",
        reset_nodes=np.setdiff1d(refined.reset_nodes, np.flatnonzero(known)),
    )
    return replace_locations(placement, adjusted, options)


def bring_to_scale(placement: Placement, centers: FloatArray) -> FloatArray:
    """Return centers of the placement's cameras (k, 3), of any scale and origin, in the solver's units.

    The axes are the placement's; rows of NaN stay so.
    """
    known, there = np.isfinite(centers).all(axis=1), placement.locations
    cap = _CAP_OF_SIZE * median_spread(there)
    return fit_similarity_l1(centers[known], there[known], rotate=False, cap=cap).apply(centers)


def _follow(part: MeasuredGraph, locations: FloatArray) -> FloatArray:
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
