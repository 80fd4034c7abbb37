"""A placement whose cameras an adjustment has moved: other locations of the same graph."""

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import median_spread
from sfm_shapefit.placement.place import Placement, replace_locations
from sfm_shapefit.refinement.near import follow_cameras


def move_cameras(placement: Placement, locations: FloatArray) -> Placement:
    """Return the placement with k cameras at `locations` (k, 3), NaN unmoved, and its points after them."""
    refined, earlier = placement.refined, placement.locations
    has_location = np.isfinite(locations).all(axis=1)
    moved = refined.locations.copy()
    moved[: len(earlier)][has_location] = locations[has_location]
    by = float(np.median(np.linalg.norm(moved[: len(earlier)] - earlier, axis=1))) / median_spread(earlier)
    why = f"{refined.finish.reason}; then adjusted to the pixels, which moved cameras by {by:.2%} (median)"
    locations = follow_cameras(placement.measured_part(), moved)
    reset = np.setdiff1d(refined.reset_nodes, np.flatnonzero(has_location))
    return replace_locations(placement, refined.moved_to(locations, reset, reason=why))
