"""Trust where the pairs were asked for rotations of their own.

    trust = min(f, hold'),    hold' = 4 tau^2 / (4 tau^2 + sigma^2), see `trust`

With the weights of `turns`, in matches, the pairs that agree with a camera as placed, that agree on a turn
instead, and whose direction is off although the rotation agrees:

    right         f = min(1, (placed + 15) / (placed + turned + contrary + 30) / 0.75)
    ambiguous     f from 0.62 to 0.72: kept by default, and to be looked at
    turned        f = placed / (placed + turned), which is less than 0.3
    unsupported   f = 0.1
    unknown       trust as by the share of matches alone

The 30 matches, half of them for the camera, are what every camera has beforehand; 0.75 of its matches are
enough for a camera to lose nothing. What is astray is contrary up to half of what agrees, and again beyond
twice of it: a camera that many pairs hold is not left out for repeated structure in others. Where rotations
are not to be doubted, f = 1.

hold' is half where the pairs leave 20 % of the scene open, twice what it takes without their rotations: a
standard deviation is drawn from residuals that wrong pairs widen, and these are known better here.
"""

from dataclasses import replace

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.judgement.trust import LOW_TRUST, SOMEWHAT_LOOSE
from sfm_shapefit.judgement.turns import RIGHT_SHARE, TURNED_SHARE, Doubt, Doubts
from sfm_shapefit.judgement.verdicts import Assessment

_PRIOR = 30.0  # matches that every camera has beforehand; half of them for it
_USUAL_SHARE = 0.75  # share of a camera's matches; with that many for it, it loses nothing
_AMBIGUOUS = (0.62, 0.72)  # range of f; kept by default, but below the trust that goes without reasons
_UNSUPPORTED = 0.1  # f; low, as no pair speaks for the camera


def weigh_doubts(assessment: Assessment, doubts: Doubts) -> Assessment:
    """Return an assessment whose trust and reasons follow the doubts of the same cameras."""
    factors = _factors(doubts)
    finite = np.isfinite(factors)
    trust = np.where(finite, np.minimum(factors, _lenient_hold(assessment)), assessment.trust)
    return _with_reasons(replace(assessment, trust=trust, doubts=doubts), finite)


def confirm_cameras(assessment: Assessment, sure: BoolArray) -> Assessment:
    """Return the same with trust in cameras (k,) that are `sure`, whatever their pairs say."""
    trust = np.where(sure, np.maximum(assessment.trust, LOW_TRUST), assessment.trust)
    doubts = assessment.doubts and assessment.doubts.without(sure)
    among = sure if doubts is None else np.isfinite(_factors(doubts))
    return _with_reasons(replace(assessment, trust=trust, doubts=doubts), among)


def _with_reasons(assessment: Assessment, among: BoolArray) -> Assessment:
    """Return the same with reasons `among` the cameras (k,) where trust is low, and none where it is not."""
    reasons, doubts = list(assessment.reasons), assessment.doubts
    for camera in np.flatnonzero(among).tolist():
        found = ["" if doubts is None else _reason(doubts, camera), assessment.loose_reasons[camera]]
        is_low = assessment.trust[camera] < LOW_TRUST
        reasons[camera] = ("; ".join(filter(None, found)) or SOMEWHAT_LOOSE) if is_low else ""
    return replace(assessment, reasons=tuple(reasons))


def believe_rotations(assessment: Assessment) -> Assessment:
    """Return an assessment whose trust depends only on how well the pairs hold each camera."""
    hold = _lenient_hold(assessment)
    return _with_reasons(replace(assessment, trust=hold), np.ones(len(hold), dtype=np.bool_))


def _lenient_hold(assessment: Assessment) -> FloatArray:
    """Return the hold for twice the tau."""
    hold = assessment.hold
    return np.asarray(4.0 * hold / (1.0 + 3.0 * hold))


def _factors(doubts: Doubts) -> FloatArray:
    """Return f of each camera; NaN where nothing is known."""
    placed, turned = doubts.placed, doubts.turned
    share = placed / np.maximum(placed + turned, 1e-300)
    contrary = np.minimum(doubts.astray, 0.5 * placed) + np.maximum(doubts.astray - 2.0 * placed, 0.0)
    right = (placed + 0.5 * _PRIOR) / (placed + turned + contrary + _PRIOR) / _USUAL_SHARE
    within = np.clip((share - TURNED_SHARE) / (RIGHT_SHARE - TURNED_SHARE), 0.0, 1.0)
    by_kind = {
        Doubt.RIGHT: np.minimum(right, 1.0),
        Doubt.AMBIGUOUS: _AMBIGUOUS[0] + (_AMBIGUOUS[1] - _AMBIGUOUS[0]) * within,
        Doubt.TURNED: share,
        Doubt.UNSUPPORTED: np.full(len(placed), _UNSUPPORTED),
        Doubt.UNKNOWN: np.full(len(placed), np.nan),
    }
    return np.array([by_kind[kind][camera] for camera, kind in enumerate(doubts.kinds)])


def _reason(doubts: Doubts, camera: int) -> str:
    """Say what speaks against a camera, the likelier cause first; nothing if nothing does."""
    kind, others = doubts.kinds[camera], len(doubts.members(camera)) - 1
    together = f", together with {others} other camera{'s' if others > 1 else ''}" if others else ""
    turn = f"a turn by {doubts.angles_deg[camera]:.0f} degrees{together}"
    if kind is Doubt.TURNED:
        return f"its rotation is wrong: {doubts.num_turned[camera]} of its pairs agree on {turn}"
    if kind is Doubt.AMBIGUOUS:
        return f"repeated structure, or a wrong rotation: its matches speak as much for {turn}"
    if kind is Doubt.UNSUPPORTED:
        return "none of its pairs agrees with it: its rotation may be wrong"
    if doubts.astray[camera] > doubts.placed[camera]:
        return "repeated structure: the directions of more of its matches contradict it than agree"
    return "pairs of repeated structure" if doubts.turned[camera] > 0.0 else ""
