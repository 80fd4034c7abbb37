"""Sensors that may move in their rigs: how well the observations tell where they are."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from sfm_shapefit.adjustment import AdjustmentOptions, AdjustmentProblem
from sfm_shapefit.adjustment.covariance import estimate_covariances
from sfm_shapefit.base.arrays import BoolArray
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.geometry import METRIC_SIGMA
from sfm_shapefit.scene.images import Images

# Errors that keypoints share make those of a sensor's pose larger than the noise alone does, as those of a
# focal length (`adjustment.free_lenses`).
_SHARED_NOISE = 7.0
_LARGEST_TURN_RAD = math.radians(1.0)
_OPEN_SENSOR = (
    "the matches do not tell where {camera} is in its rig: its images see too little that others see too, or "
    "the rig never turns; leave out rigs=free, or give more frames"
)


class SensorSigma(NamedTuple):
    """How well an adjustment knows the pose of a sensor in its rig, by the noise alone."""

    place: float
    """Largest standard deviation of its place along an axis of the rig, units of the seed."""
    turn_rad: float
    """Largest standard deviation of its rotation about an axis."""


def judge_sensors(
    images: Images, free: BoolArray, adjusted: AdjustmentProblem, options: AdjustmentOptions
) -> Mapping[int, SensorSigma]:
    """Return how well free sensors are known, by the ids of their cameras.

    Args:
        images: those of the problem.
        free: (l,) lenses that moved in their rigs.
        adjusted: the problem, at its minimum.
        options: by which that is one.

    Raises:
        InputError: if the observations leave the pose of a sensor open.
    """
    if not free.any():
        return {}
    assert adjusted.rig is not None
    try:
        sigmas = estimate_covariances(adjusted, options).sensor_sigmas
    except UnsolvableError as error:
        raise InputError(_OPEN_SENSOR.format(camera="one of the sensors")) from error
    camera_ids = [images.lenses[k].id for k in np.flatnonzero(free).tolist()]
    longest = float(np.linalg.norm(adjusted.rig.translations, axis=1).max())
    limits = np.repeat([METRIC_SIGMA * longest, _LARGEST_TURN_RAD], 3) / _SHARED_NOISE
    off = np.nan_to_num((sigmas / limits).max(axis=1), nan=np.inf)
    if off.max() > 1.0:
        raise InputError(_OPEN_SENSOR.format(camera=f"camera {camera_ids[int(np.argmax(off))]}"))
    largest = zip(camera_ids, sigmas[:, :3].max(axis=1), sigmas[:, 3:].max(axis=1), strict=True)
    return {camera_id: SensorSigma(float(place), float(turn)) for camera_id, place, turn in largest}
