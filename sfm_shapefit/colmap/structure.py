"""Structure: 3D points filtered, and colored like the input's."""

from collections.abc import Callable, Iterator

import numpy as np
import pycolmap

from sfm_shapefit.colmap.model import UInt64Array, observed_points, points2d_xy
from sfm_shapefit.colmap.structure_options import StructureOptions

Advance = Callable[[int, int], None]
"""Called with the work done so far and the work in all."""


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


def color_points(
    reconstruction: pycolmap.Reconstruction, source: pycolmap.Reconstruction, *, in_place: bool = False
) -> pycolmap.Reconstruction:
    """Return a copy whose points take the mean color of the source's points seen at the same points2D.

    Images take part if their points2D are the same in both, in number and coordinates. Points without
    any common observation keep their color. A source without any color costs no copy: the
    `reconstruction` itself is returned. So it is `in_place`, colored: a copy of a large one is large.
    """
    if not any(point.color.any() for point in source.points3D.values()):
        return reconstruction
    result = reconstruction if in_place else pycolmap.Reconstruction(reconstruction)
    ids, source_ids = (np.array(sorted(model.point3D_ids()), dtype=np.uint64) for model in (result, source))
    colors = np.array([source.point3D(i).color for i in source_ids.tolist()], dtype=np.float64).reshape(-1, 3)
    sums, counts = np.zeros((len(ids), 3)), np.zeros(len(ids), dtype=np.int64)
    for our, their in _common_observations(result, source):
        rows = np.searchsorted(ids, our)
        np.add.at(sums, rows, colors[np.searchsorted(source_ids, their)])
        np.add.at(counts, rows, 1)
    seen = counts > 0
    our_ids, means = ids[seen], np.rint(sums[seen] / counts[seen, None]).astype(np.uint8)
    for point_id, mean in zip(our_ids.tolist(), means, strict=True):
        result.point3D(point_id).color = mean
    return result


def filter_in_place(structure: pycolmap.Reconstruction, options: StructureOptions) -> None:
    """Do to our own `structure` what `filter_points` does to a copy; update the errors of points."""
    manager = pycolmap.ObservationManager(structure)
    manager.filter_all_points3D(options.max_reprojection_error_px, options.min_triangulation_angle_deg)
    manager.filter_points3D_with_short_tracks(options.min_track_length)


def _common_observations(
    result: pycolmap.Reconstruction, source: pycolmap.Reconstruction
) -> Iterator[tuple[UInt64Array, UInt64Array]]:
    """Yield the ids of the two points that each points2D of an image observes, if it does in both models."""
    for image_id in sorted(result.reg_image_ids()):
        if not source.exists_image(image_id):
            continue
        our, their = result.image(image_id), source.image(image_id)
        if not np.array_equal(points2d_xy(our), points2d_xy(their)):
            continue
        our_keypoints, our_ids = observed_points(our)
        their_keypoints, their_ids = observed_points(their)
        _, left, right = np.intersect1d(
            our_keypoints, their_keypoints, assume_unique=True, return_indices=True
        )
        yield our_ids[left], their_ids[right]
