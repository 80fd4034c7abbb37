"""Trust where the pairs were asked for rotations of their own.

    trust = min(f, hold'),    hold' = 4 tau^2 / (4 tau^2 + sigma^2), see `trust`

With s = placed / (placed + turned) of `turns`, the share of the pairs that agree with a camera as placed:

    right         f = min(1, s / 0.75), which is 0.8 or more
    ambiguous     f = 0.67: kept by default, and to be looked at
    turned        f = s, which is less than 0.3
    unsupported   f = 0
    unknown       trust as by the share of pairs alone

Where rotations are not to be doubted, f = 1. hold' is 0.5 for a sigma of 20 % of the scene. That sigma is
twice the one at which `trust` has 0.5, because wrong pairs widen the residuals that sigma is drawn from, and
wrong pairs are known better here. A pair whose rotation agrees and whose direction does not, as of repeated
structure, says nothing of a turn: `places` asks those where the camera is instead.
"""

from dataclasses import replace

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.judgement.limits import MOST_AGAINST
from sfm_shapefit.judgement.trust import LOW_TRUST, SOMEWHAT_LOOSE, USUAL_SHARE
from sfm_shapefit.judgement.turns import Doubt, Doubts
from sfm_shapefit.judgement.verdicts import Assessment


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
    share = doubts.placed / np.maximum(doubts.placed + doubts.turned, 1e-300)
    by_kind = {
        Doubt.RIGHT: np.minimum(share / USUAL_SHARE, 1.0),
        Doubt.AMBIGUOUS: np.full(len(share), 1.0 - MOST_AGAINST),
        Doubt.TURNED: share,
        Doubt.UNSUPPORTED: np.zeros(len(share)),
        Doubt.UNKNOWN: np.full(len(share), np.nan),
    }
    return np.array([by_kind[kind][camera] for camera, kind in enumerate(doubts.kinds)])


def _reason(doubts: Doubts, camera: int) -> str:
    """Say what speaks against a camera, the likelier cause first; nothing if nothing does."""
    kind, others = doubts.kinds[camera], len(doubts.members(camera)) - 1
    together = f", together with {others} other camera{'s' if others > 1 else ''}" if others else ""
    turn = f"a turn by {doubts.angles_deg[camera]:.0f} degrees{together}"
    is_guessed = doubts.guessed is not None and doubts.guessed[camera]
    subject = "its rotation, or its guessed focal length," if is_guessed else "its rotation"
    if kind is Doubt.TURNED:
        return f"{subject} is wrong: {doubts.num_turned[camera]} of its pairs agree on {turn}"
    if kind is Doubt.AMBIGUOUS:
        share = doubts.turned[camera] / (doubts.placed[camera] + doubts.turned[camera])
        return f"repeated structure, or a wrong rotation: {share:.0%} of its evidence is for {turn}"
    if kind is Doubt.UNSUPPORTED:
        return f"none of its pairs agrees with it: {subject} may be wrong"
    return ""
