"""Scale bars: known lengths between points that images show, which set the scale or check it.

With lengths d of the bars in the model and L as they are known, each says of the logarithm of the scale

    y = ln(L / d),        Sigma = E E^T + diag(v / d^2 + sigma^2 / L^2),

E being the draws of the relative errors of d that the bars share with all of the model, v / d^2 what the
marks of each add, sigma / L how well it is known. The scale is exp(sum w y), with weights w by the inverse
diagonal of Sigma, and ln of it has the variance w^T Sigma w. A bar is compared with what the others say, in
standard deviations of the difference; the worst beyond four has no part, as long as two are left. Two that
contradict one another both count, and the scale is as uncertain as they differ.
"""

from typing import NamedTuple

import numpy as np

from sfm_shapefit.adjustment.place_errors import Distances, ScaleErrors
from sfm_shapefit.base.arrays import BoolArray, FloatArray, IntArray, distinct
from sfm_shapefit.scene.given import ScaleBars

MOST_SIGMAS = 4.0
"""Standard deviations; bars farther off contradict the others, or the model: 1 right bar of 16,000."""


class BarFit(NamedTuple):
    """The scale that bars give a model."""

    scale: float
    """Output's units in one of the model's."""
    sigma: float
    """Relative standard deviation of the scale."""
    used: BoolArray
    """(b,) bars that set it."""
    num_control: int
    """Bars that the model has and that may set it."""
    scores: FloatArray
    """(b,) by how much each is longer in the model than the others make it, in standard deviations of that;
    NaN for bars that the model lacks, and where there is no other."""
    errors: ScaleErrors
    """Errors of the scale."""

    @property
    def statement(self) -> str:
        """How well the bars agree, a clause."""
        known = f"the scale is known to {100.0 * self.sigma:.2g} %"
        return f"{int(self.used.sum())} of {self.num_control} agree, {known}"

    @property
    def contradict(self) -> bool:
        """Whether bars that set the scale contradict one another."""
        return bool((np.abs(self.scores[self.used]) > MOST_SIGMAS).any())


def fit_scale_bars(bars: ScaleBars, found: Distances) -> BarFit | None:
    """Return the scale by bars as they are found in a model; None if it has none that may set it."""
    lengths = found.lengths
    known: BoolArray = np.asarray(np.isfinite(lengths) & (lengths > 0.0))
    used = known & ~bars.is_check
    if not used.any():
        return None
    with np.errstate(invalid="ignore", divide="ignore"):
        y = np.log(bars.lengths / lengths)
        shared = found.length_draws / lengths[:, None]
        own = found.length_variances / lengths**2 + (bars.sigmas / bars.lengths) ** 2
    while True:
        scores = np.full(len(y), np.nan)
        for k in np.flatnonzero(known).tolist():
            others = used & (np.arange(len(y)) != k)
            if others.any():
                signs = np.where(np.arange(len(y)) == k, 1.0, -_weights(shared, own, others))
                scores[k] = -signs[known] @ y[known] / np.sqrt(_variance(shared, own, signs, known))
        off = np.where(used, np.abs(np.nan_to_num(scores)), 0.0)
        if used.sum() <= 2 or off.max() <= MOST_SIGMAS:
            break
        used = used & (np.arange(len(y)) != np.argmax(off))
    weights = _weights(shared, own, used)
    sigma = np.sqrt(_variance(shared, own, weights, used))
    if off.max() > MOST_SIGMAS:
        sigma = max(sigma, 0.5 * np.ptp(y[used]))
    draws = -weights[used] @ shared[used]
    return BarFit(
        scale=float(np.exp(weights[used] @ y[used])),
        sigma=float(sigma),
        used=used,
        num_control=int(np.sum(known & ~bars.is_check)),
        scores=scores,
        errors=ScaleErrors(draws, float(np.sqrt(max(sigma**2 - np.sum(draws**2), 0.0)))),
    )


def _weights(shared: FloatArray, own: FloatArray, chosen: BoolArray) -> FloatArray:
    """Return weights (b,) of sum 1 by the inverse variances of those that are chosen, 0 for the others."""
    weights = np.where(chosen, 1.0 / (np.sum(shared**2, axis=1) + own), 0.0)
    return np.asarray(weights / weights.sum())


def _variance(shared: FloatArray, own: FloatArray, signs: FloatArray, chosen: BoolArray) -> float:
    """Return the variance of a sum of bars with some signs (b,)."""
    return float(np.sum((signs[chosen] @ shared[chosen]) ** 2) + signs[chosen] ** 2 @ own[chosen])


def pooled_noise(errors_px: FloatArray, points: IntArray, noise_px: float) -> float:
    """Return the standard deviation of marks along an axis, by their distances (m,) from points (m,).

    They are few: as many degrees of freedom as one point in three images leaves speak for that of keypoints.
    """
    freedom = 2.0 * len(points) - 3.0 * len(distinct(points))
    noise_px = noise_px if np.isfinite(noise_px) else 0.5
    return float(np.sqrt((np.sum(errors_px**2) + 3.0 * noise_px**2) / (freedom + 3.0)))
