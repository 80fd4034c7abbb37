"""Sensors that may move in their rigs: how well the observations tell where they are."""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from sfm_shapefit.adjustment import AdjustmentOptions, AdjustmentProblem
from sfm_shapefit.adjustment.covariance import estimate_covariances
from sfm_shapefit.base.errors import InputError, UnsolvableError
from sfm_shapefit.base.geometry import METRIC_SIGMA

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


NO_SENSORS: Mapping[int, SensorSigma] = MappingProxyType({})
"""Where rigs stay."""


def judge_sensors(
    camera_ids: Sequence[int], adjusted: AdjustmentProblem, options: AdjustmentOptions
) -> Mapping[int, SensorSigma]:
    """Return how well the free sensors of a problem at its minimum are known, by the ids of their cameras.

    Args:
        camera_ids: (s,) those of the free sensors.
        adjusted: the problem.
        options: by which the minimum is one.

    Raises:
        InputError: if the observations leave the pose of a sensor open.
    """
    assert adjusted.rig is not None
    try:
        sigmas = estimate_covariances(adjusted, options).sensor_sigmas
    except UnsolvableError as error:
        raise InputError(_OPEN_SENSOR.format(camera="one of the sensors")) from error
    longest = float(np.linalg.norm(adjusted.rig.translations, axis=1).max())
    limits = np.repeat([METRIC_SIGMA * longest, _LARGEST_TURN_RAD], 3) / _SHARED_NOISE
    off = np.nan_to_num((sigmas / limits).max(axis=1), nan=np.inf)
    if off.max() > 1.0:
        raise InputError(_OPEN_SENSOR.format(camera=f"camera {camera_ids[int(np.argmax(off))]}"))
    largest = zip(camera_ids, sigmas[:, :3].max(axis=1), sigmas[:, 3:].max(axis=1), strict=True)
    return {camera_id: SensorSigma(float(place), float(turn)) for camera_id, place, turn in largest}
