"""How well the images of a model are held by its 3D points: their number, errors, tracks, and coverage.

Errors are those of COLMAP's own projection, through any of its camera models. `adjustment` measures its
errors in ideal views of a fisheye, where they are up to a tenth larger or smaller.
"""

from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.files.colmap.model import PosedModel

_CELLS = 8  # cells per side of the picture; its coverage is the share of these with a point


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageQuality:
    """The n posed images of a model; NaN for one that sees no point."""

    num_points: IntArray
    """(n,) 3D points that it observes."""
    errors_px: FloatArray
    """(n,) mean reprojection error."""
    track_lengths: FloatArray
    """(n,) median number of images that observe its points."""
    coverage: FloatArray
    """(n,) share of the cells of an 8 x 8 grid over the picture that hold an observation of a point."""
    point_errors_px: FloatArray
    """(k,) mean reprojection error of each point of the model; NaN of one that no posed image observes."""
    point_track_lengths: IntArray
    """(k,) number of images that observe each point."""


def image_quality(model: PosedModel) -> ImageQuality:
    """Return how well each image is held by the model's points."""
    points = model.reconstruction.points3D
    ids = np.array(sorted(points.keys()), dtype=np.uint64)
    positions = np.array([points[k].xyz for k in ids.tolist()]).reshape(-1, 3)
    lengths = np.array([points[k].track.length() for k in ids.tolist()], dtype=np.int64)
    sums, times = np.zeros(len(ids)), np.zeros(len(ids))
    n = model.num_images
    counts, errors = np.zeros(n, dtype=np.int64), np.full(n, np.nan)
    tracks, coverage = np.full(n, np.nan), np.zeros(n)
    for k, image_id in enumerate(model.image_ids.tolist()):
        seen = model.reconstruction.image(image_id).get_observation_points2D()
        counts[k] = len(seen)
        if not seen:
            continue
        rows = np.searchsorted(ids, np.array([point.point3D_id for point in seen], dtype=np.uint64))
        pixels = np.array([point.xy for point in seen])
        in_camera = (positions[rows] - model.centers[k]) @ model.rotations[k].T
        camera = model.camera(k)
        projected = np.asarray(camera.img_from_cam(in_camera, check_cheirality=False))
        misses = np.linalg.norm(projected - pixels, axis=1)
        np.add.at(sums, rows, misses)
        np.add.at(times, rows, 1.0)
        errors[k] = float(misses.mean())
        tracks[k] = float(np.median(lengths[rows]))
        cells = np.clip(_CELLS * pixels / [camera.width, camera.height], 0, _CELLS - 1).astype(np.int64)
        coverage[k] = len(np.unique(cells, axis=0)) / _CELLS**2
    return ImageQuality(
        num_points=counts,
        errors_px=errors,
        track_lengths=tracks,
        coverage=coverage,
        point_errors_px=np.where(times > 0.0, sums / np.maximum(times, 1.0), np.nan),
        point_track_lengths=lengths,
    )
