"""A placement whose cameras an adjustment has moved: other locations of the same graph."""

from dataclasses import replace

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import median_spread
from sfm_shapefit.placement.place import Placement, replace_locations
from sfm_shapefit.refinement.near import follow_cameras


def move_cameras(placement: Placement, locations: FloatArray) -> Placement:
    """Return the placement with its cameras moved, and its points after them.

    Args:
        placement: of k cameras.
        locations: (k, 3) of these, in the solver's units; a camera whose row is NaN stays where it is.
    """
    refined, before = placement.refined, placement.locations
    known = np.isfinite(locations).all(axis=1)
    moved = refined.locations.copy()
    moved[: len(before)][known] = locations[known]
    by = float(np.median(np.linalg.norm(moved[: len(before)] - before, axis=1))) / median_spread(before)
    adjusted = replace(
        refined,
        locations=follow_cameras(placement.measured_part(), moved),
        reason=f"{refined.reason}; then adjusted to the pixels, which moved cameras by {by:.2%} (median)",
        reset_nodes=np.setdiff1d(refined.reset_nodes, np.flatnonzero(known)),
    )
    return replace_locations(placement, adjusted)
