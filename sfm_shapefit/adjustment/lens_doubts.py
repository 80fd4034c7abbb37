"""What lenses that are not known add to the covariances of centers.

A lens that moved with the poses adds what its freedom adds for independent noise. Errors that keypoints
share are left to lenses that are held (`shared_errors`): smooth fields drawn at random would go straight into
a free focal length. A lens whose focal length the points left open stays as it was given, off by its own
doubt s: its camera stands off along its view by s times the depth of what it sees, and no other follows.
"""

import numpy as np

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.covariance import estimate_covariances, focal_shares
from sfm_shapefit.adjustment.freedom import Freedom
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.scene.images import Images
from sfm_shapefit.scene.lens import FOCAL


def errors_of_free_lenses(
    problem: AdjustmentProblem, options: AdjustmentOptions, freedom: Freedom
) -> tuple[FloatArray, FloatArray]:
    """Return what free lenses add to the covariances (n, 3, 3) of centers, and their own sigmas (l,).

    Sigmas are those of the focal lengths, as shares of them.

    Args:
        problem: at its minimum, with its priors.
        options: as it was adjusted with, but for the lenses.
        freedom: which lenses were free.

    Raises:
        UnsolvableError: if the observations leave more open than a similarity.
    """
    free = estimate_covariances(problem, options, **freedom.overrides())
    held = estimate_covariances(problem, options, deciding=free.deciding)
    return excess(free.centers, held.centers), focal_shares(problem, free)


def excess(larger: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return by what covariances (n, 3, 3) are larger than others, where they are; 0 where either is NaN."""
    more = np.nan_to_num(larger - covariances)
    values, axes = np.linalg.eigh(0.5 * (more + more.transpose(0, 2, 1)))
    return np.asarray((axes * np.maximum(values, 0.0)[:, None]) @ axes.transpose(0, 2, 1))


def covariances_of_open_lenses(
    images: Images, problem: AdjustmentProblem, image_of: IntArray, is_open: BoolArray
) -> FloatArray:
    """Return what lenses that were left open add to the covariances of images, (i, 3, 3).

    Args:
        images: all posed.
        problem: whose points they see.
        image_of: (o,) image of each observation.
        is_open: (l,) lenses whose focal length stays what was given, though that is in doubt.
    """
    found, views, centers = np.zeros((images.num_images, 3, 3)), images.rotations[:, 2], images.centers
    for k in np.flatnonzero(is_open[images.lens_of]).tolist():
        view = views[k]
        seen = problem.points[problem.points_seen[image_of == k]]
        if len(seen):
            depth = float(np.median((seen - centers[k]) @ view))
            sigma = images.lenses[images.lens_of[k]].sigmas[FOCAL] * depth
            found[k] = sigma**2 * np.outer(view, view)
    return found
