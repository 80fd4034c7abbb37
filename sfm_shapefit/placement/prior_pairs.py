"""Directions of pairs beside the baselines between their cameras' position priors."""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray
from sfm_shapefit.base.geometry import MEDIAN_NORMAL_LENGTH, angle_between, normalized
from sfm_shapefit.placement.gauge import Gauge
from sfm_shapefit.scene.given import PositionPriors

_FAR = 4.0  # standard deviations of the baseline; a direction beyond these and ...
_LEAST_DEG = 5.0  # ... beyond this, in degrees, contradicts it; good rotations are not that far off


class PriorAngles(NamedTuple):
    """How far directions of pairs are off the baselines between priors."""

    angles_deg: FloatArray
    """(m,) NaN where one of the cameras has no prior."""
    contradicting: BoolArray
    """(m,) what the errors of the priors do not explain."""


def compare_with_priors(
    pairs: IntArray, directions: FloatArray, priors: PositionPriors, gauge: Gauge, centers: FloatArray
) -> PriorAngles:
    """Return the angles between directions and the priors' baselines.

    A prior is off by its own standard deviation, or by the level of all, whichever is larger; seen from the
    other end of a baseline of length b two priors of sigma are off by sqrt(2) sigma / b.

    Args:
        pairs: (m, 2) cameras (i, j).
        directions: (m, 3) unit vectors of t_i - t_j in the input's axes; NaN where there is none.
        priors: priors of the cameras.
        gauge: gauge with axes of the priors.
        centers: (n, 3) of all cameras in the output; NaN for those that are not in it.
    """
    has_prior, n = priors.known, len(centers)
    positions, sigmas = np.full((n, 3), np.nan), np.full(n, np.nan)
    positions[has_prior.indices] = has_prior.positions
    level = float(np.nanmedian(np.linalg.norm(has_prior.off(centers), axis=1))) / MEDIAN_NORMAL_LENGTH
    sigmas[has_prior.indices] = np.fmax(has_prior.sigmas(), level)
    baselines = positions[pairs[:, 0]] - positions[pairs[:, 1]]
    axes = np.eye(3) if gauge.axes is None else gauge.axes
    angles = angle_between(normalized(baselines), directions @ axes.T)
    spread = np.hypot(*sigmas[pairs].T) / np.linalg.norm(baselines, axis=1)
    contradicting = (angles > _FAR * spread) & (angles > np.radians(_LEAST_DEG))
    return PriorAngles(np.degrees(angles), np.asarray(contradicting, dtype=np.bool_))
