"""Points that do not fit are filtered, by pycolmap."""

from typing import NamedTuple

import pycolmap


class PointRules(NamedTuple):
    """What a point must satisfy."""

    max_error_px: float
    """Largest reprojection error of an observation."""
    min_angle_deg: float
    """Least angle between two of its rays."""
    min_length: int
    """Fewest observations."""


def filter_in_place(structure: pycolmap.Reconstruction, rules: PointRules) -> None:
    """Remove the observations and points that violate the rules from our own `structure`; update all errors.

    In this order: observations behind their camera or with a large reprojection error; points left with one
    observation; points without triangulation angle (the angle of a point that is not finite is NaN, which
    is none); short tracks.
    """
    manager = pycolmap.ObservationManager(structure)
    manager.filter_all_points3D(rules.max_error_px, rules.min_angle_deg)
    manager.filter_points3D_with_short_tracks(rules.min_length)
