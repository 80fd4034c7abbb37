"""Sensors that may move in their rigs: how well the observations determine their poses."""

import math

import numpy as np

from sfm_shapefit.adjustment.adjustment_options import AdjustmentOptions
from sfm_shapefit.adjustment.covariance import estimate_covariances
from sfm_shapefit.adjustment.problem import AdjustmentProblem
from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.geometry import METRIC_SIGMA
from sfm_shapefit.scene.images import Images

# Factor by which errors that keypoints share make those of a sensor's pose larger than the noise alone does;
# that of a focal length (`scene.lens`).
_SHARED_NOISE = 7.0
_LARGEST_TURN_RAD = math.radians(1.0)  # rad; a sensor less sure of its rotation counts as left open


class OpenSensorError(InputError):
    """The observations leave open where a sensor is in its rig."""

    def __init__(self, camera: str) -> None:
        """Keep the reason, a clause, without what to do."""
        self.reason = (
            f"the matches do not tell where {camera} is in its rig: its images see too little that others "
            "see too, or the rig never turns"
        )
        super().__init__(f"{self.reason}; leave out rigs=free, or give more frames")


def judge_sensors(
    images: Images, free: BoolArray, adjusted: AdjustmentProblem, options: AdjustmentOptions
) -> FloatArray:
    """Return how well the poses of sensors in their rigs are known, by the noise alone.

    Args:
        images: those of the problem.
        free: (l,) lenses that moved in their rigs.
        adjusted: the problem, at its minimum.
        options: by which that is one.

    Returns:
        Largest standard deviations (l, 2) of the place along an axis, units of the images, and of the
        rotation about one, rad; NaN for sensors that are held.

    Raises:
        OpenSensorError: if the observations leave the pose of a sensor open.
    """
    found = np.full((len(free), 2), np.nan)
    if not free.any():
        return found
    try:
        sigmas = estimate_covariances(adjusted, options).sensor_sigmas
    except UnsolvableError as error:
        raise OpenSensorError("one of the sensors") from error
    longest = float(np.linalg.norm(adjusted.rig.translations, axis=1).max()) or 1.0  # all held at one center
    limits = np.repeat([METRIC_SIGMA * longest, _LARGEST_TURN_RAD], 3) / _SHARED_NOISE
    off = np.nan_to_num((sigmas / limits).max(axis=1), nan=np.inf)
    if off.max() > 1.0:
        worst = images.lenses[np.flatnonzero(free)[np.argmax(off)]]
        raise OpenSensorError(f"camera {worst.id}")
    found[free] = np.column_stack([sigmas[:, :3].max(axis=1), sigmas[:, 3:].max(axis=1)])
    return found
