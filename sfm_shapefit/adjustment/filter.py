"""Structure: 3D points that do not fit are filtered."""

import pycolmap

from sfm_shapefit.tracks.options import StructureOptions


def filter_points(
    reconstruction: pycolmap.Reconstruction, options: StructureOptions | None = None
) -> pycolmap.Reconstruction:
    """Return a copy without the observations and points that violate `options`, its point errors updated.

    In this order: observations behind their camera or with a large reprojection error; points left with one
    observation; points without triangulation angle (the angle of a point that is not finite is NaN, which
    is none); short tracks.
    """
    result = pycolmap.Reconstruction(reconstruction)
    filter_in_place(result, options or StructureOptions())
    return result


def filter_in_place(structure: pycolmap.Reconstruction, options: StructureOptions) -> None:
    """Do to our own `structure` what `filter_points` does to a copy; update the errors of points."""
    manager = pycolmap.ObservationManager(structure)
    manager.filter_all_points3D(options.max_reprojection_error_px, options.min_triangulation_angle_deg)
    manager.filter_points3D_with_short_tracks(options.min_track_length)
