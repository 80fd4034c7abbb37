"""How well position priors fit the cameras, and which of them are wrong."""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import FloatArray, IntArray
from sfm_shapefit.base.geometry import angle_between_deg, median_spread, normalized
from sfm_shapefit.placement.gauge import ALL_FREE, FEWEST_CHECKED, residual_level
from sfm_shapefit.scene.given import PositionPriors

_FAR = 5.0  # standard deviations; of 100,000 cameras with normal errors two are farther off by chance
_ROUNDING = 1e-9  # share of the priors' spread; the least error of a prior, where all fit exactly


class PriorFit(NamedTuple):
    """How far cameras are off their priors, and directions of pairs off the priors' baselines."""

    off: FloatArray
    """(n,) distances in the priors' units; NaN where a camera is not placed or has no prior."""
    wrong: IntArray
    """(k,) cameras that are farther off than the errors of both explain, the farthest first."""
    angles_deg: FloatArray
    """(m,) NaN where one of the cameras has no prior."""
    is_metric: bool = False
    """Whether the priors' units are meters, as of positions on Earth."""


def compare_with_priors(
    centers: FloatArray, sigmas: FloatArray, priors: PositionPriors, pairs: IntArray, directions: FloatArray
) -> PriorFit:
    """Return how well priors fit cameras that stand in the priors' axes.

    A prior is off by its own standard deviation, or by the level of all, whichever is larger. Where
    none has a standard deviation, one of five right ones is called wrong in 7 of 100 draws, of eight in less
    than one.

    Args:
        centers: (n, 3) of all cameras in the priors' axes; NaN for those that are not in the output.
        sigmas: (n,) standard deviations of the centers, per axis; NaN where unknown, infinite where nothing
            holds a camera.
        priors: priors of the cameras.
        pairs: (m, 2) cameras (i, j).
        directions: (m, 3) unit vectors of t_i - t_j in the priors' axes; NaN where there is none.
    """
    rows, n = priors.known.indices, len(centers)
    positions, off, errors = np.full((n, 3), np.nan), np.full(n, np.nan), np.full(n, np.nan)
    positions[rows] = priors.known.positions
    off[rows] = np.linalg.norm(priors.known.off(centers), axis=1)
    known = np.isfinite(off)
    count, unknowns = max(int(known.sum()), 1), ALL_FREE.unknowns
    level = residual_level(off[known], unknowns, robust=count >= FEWEST_CHECKED) if known.any() else 0.0
    level *= (3 * count / max(3 * count - unknowns, 1)) ** 2  # a level of few is not well known itself
    least = max(level, _ROUNDING * median_spread(priors.known.positions))
    errors[rows] = np.fmax(priors.known.sigmas(), least)
    wrong = np.flatnonzero(off > _FAR * np.hypot(errors, np.nan_to_num(sigmas, posinf=np.inf)))
    angles_deg = angle_between_deg(normalized(positions[pairs[:, 0]] - positions[pairs[:, 1]]), directions)
    wrong = wrong[np.argsort(-off[wrong], kind="stable")]
    return PriorFit(off, wrong, angles_deg, is_metric=priors.datum is not None)
