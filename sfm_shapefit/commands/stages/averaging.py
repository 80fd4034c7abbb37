"""Averaged rotations that can be trusted: several averagings, the most consistent kept, checked on its pairs.

Rotation averaging has no certificate, and its answer depends on which pairs it sees: on lego100 with the
stored poses of all pairs of 15 matches nine cameras end up to 166 degrees off, with those of 30 none. So
several limits and two losses are tried, and each answer is judged on the same pairs, all of them:

    w_ij       sqrt(number of matches): a false pair of a thousand matches is not a thousand witnesses
    agree_ij   both cameras have a rotation, and R_j R_i^T is within 5 degrees of the pair's own
    share      sum of w_ij over the agreeing pairs / sum of all w_ij
    score      share * share of cameras that have a rotation

The answers within 0.005 of the best score are equally consistent; of those the finest fit is kept, by

    fit        sum of w_ij max(0, 1 - residual / 5 deg) / sum of all w_ij

Weighted by the number of matches itself, the score prefers an answer with six wrong cameras on lego100.
"""

from contextlib import suppress
from dataclasses import replace

import numpy as np

from sfm_shapefit.arrays import BoolArray, FloatArray
from sfm_shapefit.colmap.rotation_averaging import average_rotations
from sfm_shapefit.errors import UnsolvableError
from sfm_shapefit.geometry import rotation_angles_deg
from sfm_shapefit.locate_options import LEAST_MATCHES
from sfm_shapefit.rotations.averaged import AGREEMENT_DEG, AveragedRotations, Loss
from sfm_shapefit.rotations.relative_rotations import RelativeRotations

_LIMITS = (LEAST_MATCHES, 20, 30, 50, 80)
_LOSSES: tuple[Loss, ...] = ("geman-mcclure", "half-norm")
_EQUAL_SCORES = 0.005


def average_consistently(
    num_images: int, relative: RelativeRotations, min_matches: int = 0
) -> AveragedRotations:
    """Return the most consistent rotations of some images; of several components one is answered.

    With `min_matches` 0 several limits are tried.

    Raises:
        UnsolvableError: if no averaging succeeds.
    """
    answers = _answers(num_images, relative, min_matches)
    if not answers:
        raise UnsolvableError(
            f"the relative rotations of {len(relative.pairs)} pairs cannot be averaged; match more images"
        )
    best = max(answer.score for answer in answers)
    chosen = max((a for a in answers if a.score >= best - _EQUAL_SCORES), key=lambda a: a.fit)
    return replace(chosen, num_tried=len(answers))


def _answers(num_images: int, relative: RelativeRotations, min_matches: int) -> list[AveragedRotations]:
    """Return an answer per setting that is different from the others and succeeds."""
    seen: set[tuple[int, bool]] = set()
    answers = []
    sound = relative.are_sound()
    for sound_only in (True, False):
        for limit in (min_matches,) if min_matches else _LIMITS:
            used = relative.num_matches >= limit
            if sound_only:
                used &= sound
            setting = int(used.sum()), sound_only and not bool(sound.all())
            if setting in seen or not used.any():
                continue
            seen.add(setting)
            given = relative.subset(used)
            for loss in _LOSSES:
                with suppress(UnsolvableError):
                    found = average_rotations(
                        num_images, given.pairs, given.rotations, given.num_matches, loss=loss
                    )
                    answers.append(_judge(relative, found, limit, loss, sound_only))
    return answers


def _judge(
    relative: RelativeRotations,
    found: tuple[FloatArray, BoolArray],
    min_matches: int,
    loss: Loss,
    sound_only: bool,
) -> AveragedRotations:
    """Compare averaged rotations with the sound pairs, or with all if none is sound."""
    rotations, registered = found
    sound = relative.are_sound()
    pairs = relative.subset(sound) if sound.any() else relative
    i, j = pairs.pairs.T
    predicted = rotations[j] @ rotations[i].transpose(0, 2, 1)
    residuals = rotation_angles_deg(pairs.rotations.transpose(0, 2, 1) @ predicted)
    both = registered[i] & registered[j]
    weights = np.sqrt(pairs.num_matches)
    agreeing = weights * (both & (residuals <= AGREEMENT_DEG))
    near = weights * both * np.maximum(0.0, 1.0 - residuals / AGREEMENT_DEG)
    n = len(registered)
    ends, total = pairs.pairs.T.ravel(), np.bincount(pairs.pairs.T.ravel(), np.tile(weights, 2), n)
    with np.errstate(invalid="ignore"):
        agreements = np.bincount(ends, np.tile(agreeing, 2), n) / total
    return AveragedRotations(
        rotations=rotations,
        registered=registered,
        score=float(agreeing.sum() / weights.sum() * registered.mean()),
        share=float(agreeing.sum() / max(float((weights * both).sum()), 1e-300)),
        fit=float(near.sum() / weights.sum()),
        agreements=np.asarray(agreements, dtype=np.float64),
        min_matches=min_matches,
        loss=loss,
        sound_only=sound_only,
    )
