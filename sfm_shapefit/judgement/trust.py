"""How far each camera is to be trusted, and why not further.

    trust = min(1, agreement / usual) * hold

agreement    the share of the camera's pairs that agree with the solution (`refinement.agreement`); a camera
             without a pair has the median one.
usual        3/4 of the median agreement of all cameras: where a part of the pairs is wrong everywhere,
             having its part of them says nothing against a camera.
hold         tau^2 / (tau^2 + sigma^2), sigma the camera's standard deviation, tau 10 % of the median
             distance of the cameras from their median: 1 where the pairs hold the camera, 1/2 where they
             leave 10 % open.

So 1 means that a camera's pairs agree as is usual in the scene and nothing is loose. This is what directions
alone can say. Where there are matches, `doubted` has more: cameras whose rotations are wrong in the same way
agree with one another, and only rotations that the pairs have by themselves tell them.
"""

from dataclasses import dataclass

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.geometry import median_spread
from sfm_shapefit.graph.measured import MeasuredGraph
from sfm_shapefit.judgement.limits import LOCAL_SHARE
from sfm_shapefit.placement.conditioning import FEW_PAIRS, Conditioning, Looseness

USUAL_SHARE = 0.75
"""Share of what is usual, or of all; a camera loses nothing of its trust with that much."""
LOW_TRUST = USUAL_SHARE
"""Trust below which reasons are given; usual cameras have more."""
SOMEWHAT_LOOSE = "its pairs leave it somewhat loose"
_CONTRADICTED = "more of its pairs contradict it than usual here: its rotation may be wrong"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraTrust:
    """The trust of k cameras, and the reasons for a low one."""

    trust: FloatArray
    """(k,) trust of each camera, in [0, 1]."""
    hold: FloatArray
    """(k,) the second factor: how well the pairs hold each camera."""
    reasons: tuple[str, ...]
    """k sentences, empty where the trust is not low."""
    loose_reasons: tuple[str, ...]
    """k sentences that say what the pairs leave open; empty where they hold the camera."""


def judge_cameras(
    measured: MeasuredGraph,
    locations: FloatArray,
    agrees: BoolArray,
    sigmas: FloatArray,
    conditioning: Conditioning,
) -> CameraTrust:
    """Return the trust of each camera and the reasons for a low one.

    A rigid group, such as a frame, is judged by the pairs of all its cameras together. Rays to points speak
    for or against a camera like pairs.

    Args:
        measured: the solved graph.
        locations: (n, d) its solution.
        agrees: (m,) which of its directions agree with that.
        sigmas: (n, d) standard deviations of the locations, infinite where nothing holds them.
        conditioning: how well the pairs hold its k cameras.
    """
    num_cameras = measured.num_cameras
    agreement = _shares(measured, agrees)
    usual = USUAL_SHARE * float(np.median(agreement))
    hold = _hold(locations[:num_cameras], sigmas[:num_cameras].max(axis=1))
    # Where most cameras have no agreement at all, any agreement is more than usual.
    relative = agreement / usual if usual > 0.0 else (agreement > 0.0).astype(np.float64)
    trust = np.minimum(relative, 1.0) * hold
    few = conditioning.num_pairs <= FEW_PAIRS
    loose = [_loose_reason(cause, is_few) for cause, is_few in zip(conditioning.causes, few, strict=True)]
    reasons = [""] * num_cameras
    for k in np.flatnonzero(trust < LOW_TRUST).tolist():
        contradicted = agreement[k] < usual and conditioning.causes[k] is not Looseness.DISTANCE
        found = [_CONTRADICTED] if contradicted else []
        reasons[k] = "; ".join([*found, *filter(None, [loose[k]])]) or SOMEWHAT_LOOSE
    return CameraTrust(trust=trust, hold=hold, reasons=tuple(reasons), loose_reasons=tuple(loose))


def _shares(measured: MeasuredGraph, agrees: BoolArray) -> FloatArray:
    """Return the share of each camera's pairs, or of those of its group, that agree; the median of none."""
    graph, labels = measured.graph, measured.moving
    ends = labels[graph.edges]
    outer = ends[:, 0] != ends[:, 1]
    count = int(labels.max()) + 1
    good, total = (np.bincount(ends[rows].ravel(), minlength=count) for rows in (outer & agrees, outer))
    shares = np.full(count, np.nan)
    np.divide(good, total, out=shares, where=total > 0)
    own = shares[labels[: measured.num_cameras]]
    known = own[np.isfinite(own)]
    return np.where(np.isfinite(own), own, np.median(known) if len(known) else 1.0)


def _hold(centers: FloatArray, largest_sigmas: FloatArray) -> FloatArray:
    """Return tau^2 / (tau^2 + sigma^2) of each camera, 1 where sigma is not known."""
    tau = LOCAL_SHARE * median_spread(centers)
    if not tau > 0.0:
        return np.where(np.isinf(largest_sigmas), 0.0, 1.0)
    return np.asarray(1.0 / (1.0 + (np.nan_to_num(largest_sigmas, nan=0.0, posinf=np.inf) / tau) ** 2))


def _loose_reason(cause: Looseness | None, few: bool) -> str:
    if cause is not None:
        return str(cause.value)
    return str(Looseness.FEW_PAIRS.value) if few else ""
