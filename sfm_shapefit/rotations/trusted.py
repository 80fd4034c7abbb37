"""Averaged rotations that can be trusted: several averagings, the most consistent kept, checked on its pairs.

Our own averaging (`rotations.average`) tries several answers itself. pycolmap's has an answer that depends on
which pairs it sees: on lego100 with the stored poses of all pairs of 15 matches nine cameras end up to 166
degrees off, with those of 30 none. So several limits and two losses are tried, and each answer is judged on
the same pairs, all of them:

    w_ij       sqrt(number of matches): a false pair of a thousand matches is not a thousand witnesses
    agree_ij   both cameras have a rotation, and R_j R_i^T is within 5 degrees of the pair's own
    share      sum of w_ij over the agreeing pairs / sum of all w_ij
    score      share * share of cameras that have a rotation

The answers within 0.005 of the best score are equally consistent; of those the finest fit is kept, by

    fit        sum of w_ij max(0, 1 - residual / 5 deg) / sum of all w_ij

Weighted by the number of matches itself, the score prefers an answer with six wrong cameras on lego100.
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from sfm_shapefit.base.arrays import BoolArray, FloatArray
from sfm_shapefit.base.errors import UnsolvableError
from sfm_shapefit.base.wording import counted
from sfm_shapefit.pairs.relative_rotations import AGREEMENT_DEG, LEAST_MATCHES, RelativeRotations
from sfm_shapefit.rotations.average import average_relative_rotations
from sfm_shapefit.rotations.averaged import AveragedRotations
from sfm_shapefit.rotations.options import Averaging
from sfm_shapefit.rotations.rotation_averaging import Loss, average_rotations

_LIMITS = (LEAST_MATCHES, 20, 30, 50, 80)
_LOSSES: tuple[Loss, ...] = ("geman-mcclure", "half-norm")
_EQUAL_SCORES = 0.005


def average_consistently(
    num_images: int,
    relative: RelativeRotations,
    min_matches: int = 0,
    *,
    averaging: Averaging = "own",
    threads: int = 1,
) -> AveragedRotations:
    """Return the most consistent rotations of some images; of several components one is answered.

    Args:
        num_images: n.
        relative: pairs of them.
        min_matches: pairs of fewer are left out. With 0, our own averaging leaves none out for that, and
            pycolmap's tries several limits.
        averaging: who averages.
        threads: of our own averaging; the answer does not depend on it.

    Raises:
        UnsolvableError: if no averaging succeeds.
    """
    if averaging == "own":
        used = relative.num_matches >= min_matches
        if used.any():
            return average_relative_rotations(num_images, relative.subset(used), threads)
    else:
        judged = list(_answers(num_images, relative, min_matches))
        if judged:
            best = max(one.score for one in judged)
            chosen = max(
                (one for one in judged if one.score >= best - _EQUAL_SCORES), key=lambda one: one.fit
            )
            highest = np.fmax.reduce([one.answer.agreements for one in judged])
            return replace(chosen.answer, best_agreements=highest, num_tried=len(judged))
    if len(relative.pairs) and not (relative.num_matches >= min_matches).any():
        raise UnsolvableError(
            f"none of {counted(len(relative.pairs), 'pair')} has {min_matches} inlier matches; lower "
            "min_matches"
        )
    raise UnsolvableError(
        f"the relative rotations of {len(relative.pairs)} pairs cannot be averaged; match more images"
    )


class _Judged(NamedTuple):
    """An answer of pycolmap, and how consistent it is."""

    answer: AveragedRotations
    score: float
    fit: float


def _answers(num_images: int, relative: RelativeRotations, min_matches: int) -> Iterator[_Judged]:
    """Yield pycolmap's answer per setting that is different from the others and succeeds."""
    seen: set[tuple[int, bool]] = set()
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
                    yield _judge(relative, found, len(given.pairs))


def _judge(relative: RelativeRotations, found: tuple[FloatArray, BoolArray], num_pairs: int) -> _Judged:
    """Compare averaged rotations with the sound pairs, or with all if none is sound."""
    rotations, registered = found
    sound = relative.are_sound()
    pairs = relative.subset(sound) if sound.any() else relative
    i, j = pairs.pairs.T
    residuals = pairs.residuals_deg(rotations)
    both = registered[i] & registered[j]
    weights = np.sqrt(pairs.num_matches)
    agreeing = weights * (both & (residuals <= AGREEMENT_DEG))
    near = weights * both * np.maximum(0.0, 1.0 - residuals / AGREEMENT_DEG)
    n = len(registered)
    ends, total = pairs.pairs.T.ravel(), np.bincount(pairs.pairs.T.ravel(), np.tile(weights, 2), n)
    with np.errstate(invalid="ignore"):
        agreements = np.asarray(np.bincount(ends, np.tile(agreeing, 2), n) / total, dtype=np.float64)
    answer = AveragedRotations(
        rotations=rotations,
        registered=registered,
        sigmas_deg=np.full(n, np.nan),
        agreements=agreements,
        best_agreements=agreements,
        share=float(agreeing.sum() / max(float((weights * both).sum()), 1e-300)),
        num_pairs=num_pairs,
        averaging="pycolmap",
    )
    score = float(agreeing.sum() / weights.sum() * registered.mean())
    return _Judged(answer, score, float(near.sum() / weights.sum()))
