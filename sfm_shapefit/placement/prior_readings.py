"""Readings of position priors that fit far better, looked for where the priors fit the cameras roughly."""

import numpy as np

from sfm_shapefit.base.arrays import FloatArray
from sfm_shapefit.base.geometry import fit_similarity_l1, median_spread
from sfm_shapefit.scene.given import PositionPriors

_FEWEST = 5  # priors; fewer fit almost any reading
_MOST = 500  # priors, about; more would not tell more
_BETTER = 3.0  # times; a reading that fits better by less may do so by chance
_FOOT = 0.3048  # meters; the foot since 1959
_POLE = 1e-9  # cosine of the latitude; a smaller one is that of a pole


def better_reading(source: FloatArray, priors: PositionPriors) -> str:
    """Return how priors would fit the cameras `source` (k, 3) far better, a clause; empty if no way does.

    Scenes are small beside Earth, so that each reading is a linear map of the priors about their median.
    """
    some = slice(None, None, max(1, len(source) // _MOST))
    source, target = source[some], priors.known.positions[some]
    if len(source) < _FEWEST:
        return ""
    target = target - np.median(target, axis=0)
    off = {words: _off(source, target @ reading.T) for words, reading in _readings(priors).items()}
    best = min(off, key=off.__getitem__)
    if _BETTER * off[best] >= _off(source, target):
        return ""
    return f"{best}, they are {100.0 * off[best]:.2g} % of it off: give them so"


def _readings(priors: PositionPriors) -> dict[str, FloatArray]:
    """Return what maps priors to what they are by other readings, (3, 3), by the words for these."""
    mirror = np.diag([-1.0, 1.0, 1.0])
    if priors.datum is None:
        return {"with two axes swapped, or the sign of one changed": mirror}
    east, north = np.cos(np.radians([priors.datum.longitude_deg, priors.datum.latitude_deg]))
    swapped = np.diag([east, 1.0 / max(north, _POLE), 1.0])[:, [1, 0, 2]]
    return {
        **({"with latitude and longitude swapped": swapped} if east > 0.0 else {}),
        "with the sign of latitude or longitude changed (south and west are negative)": mirror,
        "with altitudes in feet": np.diag([1.0, 1.0, _FOOT]),
    }


def _off(source: FloatArray, target: FloatArray) -> float:
    """Return how far targets are off a similarity of cameras, the median as a share of their spread."""
    size = median_spread(target)
    off = fit_similarity_l1(source, target, cap=0.5 * size).apply(source) - target
    return float(np.median(np.linalg.norm(off, axis=1))) / size
