"""Cameras on one line, as of a straight drive: directions between them say nothing of lengths along it."""

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, quantile
from sfm_shapefit.judgement.limits import CHANCE_SHARE, FEWEST_ALIKE, KNOWN_DEG


def find_line(directions: FloatArray) -> FloatArray | None:
    """Return the line (d,) within a degree of 19 in 20 unit directions (m, d); None if there is none."""
    if len(directions) < FEWEST_ALIKE:
        return None
    _, _, axes = np.linalg.svd(directions, full_matrices=False)
    line = axes[0]
    for _ in range(2):  # the second time without those that are far off
        along = directions @ line
        across = np.linalg.norm(directions - along[:, None] * line, axis=1)
        angles_deg = np.degrees(np.arctan2(across, np.abs(along)))
        near = angles_deg <= quantile(angles_deg, 1.0 - CHANCE_SHARE)
        line = np.linalg.svd(directions[near], full_matrices=False)[2][0]
    return line if bool(angles_deg[near].max() <= KNOWN_DEG) else None


def sigma_along(line: FloatArray, locations: FloatArray, covariances: FloatArray) -> float:
    """Return the median known standard deviation along a unit line (d,), over the cameras' extent."""
    variances = np.einsum("a,kab,b->k", line, covariances, line)
    valid = np.isfinite(variances) & (variances >= 0.0)
    extent = float(np.ptp(locations @ line)) if len(locations) else 0.0
    if not valid.any() or extent == 0.0:
        return float("nan")
    return float(np.median(np.sqrt(variances[valid]))) / extent
